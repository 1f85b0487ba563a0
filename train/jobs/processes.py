"""Runs programs in processes of their own that need not import everything anew.

Importing torch, TorchRL and matplotlib takes longer than the training of an easy segment. A server
process, multiprocessing's fork server, imports them once and never does anything else, so that a
program forked from it is as good as one started by `python -m`.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import runpy
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import forkserver
from multiprocessing.connection import wait
from multiprocessing.reduction import DupFd
from multiprocessing.util import get_temp_dir
from types import ModuleType
from typing import Any

from train.jobs.tidy import FOLDER

IMPORTED = ("train.segment", "train.mission", "train.fly", "mjcollect.render.path_figures")


def warm_up() -> None:
    """Lets the server start to import, beside whatever this process does next."""
    forkserver.set_forkserver_preload(["train.jobs.tidy", *IMPORTED])
    folder = get_temp_dir()
    if multiprocessing.parent_process() is None:  # else it is the parent's, who removes it
        os.environ[FOLDER] = folder
    try:
        forkserver.ensure_running()
    finally:
        os.environ.pop(FOLDER, None)


def importing_pool(workers: int) -> ProcessPoolExecutor:
    """Returns a pool of `workers` processes that import for themselves.

    They leave Ctrl-C to this process, and end with it, even if it is killed by SIGKILL.
    """
    context = multiprocessing.get_context("spawn")  # fork would copy this process's threads
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_settle)


def _settle() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


class Program:
    """Is a running `python -m program arguments`, which ends with this process, even by SIGKILL."""

    def __init__(self, program: str, arguments: Sequence[str]) -> None:
        """Starts a module, in a session of its own: a Ctrl-C in the terminal does not reach it."""
        warm_up()
        context = multiprocessing.get_context("forkserver")
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - `result` closes it; it has no name
        handed = _Handed(self._output.fileno())
        self._process = context.Process(
            target=_run, args=(program, tuple(arguments), dict(os.environ), handed)
        )
        with _no_main_module():
            self._process.start()

    def interrupt(self) -> None:
        """Does to the program what Ctrl-C does."""
        if self._process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGINT)

    def result(self) -> tuple[int, str]:
        """Waits for the end; returns exit code, and what was written to stdout and stderr."""
        self._process.join()
        with self._output as file:
            file.seek(0)
            output = file.read().decode("utf-8", errors="replace")
        assert self._process.exitcode is not None
        return self._process.exitcode, output


class _Handed:
    """Is an open file's number here, and becomes its number there on the way to a process."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Any, ...]:
        return _taken, (DupFd(self.number),)


def _taken(sent: Any) -> _Handed:
    return _Handed(sent.detach())


@contextlib.contextmanager
def _no_main_module() -> Iterator[None]:
    """Keeps multiprocessing from importing this process's main module again in the new one."""
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def ended(programs: Sequence[Program], timeout: float) -> list[Program]:
    """Returns those of `programs` that have ended; none if none has within `timeout` seconds."""
    sentinels = {program._process.sentinel: program for program in programs}
    return [sentinels[ready] for ready in wait(list(sentinels), timeout) if isinstance(ready, int)]


def _run(program: str, arguments: tuple[str, ...], env: Mapping[str, str], output: _Handed) -> None:
    """Becomes the program, in the process forked from the server."""
    os.setsid()
    # A shell's background job ignores Ctrl-C, and what it starts would ignore `interrupt`.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.dup2(output.number, 1)
    os.dup2(output.number, 2)
    os.close(output.number)
    os.environ.clear()
    os.environ.update(env)
    sys.argv = [program, *arguments]
    sys.orig_argv = [sys.executable, "-m", program, *arguments]
    sys.modules.pop(program, None)  # else runpy warns
    runpy.run_module(program, run_name="__main__", alter_sys=True)


def _end_with_parent() -> None:
    """Waits, in a thread, for the process that asked for this one; then ends by SIGKILL.

    The kernel's PR_SET_PDEATHSIG would not do: the parent in its eyes is the fork server, which
    lives on until the last process forked from it ends.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGKILL)
