"""Marks the cells of a grid that come too close to boxes; every other cell is free throughout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array
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
    spacing = (bounds[1] - bounds[0]) / (np.array(shape) - 1)
    blocked = np.zeros(shape, dtype=bool)
    nodes = [bounds[0, k] + spacing[k] * np.arange(shape[k]) for k in range(3)]
    for box, hull in zip(obstacles, around(obstacles), strict=True):
        squares, spans = [], []
        for axis, node in enumerate(nodes):
            clearance = np.maximum(hull[0, axis] - node, node - hull[1, axis]) - spacing[axis] / 2
            near = np.flatnonzero(clearance < radius)
            spans.append(slice(near[0], near[-1] + 1) if len(near) else slice(0))
            squares.append(np.maximum(clearance[spans[-1]], 0.0) ** 2)
        x, y, z = squares
        level = x[:, None] + y
        if len(box) == 3:
            level = _turned(nodes[0][spans[0]], nodes[1][spans[1]], spacing / 2, box)
        blocked[tuple(spans)] |= level[:, :, None] + z < radius**2
    return blocked


def _turned(x: Array, y: Array, half: Array, box: Array) -> Array:
    """Returns the squared distances (X, Y) in m² that cells keep at least from a turned box.

    In the box's axes a cell lies within a rectangle, whose distance is exact.

    Args:
        x, y: the cells' middles (m). half: (3,) half their sizes (m). box: (3, 3).
    """
    c, s = box[2, 0], box[2, 1]
    across, up = c * x[:, None] + s * y, c * y - s * x[:, None]
    square = np.zeros((len(x), len(y)))
    for axis, at, size in (
        (0, across, abs(c) * half[0] + abs(s) * half[1]),
        (1, up, abs(s) * half[0] + abs(c) * half[1]),
    ):
        square += np.maximum(np.maximum(box[0, axis] - at, at - box[1, axis]) - size, 0.0) ** 2
    return square
