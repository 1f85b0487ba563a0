"""When the shield acted in a recorded flight: shield.csv beside trajectory.csv."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjcollect.geometry import Array

NAME = "shield.csv"
HEADER = "begin,end"


def intervals(acted: Sequence[bool], slot: float) -> Array:
    """Seconds (n, 2) from begin to end of each run of slots in which the shield acted.

    Args:
        acted: for each slot of `slot` seconds, from the first on.
    """
    edges = np.diff(np.concatenate([[0], np.asarray(acted, dtype=int), [0]]))
    pairs = np.stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)], axis=1)
    return np.asarray(pairs * slot)


def save(path: str | os.PathLike[str], when: Array) -> None:
    """Write intervals (n, 2); `repr` of a float reads back to the same float."""
    lines = [",".join(map(repr, row)) for row in when.tolist()]
    Path(path).write_text("\n".join([HEADER, *lines]) + "\n", encoding="ascii")


def load(path: str | os.PathLike[str]) -> Array:
    """Intervals (n, 2) written by `save`; none where there is no file, as in older runs.

    Raises:
        ValueError: the header or a row is not as written by `save`.
    """
    if not Path(path).is_file():
        return np.empty((0, 2))
    lines = Path(path).read_text(encoding="ascii").splitlines()
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    if lines[:1] != [HEADER] or any(len(row) != 2 for row in rows):
        raise ValueError(f"{path}: must have the header {HEADER!r} and two numbers a row")
    return np.array(rows).reshape(-1, 2)
