"""Measures replays: seconds to write one, its size, and how smoothly it plays without a GPU.

    OMP_NUM_THREADS=1 python -m benchmarks.replay --out docs/results/replay.json

Needs Debian's chromium and chromium-driver. The scenes are the towns of benchmarks.boxes with eight
items, flown by the guidance law. Chromium draws by SwiftShader, on the processor. Other processes
slow it down: `load` is how many wanted to run, and the time of the processor per frame, of all
of the browser's threads together, depends on them less than frames per second do.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.boxes import KILOMETRE, town
from benchmarks.browser import chromium
from benchmarks.common import Output, Row, print_table, save
from mjcollect.replay import write_replay
from mjcollect.scene.scene import Scene
from train.fly import main as fly

ITEMS = 8
COLUMNS = (
    ("boxes", "{boxes:,}"),
    ("camera", "{camera}"),
    ("frames per second", "{fps:.1f}"),
    ("of the pixels", "{pixels:.2f}"),
    ("processor (ms per frame)", "{cpu_ms:.0f}"),
    ("load", "{load:.1f}"),
    ("size (KiB)", "{kib:.0f}"),
    ("written in (s)", "{write_seconds:.2f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Measures how fast replays are written, and how smoothly they play."""

    boxes: tuple[int, ...] = (20, 3000)
    """Numbers of boxes."""
    seconds: float = 15.0
    """Seconds that each camera is measured for, after as many to settle."""
    size: tuple[int, int] = (1280, 720)
    """Width and height of the window in pixels."""


def scene_of(boxes: int) -> Scene:
    """Returns a town whose items hang over crossings."""
    scene = town(boxes, KILOMETRE)
    blocks = int(np.ceil(np.sqrt(boxes + 20)))
    rng = np.random.default_rng(1)
    crossings = rng.integers(1, blocks, (ITEMS, 2)) * KILOMETRE / blocks
    items = np.column_stack([crossings, rng.uniform(15.0, 60.0, ITEMS)])
    return dataclasses.replace(scene, name=f"town of {boxes}", items=items)


def processor_time(root: int) -> float:
    """Returns the seconds that all processes below one have worked."""
    children: dict[int, list[int]] = {}
    ticks: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:  # It has just ended.
            continue
        number = int(path.parent.name)
        children.setdefault(int(fields[1]), []).append(number)
        ticks[number] = int(fields[11]) + int(fields[12])
    todo, total = list(children.get(root, [])), 0
    while todo:
        number = todo.pop()
        total += ticks[number]
        todo += children.get(number, [])
    return total / os.sysconf("SC_CLK_TCK")


def measure(boxes: int, args: Args, folder: Path) -> list[Row]:
    """Flies a town, writes its replay and plays it with every camera."""
    scene_of(boxes).save(folder / "town.json")
    quiet = ["--planner", "guidance", "--no-video", "--no-plots", "--no-replay"]
    fly(["--scene", str(folder / "town.json"), "--out", str(folder / "run"), *quiet])
    page, took = folder / "replay.html", []
    for _ in range(5):
        begun = time.perf_counter()
        write_replay([folder / "run"], page)
        took.append(time.perf_counter() - begun)
    rows: list[Row] = []
    with chromium(folder / "profile", args.size) as driver:
        driver.get(page.as_uri())
        driver.execute_script("replay.act.rate(1); replay.act.toggle()")
        for camera in ("orbit", "chase", "top"):
            driver.execute_script(f"replay.act.seek(10); replay.act.camera('{camera}')")
            time.sleep(args.seconds)
            before = driver.execute_script("return [replay.state().frames, performance.now()]")
            cpu = processor_time(driver.service.process.pid)
            time.sleep(args.seconds)
            after = driver.execute_script("return [replay.state().frames, performance.now()]")
            frames = after[0] - before[0]
            cpu = processor_time(driver.service.process.pid) - cpu
            rows.append(
                {
                    "boxes": boxes,
                    "camera": camera,
                    "fps": 1000 * frames / (after[1] - before[1]),
                    "pixels": driver.execute_script("return replay.state().share") ** 2,
                    "cpu_ms": 1000 * cpu / max(frames, 1),
                    "load": os.getloadavg()[0],
                    "kib": page.stat().st_size / 1024,
                    "write_seconds": statistics.median(took),
                }
            )
    return rows


def main(args: Args) -> None:
    """Measures, prints, saves."""
    rows = []
    for boxes in args.boxes:
        with tempfile.TemporaryDirectory() as folder:
            rows += measure(boxes, args, Path(folder))
    print_table(rows, COLUMNS)
    save(args.out, {"results": rows}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
