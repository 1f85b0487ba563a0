"""Runs programs side by side: in local processes, or as tasks of a Ray cluster.

A mission's segments are one `python -m train.segment` each, a reproduction's cells one
`train.mission` or `train.fly`: processes of their own with seeds of their own, so the result does
not depend on where, or beside what, they run.
"""

from __future__ import annotations

import io
import shutil
import tarfile
import tempfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.learning.random_streams import stream
from train.jobs.processes import Program, ended
from train.support.command_line import stop_on_ctrl_c
from train.support.run_folder import RunError


@dataclass(frozen=True)
class Job:
    """Says what to run: a program, such as the training of a segment, with its arguments.

    Attributes:
        index: The number of the segment, or of whatever is run.
        arguments: The program's arguments without --out.
        folder: The folder in which the program leaves its files, its --out.
        program: The program's module.
    """

    index: int
    arguments: tuple[str, ...]
    folder: Path
    program: str = "train.segment"


@dataclass(frozen=True)
class Done:
    """Says how a job ended: by which exit code, and with which last line of messages."""

    job: Job
    code: int
    message: str


def attempt_seed(seed: int, segment: int, attempt: int) -> int:
    """Returns the seed of the `attempt`-th training of a segment, from the mission's seed."""
    name = f"segment {segment} attempt {attempt}"
    return int(stream(seed, name).generate_state(1, np.uint32)[0])


def settings_arguments(settings: Mapping[str, bool | float | str]) -> list[str]:
    """Returns settings as arguments: `--name value`, or `--name` and `--no-name`."""
    arguments = []
    for name, value in settings.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            arguments.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            arguments += [f"--{flag}", str(value)]
    return arguments


class LocalWorkers:
    """Runs jobs in up to `count` processes, which end with this one."""

    def __init__(self, count: int) -> None:
        """Prepares the workers; nothing runs yet."""
        self.count = count
        self._waiting: deque[Job] = deque()
        self._running: dict[Program, Job] = {}

    def submit(self, job: Job) -> None:
        """Queues a job."""
        self._waiting.append(job)

    def next_done(self, timeout: float) -> Done | None:
        """Starts jobs whose turn it is; returns one that ended, None after `timeout` seconds."""
        while self._waiting and len(self._running) < self.count:
            job = self._waiting.popleft()
            started = Program(job.program, (*job.arguments, "--out", str(job.folder)))
            self._running[started] = job
        for program in ended(list(self._running), timeout):
            code, output = program.result()
            return Done(self._running.pop(program), code, _last_line(output))
        return None

    def stop(self) -> None:
        """Lets the running jobs save a checkpoint and end; starts no further ones."""
        self._waiting.clear()
        for program in self._running:
            program.interrupt()
        for program in self._running:
            program.result()
        self._running.clear()


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1] if lines else ""


class RayWorkers:
    """Runs each job as one task of a Ray cluster.

    A task works in a folder of its node and sends it back, since nodes need not share a disk; what
    a stopped mission had not received is trained again.
    """

    def __init__(self) -> None:
        """Prepares tasks for the cluster that `connect_ray` has connected to."""
        import ray

        self._ray = ray
        self._task = ray.remote(num_cpus=1, max_retries=2)(_run_packed)
        self._jobs: dict[Any, Job] = {}

    def submit(self, job: Job) -> None:
        """Queues a job, with what its folder already holds."""
        scene = Path(job.arguments[job.arguments.index("--scene") + 1]).read_text(encoding="utf-8")
        self._jobs[self._task.remote(job.program, job.arguments, scene, pack(job.folder))] = job

    def next_done(self, timeout: float) -> Done | None:
        """Returns a job that ended, None after `timeout` seconds."""
        ready, _ = self._ray.wait(list(self._jobs), num_returns=1, timeout=timeout)
        if not ready:
            return None
        job = self._jobs.pop(ready[0])
        code, message, packed = self._ray.get(ready[0])
        unpack(packed, job.folder)
        return Done(job, code, message)

    def stop(self) -> None:
        """Cancels what runs and leaves the cluster."""
        for task in self._jobs:
            self._ray.cancel(task, force=True)
        self._ray.shutdown()


def connect_ray(address: str, cpus: int = 0) -> None:
    """Connects to a cluster: an address, `auto`, or `local` for one on this machine.

    Raises:
        RunError: Ray is not installed, no cluster answers there, or it has fewer than `cpus` cores.
    """
    try:
        import ray
    except ImportError:
        raise RunError(
            "--ray: Ray is not installed; pip install 'mjcollect[ray]', or use --workers"
        ) from None
    try:
        ray.init(
            address=None if address == "local" else address,
            log_to_driver=False,
            include_dashboard=False if address == "local" else None,
        )
    except (ConnectionError, ValueError) as error:
        raise RunError(f"--ray: {address}: {error}; start the cluster, or use --workers") from None
    there = int(ray.cluster_resources().get("CPU", 0))
    if there < cpus:  # what is asked beyond it would wait for ever
        ray.shutdown()
        raise RunError(
            f"--shards: {cpus}: the cluster at {address} has {there} cores, one for each shard; "
            "use fewer"
        )


def _run_packed(
    program: str, arguments: Sequence[str], scene: str, packed: bytes
) -> tuple[int, str, bytes]:
    """Unpacks a job's folder, runs the job there, and packs the folder again, in a Ray task."""
    with tempfile.TemporaryDirectory() as folder:
        out, scene_file = Path(folder) / "run", Path(folder) / "scene.json"
        scene_file.write_text(scene, encoding="utf-8")
        unpack(packed, out)
        at = list(arguments).index("--scene")
        arguments = [*arguments[: at + 1], str(scene_file), *arguments[at + 2 :]]
        # It ends with this process, which Ray kills to cancel a task.
        code, output = Program(program, (*arguments, "--out", str(out))).result()
        return code, _last_line(output), pack(out)


def pack(folder: Path) -> bytes:
    """Returns a folder as the bytes of a tar file; empty if it is not there."""
    if not folder.is_dir():
        return b""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.add(folder, arcname=".")
    return buffer.getvalue()


def unpack(packed: bytes, folder: Path) -> None:
    """Puts what `pack` gave in place of a folder, which is whole or not there at any time."""
    if packed:
        part = folder.with_name(f".part-{folder.name}")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(part, filter="data")
        shutil.rmtree(folder, ignore_errors=True)
        part.rename(folder)


def run_jobs(
    workers: LocalWorkers | RayWorkers, jobs: Sequence[Job], retry: Callable[[Done], Job | None]
) -> bool:
    """Runs all jobs, and those that `retry` returns for finished ones; stops the workers then.

    Args:
        retry: called with each finished job; returns the job to run in its place, or None.

    Returns:
        Whether all were run; not so after Ctrl-C.
    """
    with stop_on_ctrl_c() as stopped:
        try:
            for job in jobs:
                workers.submit(job)
            left = len(jobs)
            while left and not stopped():
                done = workers.next_done(timeout=0.3)
                if done is not None:
                    again = retry(done)
                    if again is None:
                        left -= 1
                    else:
                        workers.submit(again)
            return left == 0
        finally:
            workers.stop()
