"""Marks the cells of a grid that come too close to boxes; every other cell is free throughout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array

Mask = NDArray[np.bool_]


def blocked_grid(
    bounds: Array, obstacles: Array, radius: float, shape: tuple[int, int, int]
) -> Mask:
    """Returns the conservative occupancy of a vertex-centred grid.

    Node i of axis k lies at low_k + i h_k with h_k = (high_k - low_k) / (shape_k - 1); its cell
    reaches h_k / 2 to each side.

    Args:
        bounds: (2, 3). obstacles: (M, 2, 3). radius: of the body (m). shape: nodes per axis, >= 2.

    Returns:
        Booleans of `shape`: True where any part of the cell is within `radius` of a box.
    """
    spacing = (bounds[1] - bounds[0]) / (np.array(shape) - 1)
    blocked = np.zeros(shape, dtype=bool)
    for box in obstacles:
        squares, spans = [], []
        for axis in range(3):
            node = bounds[0, axis] + spacing[axis] * np.arange(shape[axis])
            clearance = np.maximum(box[0, axis] - node, node - box[1, axis]) - spacing[axis] / 2
            near = np.flatnonzero(clearance < radius)
            spans.append(slice(near[0], near[-1] + 1) if len(near) else slice(0))
            squares.append(np.maximum(clearance[spans[-1]], 0.0) ** 2)
        x, y, z = squares
        blocked[tuple(spans)] |= x[:, None, None] + y[:, None] + z < radius**2
    return blocked
