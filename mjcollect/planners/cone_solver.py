"""Builds cone programs row by row and solves them with Clarabel.

The problem is: minimise z' P z / 2 + cost . z subject to A z + s = b, s in a product of cones.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mjcollect.geometry.compiled import Array

SOLVED = ("Solved", "AlmostSolved")  # Clarabel's statuses whose solution is used.
MOST_ITERATIONS = 60  # Clarabel gives up after this many interior-point iterations.


@dataclass
class Rows:
    """Gathers the rows of A z + s = b, with s in a product of cones, block by block."""

    count: int = 0
    row: list[NDArray[np.intp]] = field(default_factory=list)
    column: list[NDArray[np.intp]] = field(default_factory=list)
    value: list[Array] = field(default_factory=list)
    right: list[Array] = field(default_factory=list)
    cones: list[object] = field(default_factory=list)

    def add(
        self, right: Array, *terms: tuple[NDArray[np.intp], Array | float], cone: int = 1
    ) -> None:
        """Adds R rows, of which each run of `cone` rows forms one cone.

        Args:
            right: (R,) right-hand sides b.
            terms: pairs of columns and values, (R,) or (R, n): the entries of A in row r. An entry
                in column -1 is dropped.
            cone: 1, or 4 for second-order cones, in which row 0 bounds the norm of rows 1 to 3.
        """
        for column, value in terms:
            row = (self.count + np.arange(len(right))).reshape(-1, *[1] * (column.ndim - 1))
            row, column, value = np.broadcast_arrays(row, column, value)
            known = column >= 0
            self.row.append(row[known])
            self.column.append(column[known])
            self.value.append(value[known])
        self.right.append(right)
        self.count += len(right)
        if cone == 4:
            self.cones += [clarabel.SecondOrderConeT(4)] * (len(right) // 4)


def norms(rows: Rows, limit: float, *terms: tuple[NDArray[np.intp], float]) -> None:
    """Adds n constraints |sum of columns (n, 3) times values| <= limit."""
    count = len(terms[0][0])
    right = np.zeros((count, 4))
    right[:, 0] = limit
    nothing = np.full((count, 1), -1)
    padded = [(np.hstack([nothing, column]).ravel(), -value) for column, value in terms]
    rows.add(right.ravel(), *padded, cone=4)


def within(
    rows: Rows,
    at_point: NDArray[np.intp],
    centre: Array,
    *,
    radius: float = 0.0,
    at_radius: int = -1,
) -> None:
    """Adds the constraint |point - centre| <= radius + the variable in column `at_radius`.

    Args:
        at_point: (3,) columns of the point. centre: (3,) m. radius: m. at_radius: -1 for none.
    """
    right = np.concatenate([[radius], -centre])
    rows.add(right, (np.concatenate([[at_radius], at_point]), -1.0), cone=4)


def settings() -> clarabel.DefaultSettings:
    """Returns new Clarabel settings: no output, one thread, at most MOST_ITERATIONS."""
    chosen = clarabel.DefaultSettings()
    chosen.verbose = False
    chosen.max_threads = 1
    chosen.max_iter = MOST_ITERATIONS
    return chosen


def minimise(
    quadratic: sparse.csc_matrix,
    cost: Array,
    matrix: sparse.csc_matrix,
    right: Array,
    cones: list[object],
    chosen: clarabel.DefaultSettings,
    statuses: Counter[str],
) -> Array | None:
    """Returns the best z (n,), or None if the solver finds no solution.

    Args:
        quadratic: upper triangle of P (n, n). cost: (n,). matrix: A (m, n). right: b (m,).
        cones: Clarabel's cones, in the order of the rows. chosen: Clarabel's settings.
        statuses: counts the solver's statuses; one is added.
    """
    solver = clarabel.DefaultSolver(quadratic, cost, matrix, right, cones, chosen)
    result = solver.solve()
    status = str(result.status)
    statuses[status] += 1
    return np.array(result.x) if status in SOLVED else None
