"""A recorded flight: one row per physics step, saved as CSV with full float precision."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjcollect.geometry.compiled import Array

HEADER = "t,x,y,z,vx,vy,vz,ax,ay,az"


@dataclass(frozen=True)
class Trajectory:
    """Row k holds the state at t_k and the acceleration that acts until t_{k+1}.

    v_{k+1} = v_k + a_k dt, x_{k+1} = x_k + v_{k+1} dt; straight between rows; last row a = 0.

    Attributes:
        t: (R,) s. x: (R, 3) m. v: (R, 3) m/s. a: (R, 3) m/s^2.
    """

    t: Array
    x: Array
    v: Array
    a: Array

    def __post_init__(self) -> None:
        """Check shapes.

        Raises:
            ValueError: rows disagree or there are none.
        """
        rows = len(self.t)
        if rows == 0 or any(part.shape != (rows, 3) for part in (self.x, self.v, self.a)):
            raise ValueError(
                f"trajectory: t {self.t.shape}, x {self.x.shape}, v {self.v.shape}, "
                f"a {self.a.shape}: needs (R,) and three times (R, 3) with R >= 1"
            )

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.t)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last row."""
        return float(self.t[-1] - self.t[0])

    @property
    def length(self) -> float:
        """Flown path length in metres."""
        return float(np.sum(np.linalg.norm(np.diff(self.x, axis=0), axis=1)))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the CSV of the contract; `repr` of a float reads back to the same float."""
        rows = np.column_stack([self.t, self.x, self.v, self.a])
        lines = [",".join(map(repr, row)) for row in rows.tolist()]
        Path(path).write_text("\n".join([HEADER, *lines]) + "\n", encoding="ascii")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read a CSV written by `save`.

        Raises:
            ValueError: the header or a row is not as written by `save`.
        """
        lines = Path(path).read_text(encoding="ascii").splitlines()
        if not lines or lines[0] != HEADER:
            raise ValueError(f"{path}: header {lines[:1]}: must be {HEADER!r}")
        rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
        if rows.ndim != 2 or rows.shape[1] != 10:
            raise ValueError(f"{path}: {rows.shape}: every row needs 10 numbers")
        return cls(rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7:10])


class Recorder:
    """Collects rows slot by slot; the acceleration of a row is known with the next one."""

    def __init__(self, x: Array, v: Array, step: float) -> None:
        """Start at rest or in motion at `x` (3,), `v` (3,); `step` is the physics step in s."""
        self._step = step
        self._x, self._v, self._a = [x.copy()], [v.copy()], []  # type: list, list, list

    def slot(self, x: Array, v: Array, a: Array) -> None:
        """Add the physics steps of one slot: x, v (n, 3), flown with the command a (3,)."""
        self._x.extend(x.copy())
        self._v.extend(v.copy())
        self._a.extend([a.copy()] * len(x))

    def trajectory(self) -> Trajectory:
        """What was recorded so far."""
        count = len(self._x)
        a = np.array([*self._a, np.zeros(3)])
        return Trajectory(
            np.arange(count, dtype=np.float64) * self._step, np.array(self._x), np.array(self._v), a
        )


SHIELD_FILE = "shield.csv"
SHIELD_HEADER = "begin,end"


def shield_intervals(acted: Sequence[bool], slot: float) -> Array:
    """Seconds (n, 2) from begin to end of each run of slots in which the shield acted.

    Args:
        acted: for each slot of `slot` seconds, from the first on.
    """
    edges = np.diff(np.concatenate([[0], np.asarray(acted, dtype=int), [0]]))
    pairs = np.stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)], axis=1)
    return np.asarray(pairs * slot)


def save_shield(path: str | os.PathLike[str], when: Array) -> None:
    """Write intervals (n, 2); `repr` of a float reads back to the same float."""
    lines = [",".join(map(repr, row)) for row in when.tolist()]
    Path(path).write_text("\n".join([SHIELD_HEADER, *lines]) + "\n", encoding="ascii")


def load_shield(path: str | os.PathLike[str]) -> Array:
    """Intervals (n, 2) written by `save`; none where there is no file, as in older runs.

    Raises:
        ValueError: the header or a row is not as written by `save`.
    """
    if not Path(path).is_file():
        return np.empty((0, 2))
    lines = Path(path).read_text(encoding="ascii").splitlines()
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    if lines[:1] != [SHIELD_HEADER] or any(len(row) != 2 for row in rows):
        raise ValueError(f"{path}: must have the header {SHIELD_HEADER!r} and two numbers a row")
    return np.array(rows).reshape(-1, 2)
