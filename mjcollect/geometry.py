"""Distances between points, segments and axis-aligned boxes, vectorised over leading axes.

Boxes are arrays (..., 2, 3): minimum corner, maximum corner, in metres. A padding box has
minimum +inf and maximum +inf (see `EMPTY_BOX`), which lies infinitely far from everything.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAR = 1e9  # metres; where padding boxes are put: finite, so that no inf - inf appears
EMPTY_BOX = np.full((2, 3), FAR)


def nearest_point_offset(points: Array, boxes: Array) -> Array:
    """Vector from each point to the nearest point of each box; zero inside.

    Args:
        points: (..., 3). boxes: broadcastable (..., 2, 3).

    Returns:
        (..., 3) offsets in metres.
    """
    low, high = boxes[..., 0, :], boxes[..., 1, :]
    return np.clip(points, low, high) - points


def point_box_distance(points: Array, boxes: Array) -> Array:
    """Euclidean distance from points (..., 3) to boxes (..., 2, 3); zero inside. Shape (...)."""
    return np.asarray(np.linalg.norm(nearest_point_offset(points, boxes), axis=-1))


def segment_box_distance(start: Array, end: Array, boxes: Array) -> Array:
    """Exact distance between segments and boxes; zero where they meet.

    Args:
        start, end: (..., 3). boxes: broadcastable (..., 2, 3).

    Returns:
        (...) distances in metres.
    """
    from mjcollect import compiled, kernels  # numba takes a moment to import

    shape = np.broadcast_shapes(start.shape[:-1], end.shape[:-1], boxes.shape[:-2])
    gap = np.empty(shape)
    kernels.segment_gaps(
        compiled.rows(start, shape, (3,)),
        compiled.rows(end, shape, (3,)),
        compiled.rows(boxes, shape, (2, 3)),
        gap.reshape(-1),
    )
    return gap


def inflate(boxes: Array, margin: float | Array) -> Array:
    """Boxes (..., 2, 3) grown by `margin` metres on every side."""
    grow = np.asarray(margin, dtype=np.float64)[..., None]
    return np.stack([boxes[..., 0, :] - grow, boxes[..., 1, :] + grow], axis=-2)


def segment_clear(start: Array, end: Array, boxes: Array, radius: float) -> NDArray[np.bool_]:
    """Whether a body of `radius` metres flies each straight segment without touching any box.

    Args:
        start, end: (..., 3). boxes: (M, 2, 3).

    Returns:
        (...) booleans.
    """
    from mjcollect import compiled, kernels  # numba takes a moment to import

    shape = np.broadcast_shapes(start.shape[:-1], end.shape[:-1])
    clear = np.empty(shape, dtype=bool)
    kernels.segments_clear(
        compiled.rows(start, shape, (3,)),
        compiled.rows(end, shape, (3,)),
        compiled.plain(boxes),
        float(radius),
        clear.reshape(-1),
    )
    return clear
