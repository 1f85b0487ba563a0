"""Flies the cells that are not flown yet, each by a program of its own, and shows how far it is."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from train.jobs.workers import Done, Job, LocalWorkers, RayWorkers, run_jobs
from train.reproduction.plan import Cell
from train.support.command_line import progress_bar
from train.support.run_folder import RunFolder, remove

# What is left of a finished cell, unless everything is kept.
KEPT = ("mission.json", "trajectory.csv", "scene.json", "config.json", "command.txt", "report.md")
# About how many seconds a segment takes: cells are sorted, and progress is measured, by it.
SECONDS = {"policy": 40.0, "mpc": 1.5, "guidance": 1.0, "reference": 5.0}


def cell_folder(out: Path, cell: Cell) -> RunFolder:
    """Return the folder in which a cell is flown."""
    return RunFolder(out / "cells" / cell.name)


def result_of(out: Path, cell: Cell) -> dict[str, Any] | None:
    """Return the cell's mission.json, or None if there is none, or one of another flight."""
    result = cell_folder(out, cell).read_json("mission.json")
    return result if result is not None and tuple(result["order"]) == cell.order else None


def arguments_of(
    cell: Cell, scene: Path, mission: Sequence[str], keep: bool
) -> tuple[str, tuple[str, ...]]:
    """Return the program that flies a cell and its arguments, without --out.

    A training that was stopped is gone on with.
    """
    order = ",".join(map(str, cell.order))
    common = ["--scene", str(scene), "--order", order, "--no-video", "--no-replay"]
    common += [] if keep else ["--no-plots"]
    if cell.planner == "policy":
        more = ["--seed", str(cell.seed), "--workers", "1", "--resume", "--policy", "none"]
        more += mission
        return "train.mission", (*common, *more)
    return "train.fly", (*common, "--planner", cell.planner, "--overwrite")


def fly_cells(
    out: Path, cells: Sequence[Cell], mission: Sequence[str], *, workers: int, ray: bool, keep: bool
) -> tuple[bool, dict[str, str]]:
    """Fly the cells that are not flown yet, the longest first.

    A flight without success is a result; a program that leaves none is an error, and the others go
    on.

    Args:
        out: folder of the run.
        cells: what is to be flown.
        mission: further arguments of `train.mission`.
        workers: how many cells are flown side by side in local processes.
        ray: whether to fly them on the cluster of `connect_ray` instead.
        keep: whether to leave everything in a cell's folder.

    Returns:
        Whether all were run (False: Ctrl-C), and by cell name what went wrong.
    """
    for cell in cells:
        if result_of(out, cell) is not None:
            tidy(out, cell, keep)  # in case of a stop right before
    todo = sorted((cell for cell in cells if result_of(out, cell) is None), key=_seconds)[::-1]
    if not todo:
        return True, {}
    jobs = []
    for index, cell in enumerate(todo):
        scene = (out / "scenes" / f"{cell.scene}.json").resolve()
        program, arguments = arguments_of(cell, scene, mission, keep)
        jobs.append(Job(index, arguments, cell_folder(out, cell).path.resolve(), program))
    errors: dict[str, str] = {}

    def finished(done: Done) -> None:
        cell = todo[done.job.index]
        result = result_of(out, cell)
        if result is None or done.code not in (0, 1):
            ended = errors[cell.name] = f"exit code {done.code}: {done.message}"
        else:
            tidy(out, cell, keep)
            ended = f"{result['mission_time']:.1f} s" if result["success"] else "no success"
        bar.write(f"{cell.name}: {ended}", file=sys.stderr)
        bar.update(_seconds(cell))

    with progress_bar(math.ceil(sum(map(_seconds, todo)))) as bar:
        bar.bar_format = "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        bar.write(f"{len(todo)} of {len(cells)} flights to be flown", file=sys.stderr)
        return run_jobs(RayWorkers() if ray else LocalWorkers(workers), jobs, finished), errors


def tidy(out: Path, cell: Cell, keep: bool) -> None:
    """Remove checkpoints, policies and pictures of a finished cell."""
    for path in cell_folder(out, cell).path.iterdir():
        if not keep and path.name not in KEPT:
            remove(path)


def _seconds(cell: Cell) -> float:
    return SECONDS[cell.planner] * (len(cell.order) + 1)
