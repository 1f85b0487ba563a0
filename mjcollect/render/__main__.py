"""`python -m mjcollect.render --run DIR` films a finished run."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence

from mjcollect.render.runs import UnreadableRun
from mjcollect.render.settings import VideoSettings
from mjcollect.render.video import PARENT, RenderError, gl_environment, render_run


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, 1 (no GL or ffmpeg), 2 (bad run) or 130 (Ctrl-C)."""
    parser = argparse.ArgumentParser(prog="python -m mjcollect.render", description=__doc__)
    parser.add_argument("--run", required=True, metavar="DIR", help="folder of a finished run")
    smooth = "samples per pixel (0); 4 smooth edges, at more than twice the time in software"
    parser.add_argument("--samples", type=int, default=0, choices=(0, 2, 4, 8), help=smooth)
    several = "processes that render side by side; by default one per core, at most 8"
    parser.add_argument("--processes", type=_positive, metavar="N", help=several)
    arguments = parser.parse_args(argv)
    os.environ.update(gl_environment(os.environ))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that temporary files are removed
    # A shell has the programs that it starts in the background ignore Ctrl-C's signal.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if PARENT in os.environ:
        threading.Thread(target=_end_with, args=(int(os.environ[PARENT]),), daemon=True).start()
    try:
        path = render_run(
            arguments.run, VideoSettings(samples=arguments.samples), arguments.processes
        )
    except UnreadableRun as error:
        print(f"error: --run: {error}", file=sys.stderr)
        return 2
    except RenderError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print(path)
    return 0


def _positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return number


def _end_with(parent: int) -> None:
    """Ends this process when its parent has ended, even by SIGKILL."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    raise SystemExit(main())
