"""Marks the cells of a grid that come too close to boxes; every other cell is free throughout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array, compiled, plain
from mjcollect.geometry.turns import around

Mask = NDArray[np.bool_]


def blocked_grid(
    bounds: Array, obstacles: Array, radius: float, shape: tuple[int, int, int]
) -> Mask:
    """Returns the conservative occupancy of a vertex-centred grid.

    Node i of axis k lies at low_k + i h_k with h_k = (high_k - low_k) / (shape_k - 1); its cell
    reaches h_k / 2 to each side.

    Args:
        bounds: (2, 3). obstacles: (M, 2 or 3, 3). radius: of the body (m). shape: nodes per axis,
            at least 2.

    Returns:
        Booleans of `shape`: True where any part of the cell is within `radius` of a box.
    """
    blocked = np.zeros(shape, dtype=bool)
    spacing = (bounds[1] - bounds[0]) / (np.array(shape) - 1)
    block(plain(bounds[0]), spacing, plain(obstacles), plain(around(obstacles)), radius, blocked)
    return blocked


@compiled
def block(
    low: Array, spacing: Array, boxes: Array, hulls: Array, radius: float, blocked: Mask
) -> None:
    """Compiled loop of `blocked_grid` over boxes, with the hulls (M, 2, 3) of turned ones."""
    first, last = np.empty(3, dtype=np.intp), np.empty(3, dtype=np.intp)
    for b in range(len(boxes)):
        for axis in range(3):
            first[axis], last[axis] = blocked.shape[axis], -1
            for i in range(blocked.shape[axis]):
                if beside(low, spacing, hulls[b], axis, i) < radius:
                    first[axis], last[axis] = min(first[axis], i), i
        for i in range(first[0], last[0] + 1):
            x = max(beside(low, spacing, hulls[b], 0, i), 0.0)
            for j in range(first[1], last[1] + 1):
                y = max(beside(low, spacing, hulls[b], 1, j), 0.0)
                level = x**2 + y**2
                if boxes.shape[1] == 3:
                    level = turned_gap(low, spacing, boxes[b], i, j)
                for k in range(first[2], last[2] + 1):
                    z = max(beside(low, spacing, hulls[b], 2, k), 0.0)
                    if level + z**2 < radius**2:
                        blocked[i, j, k] = True


@compiled
def beside(low: Array, spacing: Array, hull: Array, axis: int, i: int) -> float:
    """Returns how far (m) cell i of an axis lies beside a hull (2, 3); negative where it meets."""
    node = low[axis] + spacing[axis] * i
    return max(hull[0, axis] - node, node - hull[1, axis]) - spacing[axis] / 2


@compiled
def turned_gap(low: Array, spacing: Array, box: Array, i: int, j: int) -> float:
    """Returns the square (m²) of the distance that a column of cells keeps from a turned box.

    In the axes of the box (3, 3) a cell lies within a rectangle, whose distance is exact.
    """
    c, s, square = box[2, 0], box[2, 1], 0.0
    x, y = low[0] + spacing[0] * i, low[1] + spacing[1] * j
    wide, deep = spacing[0] / 2, spacing[1] / 2
    for axis in range(2):
        at = c * x + s * y if axis == 0 else c * y - s * x
        half = abs(c) * wide + abs(s) * deep if axis == 0 else abs(s) * wide + abs(c) * deep
        square += max(max(box[0, axis] - at, at - box[1, axis]) - half, 0.0) ** 2
    return square
