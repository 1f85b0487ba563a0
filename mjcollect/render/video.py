"""Films run folders, as `python -m mjcollect.render --run DIR` does.

mujoco reads MUJOCO_GL when it is imported, so programs that have imported it already, or that
must run without GL, use `render_in_child`.
"""

from __future__ import annotations

import fcntl
import io
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from mjcollect.render.film.parallel import (
    WorkerError,
    choose_processes,
    deaf_children,
    render_frames,
)
from mjcollect.render.runs import load_run, one_line
from mjcollect.render.settings import VideoSettings

LONGEST = 60.0  # A longer flight is sped up to a video of about this length (s).
LOG_SECONDS = "10"  # A log file gets a state of the progress bar after each such time (s).
BAR = "video"  # The progress bar's line begins with this.
# A coarser search for motion than veryfast's and fewer kinds of frames and blocks take six tenths
# of its time, for 13% more bytes.
ENCODER = (
    "-preset veryfast -movflags +faststart "
    "-x264-params subme=1:me=dia:weightp=0:bframes=1:b-adapt=0:8x8dct=0"
)
PARENT = "MJCOLLECT_RENDER_FOR"  # names the process that a film is made for, and ends with
LATER = "python -m mjcollect.render --run"


class RenderError(RuntimeError):
    """Says that no video could be made; the message says why and what to do."""


def render_run(
    folder: str | os.PathLike[str], settings: VideoSettings | None = None,
    processes: int | None = None,
) -> Path:  # fmt: skip
    """Writes the video of a run folder, with a progress bar on stderr.

    It is fleet.mp4, segment.mp4 or mission.mp4.

    MUJOCO_GL must have been set before mujoco was imported. A flight that ended early is shown as
    far as it goes; times in which the shield acted are marked.

    Args:
        folder: of a finished run.
        settings: size, frame rate and the like; the run says speed and caption.
        processes: that render side by side; by default one per core where the film is long enough.
            The video is the same for any number.

    Returns:
        The video's path, whose file is replaced in one step when the video is complete.

    Raises:
        UnreadableRun: the folder is not a readable run.
        RenderError: no video could be made.
    """
    folder = Path(folder).absolute()  # ffmpeg would take "a:b" for a protocol
    run = load_run(folder)
    import imageio_ffmpeg
    import mediapy

    try:
        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise RenderError(f"no ffmpeg ({one_line(error)}); pip install imageio-ffmpeg") from None
    check_gl()
    from mjcollect.render.film.frames import Film

    # In quarters, so that the speed that is written on the frames is short.
    speed = max(1.0, math.ceil(4 * run.fleet.duration / LONGEST) / 4)
    settings = replace(settings or VideoSettings(), speed=speed, caption=run.caption)
    film = Film(run.fleet, settings, run.air)
    path, part = folder / f"{run.kind}.mp4", folder / f".part-{run.kind}.mp4"
    try:
        with _kept(part):
            with ExitStack() as stack:
                many = processes or choose_processes(len(film))
                frames = stack.enter_context(closing(render_frames(film, many)))
                with deaf_children():  # ffmpeg: a film that Ctrl-C ends is no failure of its
                    writer = stack.enter_context(
                        mediapy.VideoWriter(
                            part, settings.size[::-1], fps=settings.fps, crf=22,
                            encoded_format="yuv420p", ffmpeg_args=ENCODER,
                        )
                    )  # fmt: skip
                bar = tqdm(frames, total=len(film), desc=BAR, unit="frame", dynamic_ncols=True)
                for frame in bar:
                    writer.add_image(frame)
            os.replace(part, path)
    except RenderError:
        raise
    except WorkerError as error:
        raise RenderError(f"{path}: {one_line(error)}; {LATER} {folder} --processes 1") from None
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: what ffmpeg said
        said = "".join(str(error).splitlines()[-1:])
        raise RenderError(f"{path}: cannot be written ({one_line(said)})") from None
    return path


@contextmanager
def _kept(part: Path) -> Iterator[None]:
    """Makes a file that no other process films into meanwhile, and that is gone at the end.

    Raises:
        RenderError: another process films into it.
    """
    with part.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RenderError(
                f"{part.parent}: another process is filming it; wait for it"
            ) from None
        try:
            yield
        finally:
            part.unlink(missing_ok=True)


def render_in_child(run_dir: str | os.PathLike[str]) -> str | None:
    """Films a run folder in a child process, with MUJOCO_GL from the environment or egl.

    This works whatever this process has imported. The child's progress bar shows on stderr; a
    Ctrl-C here stops the child too.

    Returns:
        None on success, else a sentence: the reason and how to get the video later.
    """
    environment = {**gl_environment(os.environ), PARENT: str(os.getpid())}
    if not sys.stderr.isatty():
        environment["TQDM_MININTERVAL"] = LOG_SECONDS
    reason = ""
    with subprocess.Popen(
        [sys.executable, "-m", "mjcollect.render", "--run", str(run_dir)],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    ) as child:  # fmt: skip
        assert child.stderr is not None
        try:
            # The states of the progress bar are lines that end with \r; they are passed on.
            for line in io.TextIOWrapper(child.stderr, errors="replace", newline=""):
                if line.startswith(BAR):
                    sys.stderr.write(line)
                    sys.stderr.flush()
                else:
                    reason = line.strip() or reason
        except BaseException:
            child.terminate()
            raise
    if child.returncode == 0:
        return None
    reason = reason or f"the renderer ended with code {child.returncode}"
    return reason if LATER in reason else f"{reason}; then: {LATER} {run_dir}"


def gl_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Returns the environment with a GL backend chosen; what the user set stays."""
    chosen = {"MUJOCO_GL": "egl", **environment}
    if chosen["MUJOCO_GL"] in ("egl", "osmesa"):
        chosen.setdefault("PYOPENGL_PLATFORM", chosen["MUJOCO_GL"])
    return chosen


def check_gl() -> None:
    """Opens and closes a small renderer: the film's own faults are no lack of GL.

    Raises:
        RenderError: there is no GL; the message says how to get it.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            import mujoco

            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception as error:  # every backend fails in its own way
        backend = os.environ.get("MUJOCO_GL", "(unset)")
        raise RenderError(
            f"off-screen rendering with MUJOCO_GL={backend} failed "
            f"({type(error).__name__}: {one_line(error)}); set MUJOCO_GL=egl and "
            "apt-get install libegl1 libgl1-mesa-dri"
        ) from None
