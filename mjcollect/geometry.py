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

    The squared distance along a segment is convex and piecewise quadratic, so its derivative is
    piecewise linear and rising: the minimum is found at the sign change between two breakpoints.

    Args:
        start, end: (..., 3). boxes: broadcastable (..., 2, 3).

    Returns:
        (...) distances in metres.
    """
    start, end, low, high = np.broadcast_arrays(start, end, boxes[..., 0, :], boxes[..., 1, :])
    step = end - start
    safe = np.where(step == 0.0, 1.0, step)
    moving = step != 0.0
    # Where each coordinate enters and leaves the slab of the box, as a fraction of the segment.
    cuts = np.concatenate(
        [
            np.where(moving, (low - start) / safe, 0.0),
            np.where(moving, (high - start) / safe, 0.0),
            np.zeros((*start.shape[:-1], 1)),
            np.ones((*start.shape[:-1], 1)),
        ],
        axis=-1,
    )
    cuts = np.sort(np.clip(cuts, 0.0, 1.0), axis=-1)
    at = start[..., None, :] + cuts[..., None] * step[..., None, :]  # (..., 8, 3)
    over = at - np.clip(at, low[..., None, :], high[..., None, :])
    slope = np.sum(over * step[..., None, :], axis=-1)  # half the derivative, rising
    right = np.argmax(slope >= 0.0, axis=-1)
    right = np.where(slope[..., -1] < 0.0, cuts.shape[-1] - 1, right)[..., None]
    left = np.maximum(right - 1, 0)
    slope_r = np.take_along_axis(slope, right, -1)
    slope_l = np.take_along_axis(slope, left, -1)
    cut_r = np.take_along_axis(cuts, right, -1)
    cut_l = np.take_along_axis(cuts, left, -1)
    rise = slope_r - slope_l
    share = np.where(rise > 0.0, -slope_l / np.where(rise > 0.0, rise, 1.0), 1.0)
    best = cut_l + np.clip(share, 0.0, 1.0) * (cut_r - cut_l)
    nearest = start + best * step
    gap = nearest - np.clip(nearest, low, high)
    return np.asarray(np.linalg.norm(gap, axis=-1))


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
    if len(boxes) == 0:
        return np.ones(np.broadcast_shapes(start.shape, end.shape)[:-1], dtype=bool)
    distance = segment_box_distance(start[..., None, :], end[..., None, :], boxes)
    return np.asarray(np.all(distance >= radius, axis=-1))
