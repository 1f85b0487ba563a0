"""Computes distances between points, segments and boxes.

A box is an array (..., 2, 3) of its minimum and maximum corner, in metres, or (..., 3, 3) if it may
be turned, see `geometry.turns`; below, (2, 3) stands for both. `EMPTY_BOX` pads arrays of scenes
with fewer boxes. Compiled functions take one point or segment at a time; the functions
below them are vectorised over leading axes.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.geometry.compiled import Array, compiled, rows
from mjcollect.geometry.turns import along, from_axes, in_axes, turn_back
from mjcollect.geometry.vectors import norm

FAR = 1e9  # Padding boxes lie this many metres away: finite, so that no inf - inf appears.
EMPTY_BOX = np.full((2, 3), FAR)


@compiled
def box_offset(point: Array, box: Array, offset: Array) -> float:
    """Returns the distance (m) to a box; writes the vector to its nearest point to `offset`."""
    for k in range(3):
        at = along(box, point, k)
        offset[k] = min(max(at, box[0, k]), box[1, k]) - at
    turn_back(box, offset)
    return norm(offset)


@compiled
def slab(start: Array, step: Array, box: Array, grow: float, tiny: float) -> tuple[float, float]:
    """Returns where (t) the line start + t step enters and leaves a box grown by `grow` metres.

    The line misses the box if enter > leave. Components of `step` smaller than `tiny` count as it.
    """
    enter, leave = -np.inf, np.inf
    for k in range(3):
        at, rate = along(box, start, k), along(box, step, k)
        rate = rate if abs(rate) >= tiny else tiny
        one = (box[0, k] - grow - at) / rate
        two = (box[1, k] + grow - at) / rate
        enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter, leave


@compiled
def box_slope(start: Array, end: Array, box: Array, t: float) -> float:
    """Returns half of d/dt of the squared distance of start + t (end - start) to a box."""
    slope = 0.0
    for k in range(3):
        begin = along(box, start, k)
        step = along(box, end, k) - begin
        at = begin + t * step
        slope += (at - min(max(at, box[0, k]), box[1, k])) * step
    return slope


@compiled
def segment_gap(start: Array, end: Array, box: Array) -> float:
    """Returns the exact distance in metres between a segment and a box; zero where they meet.

    The squared distance is convex, and its derivative is linear between the planes of the faces:
    it changes sign between the last plane with a falling slope and the first with a rising one.
    """
    left, right = 0.0, 1.0
    falling, rising = box_slope(start, end, box, left), box_slope(start, end, box, right)
    if falling >= 0.0:
        nearest = left
    elif rising <= 0.0:
        nearest = right
    else:
        for k in range(3):
            begin = along(box, start, k)
            step = along(box, end, k) - begin
            for side in range(2):
                t = (box[side, k] - begin) / step if step != 0.0 else 0.0
                if left < t < right:
                    slope = box_slope(start, end, box, t)
                    if slope < 0.0:
                        left, falling = t, slope
                    else:
                        right, rising = t, slope
        nearest = left + falling / (falling - rising) * (right - left)
    square = 0.0
    for k in range(3):
        begin = along(box, start, k)
        at = begin + nearest * (along(box, end, k) - begin)
        square += (at - min(max(at, box[0, k]), box[1, k])) ** 2
    return math.sqrt(square)


@compiled
def segment_gaps(start: Array, end: Array, boxes: Array, gap: Array) -> None:
    """Writes to `gap` (n,) the `segment_gap` of each of n pairs of a segment and a box."""
    for i in range(len(start)):
        gap[i] = segment_gap(start[i], end[i], boxes[i])


def nearest_point_offset(points: Array, boxes: Array) -> Array:
    """Returns the vector from each point to the nearest point of each box; zero inside.

    Args:
        points: (..., 3). boxes: broadcastable (..., 2, 3).

    Returns:
        (..., 3) offsets in metres.
    """
    low, high, at = boxes[..., 0, :], boxes[..., 1, :], in_axes(points, boxes)
    return from_axes(np.clip(at, low, high) - at, boxes)


def point_box_distance(points: Array, boxes: Array) -> Array:
    """Returns the distances (...) in m of points (..., 3) from boxes (..., 2, 3); zero inside."""
    return np.asarray(np.linalg.norm(nearest_point_offset(points, boxes), axis=-1))


def segment_box_distance(start: Array, end: Array, boxes: Array) -> Array:
    """Returns the exact distance between segments and boxes; zero where they meet.

    Args:
        start, end: (..., 3). boxes: broadcastable (..., 2, 3).

    Returns:
        (...) distances in metres.
    """
    shape = np.broadcast_shapes(start.shape[:-1], end.shape[:-1], boxes.shape[:-2])
    gap = np.empty(shape)
    segment_gaps(
        rows(start, shape, (3,)),
        rows(end, shape, (3,)),
        rows(boxes, shape, boxes.shape[-2:]),
        gap.reshape(-1),
    )
    return gap


def inflate(boxes: Array, margin: float | Array) -> Array:
    """Returns boxes (..., 2, 3) grown by `margin` metres on every side."""
    grow = np.asarray(margin, dtype=np.float64)[..., None, None]
    low, high, turn = boxes[..., :1, :], boxes[..., 1:2, :], boxes[..., 2:, :]
    return np.concatenate([low - grow, high + grow, turn], axis=-2)
