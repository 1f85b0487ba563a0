"""Video of a flight: `render_video`, and `python -m mjcollect.render --run DIR` for run folders.

mujoco reads MUJOCO_GL when it is imported, so programs that have imported it already, or that
must run without GL, use `render_in_child`.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import SHIELD_FILE, Trajectory, load_shield

MISSION_SECONDS = 60.0  # a mission's video is sped up to about this length
RUN_FPS = 25
LOG_SECONDS = 10.0  # between two states of the progress bar in a log file
LATER = "python -m mjcollect.render --run"


class RenderError(RuntimeError):
    """No video could be made. The message says why and what to do."""


def render_video(
    path: str | os.PathLike[str],
    scene: Scene,
    trajectory: Trajectory,
    order: Sequence[int],
    *,
    segment: int | None = None,
    fps: float = 30,
    speed: float = 1.0,
    size: tuple[int, int] = (1280, 720),
    caption: str | None = None,
    samples: int = 0,
    shielded: Array | None = None,
    show_progress: bool = False,
) -> None:
    """Write an H.264 video of a flight; needs MUJOCO_GL set before mujoco was imported.

    Args:
        path: of the .mp4, replaced in one step when the video is complete.
        scene, trajectory, order: what was flown; a flight that ends early is shown as far as
            it goes.
        segment: 0..K if the trajectory is one segment, None if it is a mission.
        fps: frames per second. speed: seconds of flight per second of video.
        size: width and height in pixels, both even.
        caption: headline of the result; by default whether the targets were reached.
        samples: multisampling; 4 smooths edges, in software GL at more than twice the time.
        shielded: (n, 2) seconds between which the shield acted, marked; see `shield_log`.
        show_progress: draw a progress bar on stderr.

    Raises:
        ValueError: a value is unusable.
        RenderError: no GL or no ffmpeg.
    """
    if min(size) < 16 or size[0] % 2 or size[1] % 2:
        raise ValueError(f"size: {size}: needs even numbers of at least 16 pixels")
    if not (math.isfinite(fps) and fps > 0 and math.isfinite(speed) and speed > 0):
        raise ValueError(f"fps, speed: {fps}, {speed}: must be positive numbers")
    import imageio_ffmpeg
    import mediapy

    try:
        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise RenderError(f"no ffmpeg ({_line(error)}); pip install imageio-ffmpeg") from None
    _check_gl()
    from mjcollect.render.frames import Film

    film = Film(
        scene, trajectory, order,
        segment=segment, fps=fps, speed=speed, size=size, caption=caption, samples=samples,
        shielded=shielded,
    )  # fmt: skip
    frames = film.frames()
    path = Path(path)
    part = path.with_name(f".{path.stem}.part.mp4")
    try:
        with mediapy.VideoWriter(
            part, (size[1], size[0]), fps=fps, crf=22, encoded_format="yuv420p",
            ffmpeg_args="-preset veryfast -movflags +faststart",
        ) as writer:  # fmt: skip
            for frame in _bar(frames, len(film), show_progress):
                writer.add_image(frame)
        os.replace(part, path)
    finally:
        frames.close()
        part.unlink(missing_ok=True)


def render_run(
    folder: str | os.PathLike[str], *, samples: int = 0, show_progress: bool = False
) -> Path:
    """Write the video of a run folder: segment.mp4 or mission.mp4.

    `samples`: as in `render_video`.

    Raises:
        RenderError: the folder is not a readable run, or no video could be made.
    """
    folder = Path(folder)
    kind = next((k for k in ("segment", "mission") if (folder / f"{k}.json").is_file()), None)
    if kind is None:
        raise RenderError(
            f"{folder}: holds neither segment.json nor mission.json; name the folder of a "
            "finished run (python -m train.segment or train.mission makes one)"
        )
    try:
        scene = Scene.load(folder / "scene.json")
        trajectory = Trajectory.load(folder / "trajectory.csv")
        shielded = load_shield(folder / SHIELD_FILE)
        result = json.loads((folder / f"{kind}.json").read_text(encoding="utf-8"))
        order, segment = list(result["order"]), result["segment"] if kind == "segment" else None
        caption = _caption(result)
    except (OSError, SceneError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RenderError(
            f"{folder}: not a readable run ({type(error).__name__}: {_line(error)}); "
            "run the training or flight again"
        ) from None
    speed = 1.0
    if trajectory.duration > MISSION_SECONDS:
        speed = math.ceil(4 * trajectory.duration / MISSION_SECONDS) / 4
    path = folder / f"{kind}.mp4"
    try:
        render_video(
            path, scene, trajectory, order,
            segment=segment, fps=RUN_FPS, speed=speed, caption=caption, samples=samples,
            shielded=shielded, show_progress=show_progress,
        )  # fmt: skip
    except ValueError as error:
        raise RenderError(f"{folder}: {_line(error)}") from None
    except OSError as error:
        raise RenderError(f"{path}: cannot be written ({_line(error)}); check the disk") from None
    return path


def render_in_child(run_dir: str | os.PathLike[str], *, samples: int = 0) -> str | None:
    """Render a run folder in a child process, with MUJOCO_GL from the environment or egl.

    Works whatever this process has imported. The child's progress bar shows on stderr; a
    Ctrl-C here stops the child too. `samples`: as in `render_run`.

    Returns:
        None on success, else a sentence: the reason and how to get the video later.
    """
    child = subprocess.Popen(
        [sys.executable, "-m", "mjcollect.render", "--run", str(run_dir), f"--samples={samples}"],
        env=_gl_environment(os.environ),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert child.stderr is not None
    said, shown = b"", -math.inf
    try:
        while chunk := os.read(child.stderr.fileno(), 65536):
            said = (said + chunk)[-4000:]
            # The progress bar, in a log file now and then; the reason of a failure is returned.
            if b"\r" in chunk and (sys.stderr.isatty() or time.monotonic() - shown > LOG_SECONDS):
                shown = time.monotonic()
                sys.stderr.write(chunk.decode(errors="replace"))
                sys.stderr.flush()
        code = child.wait()
    finally:
        if child.poll() is None:
            child.terminate()
            try:
                child.wait(timeout=10)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        child.stderr.close()
    if code == 0:
        return None
    lines = [line for line in said.decode(errors="replace").split("\n") if line.strip()]
    reason = lines[-1].split("\r")[-1].strip() if lines else f"the renderer ended with code {code}"
    return f"{reason}; then: {LATER} {run_dir}" if LATER not in reason else reason


def _gl_environment(environment: Any) -> dict[str, str]:
    """The environment with a GL backend chosen; what the user set stays."""
    chosen = dict(environment)
    backend = chosen.setdefault("MUJOCO_GL", "egl")
    if backend in ("egl", "osmesa"):
        chosen.setdefault("PYOPENGL_PLATFORM", backend)
    return chosen


def _check_gl() -> None:
    """Open and close a GL context; apart from the renderer, whose own faults are no lack of GL."""
    try:
        with warnings.catch_warnings(action="ignore"):
            import mujoco

            context = mujoco.GLContext(16, 16)
            context.make_current()
            mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100).free()
            context.free()
    except Exception as error:  # every backend fails in its own way
        backend = os.environ.get("MUJOCO_GL", "(unset)")
        raise RenderError(
            f"off-screen rendering with MUJOCO_GL={backend} failed "
            f"({type(error).__name__}: {_line(error)}); set MUJOCO_GL=egl and "
            "apt-get install libegl1 libgl1-mesa-dri"
        ) from None


def _caption(result: dict[str, Any]) -> str | None:
    """Headline of an unsuccessful run; None if it succeeded."""
    if result.get("success") or not result.get("violations"):
        return None
    first = result["violations"][0]
    when = "" if first.get("t") is None else f" at {float(first['t']):.2f} s"
    return f"{str(first['kind']).upper()}{when}"


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


def _bar(frames: Iterable[np.ndarray], total: int, shown: bool) -> Iterable[np.ndarray]:
    if not shown:
        return frames
    from tqdm import tqdm

    bar: Iterable[np.ndarray] = tqdm(
        frames, total=total, desc="video", unit="frame", dynamic_ncols=True
    )
    return bar
