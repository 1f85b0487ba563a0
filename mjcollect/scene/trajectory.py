"""Holds a recorded flight, one row per physics step, and saves it as CSV with every digit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length

HEADER = "t,x,y,z,vx,vy,vz,ax,ay,az"
SHIELD_FILE = "shield.csv"
SHIELD_HEADER = "begin,end"


@dataclass(frozen=True)
class Trajectory:
    """Holds in row k the state at t_k and the acceleration that acts until t_{k+1}.

    v_{k+1} = v_k + a_k dt, x_{k+1} = x_k + v_{k+1} dt; straight between rows; last row a = 0.

    Attributes:
        t: (R,) s.
        x: (R, 3) m.
        v: (R, 3) m/s.
        a: (R, 3) m/s^2.
    """

    t: Array
    x: Array
    v: Array
    a: Array

    def __post_init__(self) -> None:
        """Raises a ValueError where rows disagree or there are none."""
        rows = len(self.t)
        if rows == 0 or any(part.shape != (rows, 3) for part in (self.x, self.v, self.a)):
            raise ValueError(
                f"trajectory: t {self.t.shape}, x {self.x.shape}, v {self.v.shape}, "
                f"a {self.a.shape}: needs (R,) and three times (R, 3) with R >= 1"
            )

    def __len__(self) -> int:
        """Returns the number of rows."""
        return len(self.t)

    @property
    def duration(self) -> float:
        """Returns the seconds from the first to the last row."""
        return float(self.t[-1] - self.t[0])

    @property
    def length(self) -> float:
        """Returns the length of the flown path in metres."""
        return path_length(self.x)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the CSV file of the flight; `load` gives back the same floats."""
        _write(path, HEADER, np.column_stack([self.t, self.x, self.v, self.a]))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Reads a CSV file written by `save`.

        Raises:
            ValueError: the header or a row is not as written by `save`.
        """
        rows = _read(path, HEADER)
        return cls(rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7:10])


class Recorder:
    """Collects rows slot by slot; the acceleration of a row is known with the next one."""

    def __init__(self, x: Array, v: Array, step: float) -> None:
        """Starts at position `x` (3,) and velocity `v` (3,); `step` is the physics step in s."""
        self._step = step
        self._x, self._v, self._a = [x[None].copy()], [v[None].copy()], [np.empty((0, 3))]

    def slot(self, x: Array, v: Array, a: Array) -> None:
        """Adds the physics steps of one slot: x, v (n, 3), flown with the command a (3,)."""
        self._x.append(x.copy())
        self._v.append(v.copy())
        self._a.append(np.tile(a, (len(x), 1)))

    def trajectory(self) -> Trajectory:
        """Returns what was recorded so far."""
        x, v, a = (np.concatenate(parts) for parts in (self._x, self._v, self._a))
        t = np.arange(len(x), dtype=np.float64) * self._step
        return Trajectory(t, x, v, np.append(a, np.zeros((1, 3)), axis=0))


def shield_intervals(acted: Sequence[bool], slot: float) -> Array:
    """Returns the seconds (n, 2) from begin to end of each run of slots in which the shield acted.

    Args:
        acted: whether it acted, for each slot from the first on.
        slot: a slot's duration in s.
    """
    edges = np.diff(np.asarray(acted, dtype=int), prepend=0, append=0)
    return np.asarray(np.flatnonzero(edges).reshape(-1, 2) * slot)


def save_shield(path: str | os.PathLike[str], when: Array) -> None:
    """Writes intervals (n, 2) in seconds; `load_shield` gives back the same floats."""
    _write(path, SHIELD_HEADER, when)


def load_shield(path: str | os.PathLike[str]) -> Array:
    """Returns intervals (n, 2) in seconds; none where there is no file, as in older runs.

    Raises:
        ValueError: the header or a row is not as written by `save_shield`.
    """
    return _read(path, SHIELD_HEADER) if Path(path).is_file() else np.empty((0, 2))


def _write(path: str | os.PathLike[str], header: str, rows: Array) -> None:
    """Writes a CSV file; `repr` of a float reads back to the same float."""
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    Path(path).write_text("\n".join([header, *lines]) + "\n", encoding="ascii")


def _read(path: str | os.PathLike[str], header: str) -> Array:
    """Returns the rows (R, C) of a CSV file with a header of C columns."""
    width = len(header.split(","))
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
        cells = [line.split(",") for line in lines[1:]]
        if lines[:1] != [header] or any(len(row) != width for row in cells):
            raise ValueError("another header, or a row of another length")
        return np.array(cells, dtype=float).reshape(-1, width)
    except ValueError as error:
        wanted = f"needs the header {header!r} and {width} numbers in every row"
        raise ValueError(f"{path}: {wanted} ({error})") from None
