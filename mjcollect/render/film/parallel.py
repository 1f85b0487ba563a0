"""Renders the frames of a film in several processes; they come out in order, the same as in one.

Each process has a renderer of its own and makes every n-th frame. A frame crosses in shared memory,
in one of a few places, so that the memory needed does not depend on the film's length.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # It imports mujoco, which reads MUJOCO_GL and LP_NUM_THREADS then.
    from mjcollect.render.camera import Picture
    from mjcollect.render.film.frames import Film

PLACES = 4  # A process may be so many frames ahead of the encoder.
MOST = 8  # More processes than this would wait for the encoder.
WORTH = 100  # Starting a process takes as long as rendering about so many frames.
# Mesa's renderer in software has a thread for each core unless this says otherwise: a process for
# each core is faster, with none.
THREADS = "LP_NUM_THREADS"


class WorkerError(RuntimeError):
    """Says that a rendering process failed, and how."""


def cores() -> int:
    """Returns the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def choose_processes(frames: int) -> int:
    """Returns how many processes render a film of so many frames soonest."""
    return max(1, min(cores(), MOST, frames // WORTH))


def render_frames(film: Film, processes: int) -> Generator[Picture]:
    """Yields a film's pictures (H, W, 3) uint8 in order; each is valid until the next one.

    One process is this one. More are started and, when this generator is closed, ended.

    Raises:
        WorkerError: a process failed or was killed.
    """
    processes = min(processes, len(film))
    if processes == 1:
        yield from film.frames()
        return
    job = pickle.dumps(film)
    with ExitStack() as stack:
        try:
            with _as_parent():
                workers = [
                    stack.enter_context(closing(_Worker(job, film.size, part, processes)))
                    for part in range(processes)
                ]
        except OSError as error:
            raise WorkerError(f"no rendering process could be started ({error})") from None
        for number in range(len(film)):
            worker = workers[number % processes]
            yield worker.take()
            worker.release()


@contextmanager
def deaf_children() -> Iterator[None]:
    """Has the processes that are started meanwhile leave Ctrl-C to this one."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _as_parent() -> Iterator[None]:
    """Has the processes that are started meanwhile leave Ctrl-C to this one, and suit each other.

    They also do not import this process's main module, which may be a script that renders.
    """
    main = sys.modules["__main__"]
    given = os.environ.get(THREADS)
    # It starts with the first process otherwise, and lets signals through again then.
    resource_tracker.ensure_running()
    with deaf_children():
        try:
            sys.modules["__main__"] = ModuleType("__main__")
            os.environ.setdefault(THREADS, "0")
            yield
        finally:
            if given is None:
                os.environ.pop(THREADS, None)
            sys.modules["__main__"] = main


class _Worker:
    """Is a process that renders every n-th frame."""

    def __init__(self, job: bytes, size: tuple[int, int], part: int, parts: int) -> None:
        context = multiprocessing.get_context("spawn")  # GL and threads do not survive a fork
        width, height = size
        memory = context.RawArray(ctypes.c_uint8, PLACES * height * width * 3)
        self._places = _pictures(memory, size)
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_work, args=(job, memory, size, theirs, part, parts), daemon=True
        )
        self._process.start()
        theirs.close()  # so that the end of the process ends the pipe
        self._taken = 0

    def take(self) -> Picture:
        """Waits for the next picture."""
        try:
            failure = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            failure = f"ended with code {self._process.exitcode}"
        if failure is not None:
            raise WorkerError(f"a rendering process failed ({failure})")
        return self._places[self._taken % PLACES]

    def release(self) -> None:
        """Lets the place of the last picture be used again."""
        self._taken += 1
        with suppress(ConnectionError):  # It may have made its last picture and be gone.
            self._pipe.send(None)

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()  # It has nothing to tidy up.
        self._process.join()
        self._pipe.close()


def _work(
    job: bytes, memory: Any, size: tuple[int, int], pipe: Connection, part: int, parts: int
) -> None:
    """Renders, in a process of its own, until all is done or the other end of the pipe is gone."""
    places = _pictures(memory, size)
    try:
        film: Film = pickle.loads(job)
        with closing(film.frames(part, parts)) as frames:
            for number, frame in enumerate(frames):
                if number >= PLACES:
                    pipe.recv()
                places[number % PLACES] = frame
                pipe.send(None)
    except (EOFError, ConnectionError):
        pass  # The other end is gone: nobody wants the rest.
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


def _pictures(memory: Any, size: tuple[int, int]) -> Picture:
    """Returns shared memory as PLACES pictures, (PLACES, H, W, 3)."""
    width, height = size
    return np.frombuffer(memory, dtype=np.uint8).reshape(PLACES, height, width, 3)
