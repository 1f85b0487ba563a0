"""Holds what the benchmarks share: drawn segments, timing in turns, tables, files of results."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import statistics
import string
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from mjcollect.envs.course import Course
from mjcollect.guidance.guidance import GuidanceError
from train.jobs.processes import importing_pool
from train.jobs.segment_pool import draw_segment
from train.support.markdown import markdown_table
from train.support.run_folder import RunFolder, versions

J, R, K = TypeVar("J"), TypeVar("R"), TypeVar("K")
Row = dict[str, Any]


@dataclass(frozen=True)
class Output:
    """Holds the flag that all benchmarks have."""

    out: Path | None = None
    """JSON file for the results."""


def segment_course(
    seed: int, number: int, layout: str | None = None, guidance: Path | None = None
) -> Course | None:
    """Returns the course of a generated segment; None where the guidance finds no way.

    `guidance` is a folder from which it is loaded where it fits.
    """
    try:
        return Course.segment(*draw_segment(seed, number, layout), guidance)
    except GuidanceError:
        return None


def in_processes(work: Callable[[J], R], jobs: Sequence[J], workers: int) -> Iterator[R]:
    """Yields what `work` returns for each job, in their order, and shows how far it is."""
    with importing_pool(workers) as pool:
        yield from tqdm(pool.map(work, jobs), total=len(jobs))


@dataclass
class Rates:
    """Holds what a way did in each round, per CPU-second of all its threads and per second."""

    per_cpu_second: list[float] = field(default_factory=list)
    per_second: list[float] = field(default_factory=list)


def measure_rates(ways: Mapping[K, Callable[[], float]], rounds: int) -> dict[K, Rates]:
    """Lets the ways take turns, so that a busy machine slows all of them.

    Each works for a while and returns how much it did.
    """
    rates = {way: Rates() for way in ways}
    for _ in range(rounds):
        for way, work in ways.items():
            cpu, wall = time.process_time(), time.perf_counter()
            done = work()
            rates[way].per_cpu_second.append(done / (time.process_time() - cpu))
            rates[way].per_second.append(done / (time.perf_counter() - wall))
    return rates


def median_ratio(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """Returns the median of the ratio over the rounds, in each of which both were measured."""
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))


def grouped(rows: Sequence[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Returns the rows by their values of `keys`, in the order in which these first appear."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


class _Format(string.Formatter):
    def format_field(self, value: Any, spec: str) -> str:
        return "-" if value is None else format(value, spec)


def print_table(rows: Sequence[Row], columns: Sequence[tuple[str, str]]) -> None:
    """Prints a Markdown table; a column has a name, and a format for a row (None: a dash)."""
    cells = [[_Format().format(form, **row) for _, form in columns] for row in rows]
    print("\n".join(markdown_table([name for name, _ in columns], cells)), flush=True)


def load_rows(path: Path | None) -> list[Row]:
    """Returns the results that a file of `save` holds, to go on from; none without a file."""
    if path is None or not path.is_file():
        return []
    rows: list[Row] = json.loads(path.read_text())["results"]
    return rows


def save(
    path: Path | None,
    content: Mapping[str, Any],
    args: Any = None,
    peers: Mapping[str, str] | None = None,
) -> None:
    """Writes a JSON file, whole or not at all, with machine and versions; nothing without a path.

    Args:
        args: the program's arguments, of which `out` is left blank. peers: further versions.
    """
    if path is None:
        return
    document = {
        **({} if args is None else {"arguments": {**dataclasses.asdict(args), "out": None}}),
        "machine": {"cpus": os.cpu_count(), "processor": platform.machine()},
        "versions": {**versions(), **(peers or {})},
        **content,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    RunFolder(path.parent).write_text(path.name, json.dumps(document, indent=1, default=str) + "\n")
