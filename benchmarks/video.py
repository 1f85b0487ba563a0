"""Measures how fast a run is filmed, against an earlier state of this repository, and the look.

    git worktree add ../before 2613b12
    python -m train.fly --scene scenario_1 --no-video --out runs/filmed
    python -m benchmarks.video --run runs/filmed --before ../before --out docs/results/video.json

Every way films the same run in a process of its own. Ways take turns, so that a busy machine slows
all of them; each ratio is the median over the rounds of the ratio within a round. Seconds of CPU
count all processes and threads, the encoder's too. The look is compared on frames before encoding.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import tyro
from PIL import Image
from tqdm import tqdm

from benchmarks.common import Output, Row, median_ratio, print_table, save

BEFORE = "before"
COLUMNS = (
    ("way", "{way}"),
    ("frames per second", "{frames_per_second:.1f}"),
    ("of before", "{over_before:.2f}"),
    ("CPU ms per frame", "{cpu_ms_per_frame:.1f}"),
    ("before's CPU, times", "{before_cpu:.2f}"),
    ("start, s", "{start_seconds:.1f}"),
)
# Films a run; prints the number of frames, and when the first frame and the end were reached.
FILM = """
import json, sys, time
import mediapy
from mjcollect.render import VideoSettings, render_run
times = []
class Writer(mediapy.VideoWriter):
    def add_image(self, image):
        times.append(time.monotonic())
        super().add_image(image)
mediapy.VideoWriter = Writer
folder, fps, *processes = sys.argv[1:]
render_run(folder, VideoSettings(fps=float(fps)), *map(int, processes))
print(json.dumps([len(times), times[0], time.monotonic()]))
"""
# Writes every n-th frame as a PNG instead of a video.
DRAW = """
import pathlib, sys
import mediapy
from PIL import Image
from mjcollect.render import VideoSettings, render_run
folder, fps, every, out = sys.argv[1:]
class Writer:
    def __init__(self, path, *args, **settings):
        self.path, self.count = pathlib.Path(path), 0
    def __enter__(self):
        return self
    def __exit__(self, *failure):
        self.path.touch()
    def add_image(self, image):
        if self.count % int(every) == 0:
            Image.fromarray(image).save(f"{out}/{self.count // int(every):04}.png")
        self.count += 1
mediapy.VideoWriter = Writer
render_run(folder, VideoSettings(fps=float(fps)))
"""


@dataclass(frozen=True)
class Args(Output):
    """Measures how fast a run is filmed."""

    run: Path = tyro.MISSING
    """Folder of a finished run; it stays as it is."""
    before: Path = tyro.MISSING
    """Checkout of the earlier state."""
    processes: tuple[int, ...] = (1, 2)
    """Numbers of processes that are measured."""
    fps: float = 25.0
    """Frames per second of video; fewer take less time to measure."""
    rounds: int = 3
    """Number of rounds, in each of which all ways have a turn."""
    every: int = 20
    """Each so many-th frame is compared."""


def run_code(checkout: Path, code: str, *arguments: object) -> str:
    """Runs code with a checkout's modules, and returns what it prints."""
    env = {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl", **os.environ, "PYTHONPATH": "."}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=checkout, env=env, check=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    return done.stdout


def film(checkout: Path, folder: Path, fps: float, processes: Sequence[int]) -> dict[str, float]:
    """Films a run and returns what that took."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    frames, first, end = json.loads(run_code(checkout, FILM, folder, fps, *processes))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "frames": frames,
        "frames_per_second": (frames - 1) / (end - first),
        "cpu_ms_per_frame": 1e3 * cpu / frames,
        "start_seconds": first - begin,
    }


def rates(ways: Mapping[str, tuple[Path, Sequence[int]]], folder: Path, args: Args) -> list[Row]:
    """Lets the ways take turns at filming, and returns a row for each."""
    measured: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    for _ in tqdm(range(args.rounds), unit="round"):
        for way, (checkout, processes) in ways.items():
            measured[way].append(film(checkout, folder, args.fps, processes))
    rows: list[Row] = []
    for way, rounds in measured.items():
        columns = {key: [each[key] for each in rounds] for key in rounds[0]}
        first = {key: [each[key] for each in measured[BEFORE]] for key in rounds[0]}
        speed, cpu = "frames_per_second", "cpu_ms_per_frame"
        rows.append(
            {
                "way": way,
                **{key: statistics.median(values) for key, values in columns.items()},
                "over_before": median_ratio(columns[speed], first[speed]),
                "before_cpu": median_ratio(first[cpu], columns[cpu]),
                "rounds": rounds,
            }
        )
    return rows


def look(checkouts: Sequence[Path], folder: Path, args: Args) -> Row:
    """Returns how alike the frames of two checkouts are: PSNR in dB and SSIM, mean and worst."""
    with tempfile.TemporaryDirectory() as name:
        pictures = [Path(name) / str(k) for k in range(2)]
        for checkout, place in zip(checkouts, pictures, strict=True):
            place.mkdir()
            run_code(checkout, DRAW, folder, args.fps, args.every, place)
        files = sorted(path.name for path in pictures[0].iterdir())
        errors = []
        for file in files:
            one, two = (np.asarray(Image.open(place / file), dtype=float) for place in pictures)
            errors.append(float(np.mean((one - two) ** 2)))
        psnr = 10 * np.log10(255**2 / np.maximum(errors, 1e-9))
        inputs = [part for place in pictures for part in ("-i", f"{place}/%04d.png")]
        said = subprocess.run(
            [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *inputs, "-lavfi",
             "ssim=stats_file=-", "-f", "null", os.devnull],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        ssim = [float(line.split("All:")[1].split()[0]) for line in said.stdout.splitlines()]
    return {
        "frames": len(files),
        "psnr_mean": float(np.mean(psnr)),
        "psnr_least": float(np.min(psnr)),
        "ssim_mean": float(np.mean(ssim)),
        "ssim_least": float(np.min(ssim)),
    }


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    here = Path(__file__).resolve().parents[1]
    ways: dict[str, tuple[Path, Sequence[int]]] = {BEFORE: (args.before.resolve(), ())}
    for count in args.processes:
        ways[f"now, {count} process{'es' if count > 1 else ''}"] = (here, (count,))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(shutil.copytree(args.run, Path(name) / "run"))
        rows = rates(ways, folder, args)
        print_table(rows, COLUMNS)
        alike = look([args.before.resolve(), here], folder, args)
    print(alike)
    save(args.out, {"results": rows, "look": alike}, args)


if __name__ == "__main__":
    main()
