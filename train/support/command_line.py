"""Does what every program does: parse, run, report mistakes, stop on Ctrl-C, show progress."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TypeVar

import torch
import tyro
from tqdm import tqdm

from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.policy import PolicyError
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import TourError
from train.support.run_folder import RunError

T = TypeVar("T")
INTERRUPTED = 130
BAD_INPUT = 2


@contextlib.contextmanager
def stop_on_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether Ctrl-C was pressed; a second one ends at once."""
    pressed = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


def run_program(
    name: str,
    args_class: type[T],
    program: Callable[[T], int],
    argv: list[str] | None,
    defaults: Callable[[], T] | None = None,
) -> int:
    """Parses the command line, runs a program and returns its exit code.

    A user's mistake is one message and code 2, Ctrl-C is code 130, a full disk is code 1.
    The fields of `args_class` are the flags; they change `defaults`, or those of the class.
    """
    torch.set_num_threads(1)  # with two on a busy two-core machine, updates were 20 times slower
    try:
        given = tyro.MISSING_NONPROP if defaults is None else defaults()
        args = tyro.cli(args_class, args=argv, prog=f"python -m {name}", default=given)
    except ValueError as error:  # from a settings class: field, value and fix
        say(f"error: {error}")
        return BAD_INPUT
    except BrokenPipeError:  # whoever reads --help has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    try:
        return program(args)
    except (SceneError, TourError, GuidanceError, RunError) as error:
        say(f"error: {error}")
        return BAD_INPUT
    except PolicyError as error:
        say(f"error: {error}; put it back as it was written, or train it again")
        return BAD_INPUT
    except KeyboardInterrupt:
        say(f"interrupted; {_again(args)}")
        return INTERRUPTED
    except OSError as error:  # a full disk, say: what was written is whole
        say(f"error: {error}{_disk(error)}; when mended, {_again(args)}")
        return 1


def _disk(error: OSError) -> str:
    """Returns, where a disk is full, which it is, and how many bytes are free there."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT) or error.filename is None:
        return ""
    place = Path(os.fsdecode(error.filename)).absolute()
    while not place.is_mount():
        place = place.parent
    return f": the disk at {place} has {shutil.disk_usage(place).free} bytes left"


def _again(args: object) -> str:
    """Says how to start a program again that was stopped."""
    return "go on with --resume" if hasattr(args, "resume") else "start again with --overwrite"


def progress_bar(total: int, unit: str = "update") -> tqdm:
    """Returns a progress bar on stderr; in a log file it writes one line every 10 s."""
    moving = sys.stderr.isatty()
    return tqdm(total=total, unit=unit, mininterval=0.1 if moving else 10.0)


def say(message: str) -> None:
    """Prints a line for the user on stderr, since stdout carries results."""
    print(message, file=sys.stderr, flush=True)
