"""Cone programs put together row by row and solved by Clarabel.

Minimise z' P z / 2 + cost . z subject to A z + s = b with s in a product of cones.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mjcollect.geometry.compiled import Array

SOLVED = ("Solved", "AlmostSolved")
MOST_ITERATIONS = 60


@dataclass
class Rows:
    """Rows of A z + s = b with s in a product of cones, gathered block by block."""

    count: int = 0
    row: list[NDArray[np.intp]] = field(default_factory=list)
    column: list[NDArray[np.intp]] = field(default_factory=list)
    value: list[Array] = field(default_factory=list)
    right: list[Array] = field(default_factory=list)
    cones: list[object] = field(default_factory=list)

    def add(
        self, right: Array, *terms: tuple[NDArray[np.intp], Array | float], cone: int = 1
    ) -> None:
        """Rows with right-hand sides `right` (R,), each in a cone of dimension `cone`.

        Args:
            terms: columns and values, (R,) or (R, n): what row r holds. Column -1 is nothing.
                In a cone of 4, row 0 of each is its height.
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
    """|sum of columns (n, 3) times values| <= limit, n times."""
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
    """|point - centre| <= radius, which is a number or a variable; columns (3,), centre (3,)."""
    right = np.concatenate([[radius], -centre])
    rows.add(right, (np.concatenate([[at_radius], at_point]), -1.0), cone=4)


def settings() -> clarabel.DefaultSettings:
    """Quiet, on one thread."""
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
    """The best z (n,), None without a solution; counts the solver's status.

    Args:
        quadratic: upper triangle of P (n, n). cost: (n,). matrix: A (m, n). right: b (m,).
    """
    solver = clarabel.DefaultSolver(quadratic, cost, matrix, right, cones, chosen)
    result = solver.solve()
    status = str(result.status)
    statuses[status] += 1
    return np.array(result.x) if status in SOLVED else None
