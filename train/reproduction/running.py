"""Flying cells: which are done, the programs that fly the others, and a board that shows it."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from train.jobs.workers import Done, Job, open_workers, run_jobs
from train.reproduction.plan import Cell
from train.support.command_line import stop_on_ctrl_c
from train.support.run_folder import RunFolder

# What is left of a finished cell, unless everything is kept.
KEPT = ("mission.json", "trajectory.csv", "scene.json", "config.json", "command.txt", "report.md")
# Seconds per leg, until some of this run's cells have been timed.
SECONDS = {"policy": 40.0, "mpc": 1.5, "guidance": 1.0, "reference": 5.0}


@dataclass(frozen=True)
class Settings:
    """How cells are flown.

    Attributes:
        workers: cells side by side. ray: on the cluster of `connect_ray` instead.
        mission: further arguments of `train.mission`. keep: leave everything in a cell's folder.
    """

    workers: int
    ray: bool = False
    mission: tuple[str, ...] = ()
    keep: bool = False


def cell_folder(out: Path, cell: Cell) -> RunFolder:
    """Where a cell is flown."""
    return RunFolder(out / "cells" / cell.name)


def result_of(out: Path, cell: Cell) -> dict[str, Any] | None:
    """The cell's mission.json; None if it is not flown yet, or holds another flight."""
    result = cell_folder(out, cell).read_json("mission.json")
    return result if result is not None and tuple(result["order"]) == cell.order else None


def arguments_of(
    cell: Cell, scene: Path, mission: Sequence[str], keep: bool
) -> tuple[str, tuple[str, ...]]:
    """Program and arguments, without --out, that fly a cell; a stopped one is gone on with."""
    common = ["--scene", str(scene), "--order", ",".join(map(str, cell.order)), "--no-video"]
    common += [] if keep else ["--no-plots"]
    if cell.planner == "policy":
        more = ["--seed", str(cell.seed), "--workers", "1", "--resume", "--from-scratch", *mission]
        return "train.mission", (*common, *more)
    return "train.fly", (*common, "--planner", cell.planner, "--overwrite")


def fly_cells(out: Path, cells: Sequence[Cell], settings: Settings) -> tuple[bool, dict[str, str]]:
    """Fly what is not flown yet, the longest first.

    A flight without success is a result; a program that leaves none is an error, and the others go
    on.

    Returns:
        Whether all were run (False: Ctrl-C), and by cell name what went wrong.
    """
    for cell in cells:
        if result_of(out, cell) is not None:
            tidy(out, cell, settings.keep)  # in case of a stop right before
    todo = sorted((cell for cell in cells if result_of(out, cell) is None), key=_seconds)[::-1]
    if not todo:
        return True, {}
    jobs = []
    for index, cell in enumerate(todo):
        scene = (out / "scenes" / f"{cell.scene}.json").resolve()
        program, arguments = arguments_of(cell, scene, settings.mission, settings.keep)
        jobs.append(Job(index, arguments, cell_folder(out, cell).path.resolve(), program))
    errors: dict[str, str] = {}
    board = Board(todo, len(cells) - len(todo), settings.workers)

    def finished(done: Done) -> None:
        cell = todo[done.job.index]
        result = result_of(out, cell)
        if result is None or done.code not in (0, 1):
            errors[cell.name] = f"exit code {done.code}: {done.message}"
        else:
            tidy(out, cell, settings.keep)
        board.finished(cell, result, errors.get(cell.name))

    with (
        stop_on_ctrl_c() as stopped,
        board,
        open_workers(settings.workers, ray=settings.ray) as workers,
    ):

        def tick() -> bool:
            board.update()
            return stopped()

        return run_jobs(workers, jobs, finished, tick), errors


def tidy(out: Path, cell: Cell, keep: bool) -> None:
    """Remove checkpoints, policies and pictures of a finished cell."""
    if keep:
        return
    for path in cell_folder(out, cell).path.iterdir():
        if path.name in KEPT:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _seconds(cell: Cell) -> float:
    return SECONDS[cell.planner] * (len(cell.order) + 1)


@dataclass
class Board:
    """What is running and how long the rest will take; in a log file a line per finished cell."""

    todo: Sequence[Cell]
    before: int
    workers: int
    console: Console = field(default_factory=lambda: Console(stderr=True))

    def __post_init__(self) -> None:
        """Everything waits; jobs start in the order of `todo`."""
        self._begun: dict[str, float] = {}
        self._done: set[str] = set()
        self._spent: dict[str, list[tuple[float, float]]] = {}  # planner -> expected, measured
        self._live = Live(console=self.console, refresh_per_second=2, transient=True)
        self._moving, self._shown = sys.stderr.isatty(), 0.0

    def __enter__(self) -> Board:
        """Start showing."""
        self._mark()
        if self._moving:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        """Stop showing."""
        if self._moving:
            self._live.stop()

    def update(self) -> None:
        """Draw again, at most once a second."""
        if self._moving and time.monotonic() - self._shown > 1.0:
            self._live.update(self._picture())
            self._shown = time.monotonic()

    def finished(self, cell: Cell, result: Mapping[str, Any] | None, error: str | None) -> None:
        """Note a finished cell and say how it ended."""
        spent = time.monotonic() - self._begun.get(cell.name, time.monotonic())
        self._spent.setdefault(cell.planner, []).append((_seconds(cell), spent))
        self._done.add(cell.name)
        self._mark()
        if error is not None or result is None:
            ended = f"error: {error}"
        elif result["success"]:
            ended = f"{result['mission_time']:.1f} s"
        else:
            ended = "no success"
        line = f"[{self._count()}] {cell.name}: {ended} (took {spent:.0f} s)"
        if not self._moving:
            line += f", {self.left()}"
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def running(self) -> list[Cell]:
        """Cells being flown: the first unfinished ones."""
        return [cell for cell in self.todo if cell.name not in self._done][: self.workers]

    def left(self) -> str:
        """The time left, from how long this run's cells of the same planner took."""
        seconds = 0.0
        now = time.monotonic()
        for cell in self.todo:
            if cell.name not in self._done:
                timed = self._spent.get(cell.planner, [])
                pace = sum(m for _, m in timed) / sum(e for e, _ in timed) if timed else 1.0
                spent = now - self._begun.get(cell.name, now)
                seconds += max(pace * _seconds(cell) - spent, 0.0)
        seconds /= self.workers
        return f"about {seconds / 60:.0f} min left" if seconds >= 60 else f"{seconds:.0f} s left"

    def _count(self) -> str:
        return f"{self.before + len(self._done)}/{self.before + len(self.todo)}"

    def _mark(self) -> None:
        for cell in self.running():
            self._begun.setdefault(cell.name, time.monotonic())

    def _picture(self) -> Group:
        total = self.before + len(self.todo)
        share = (self.before + len(self._done)) / total
        bar = "━" * round(40 * share) + "╌" * (40 - round(40 * share))
        lines = [Text(f"{bar} {self._count()} flights, {self.left()}")]
        now = time.monotonic()
        for cell in self.running()[:12]:
            lines.append(Text(f"  {cell.name}  {now - self._begun.get(cell.name, now):.0f} s"))
        return Group(*lines)
