"""Turns boxes about the vertical.

A box (2, 3) is parallel to the axes. A turned box (3, 3) has a third row, (cos, sin, 0) of its yaw,
and the first two rows are its corners in axes that are turned so about the world's origin: there
it is parallel to them. Rotation keeps lengths, so distances are computed in these axes. With a
yaw of 0 both kinds are the same box, to the bit.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.compiled import Array, compiled

FLOOR = [0, 4, 6, 2]  # corners of a box's floor in `corners`, counterclockwise
FORWARD = (1.0, 0.0, 0.0)  # the third row of a box that is not turned


@compiled
def along(box: Array, vector: Array, k: int) -> float:
    """Returns component k of a vector (3,) in the axes of a box (2 or 3, 3)."""
    if len(box) == 2 or k == 2:
        return float(vector[k])
    if k == 0:
        return float(box[2, 0] * vector[0] + box[2, 1] * vector[1])
    return float(box[2, 0] * vector[1] - box[2, 1] * vector[0])


@compiled
def turn_back(box: Array, vector: Array) -> None:
    """Turns a vector (3,) in the axes of a box (2 or 3, 3) into those of the world."""
    if len(box) == 3:
        x, y = vector[0], vector[1]
        vector[0] = box[2, 0] * x - box[2, 1] * y
        vector[1] = box[2, 1] * x + box[2, 0] * y


@compiled
def is_near(low: Array, high: Array, reach: float, box: Array) -> bool:
    """Returns whether a box (2 or 3, 3) may come within `reach` metres of what lies low to high."""
    if len(box) == 2:
        for k in range(3):
            if low[k] - reach > box[1, k] or box[0, k] > high[k] + reach:
                return False
        return True
    if low[2] - reach > box[1, 2] or box[0, 2] > high[2] + reach:
        return False
    c, s = box[2, 0], box[2, 1]
    x, y = (box[0, 0] + box[1, 0]) / 2, (box[0, 1] + box[1, 1]) / 2
    wide, deep = (box[1, 0] - box[0, 0]) / 2, (box[1, 1] - box[0, 1]) / 2
    for k in range(2):
        middle = c * x - s * y if k == 0 else s * x + c * y
        half = abs(c) * wide + abs(s) * deep if k == 0 else abs(s) * wide + abs(c) * deep
        if low[k] - reach > middle + half or middle - half > high[k] + reach:
            return False
    return True


def turned(boxes: Array, yaw: Array) -> Array:
    """Returns boxes (M, 2, 3), each turned about its centre by a yaw (M,) in degrees.

    They are the same (M, 2, 3) if no yaw is given, else (M, 3, 3).
    """
    if not np.any(yaw):
        return boxes
    angle = np.radians(yaw)
    out = with_turn(boxes)
    # Right angles are exact: a wall stays the plane that it is.
    right = np.mod(yaw, 90.0) == 0.0
    out[:, 2, 0] = np.where(right, np.rint(np.cos(angle)), np.cos(angle))
    out[:, 2, 1] = np.where(right, np.rint(np.sin(angle)), np.sin(angle))
    centre, half = boxes.mean(axis=1), np.diff(boxes, axis=1)[:, 0] / 2
    local = in_axes(centre, out)
    out[:, :2] = np.where(
        (yaw == 0.0)[:, None, None], boxes, np.stack([local - half, local + half], axis=1)
    )
    return out


def with_turn(boxes: Array) -> Array:
    """Returns boxes (..., 2 or 3, 3) with the row that says how they are turned."""
    if boxes.shape[-2] == 3:
        return boxes.copy()
    row = np.broadcast_to(np.array([FORWARD]), (*boxes.shape[:-2], 1, 3))
    return np.concatenate([boxes, row], axis=-2)


def joined(boxes: Array, more: Array, axis: int) -> Array:
    """Returns boxes of both arrays, (..., 2 or 3, 3) each, along an axis."""
    if boxes.shape[-2] != more.shape[-2]:
        boxes, more = with_turn(boxes), with_turn(more)
    return np.concatenate([boxes, more], axis=axis)


def in_axes(vectors: Array, boxes: Array) -> Array:
    """Returns vectors (..., 3) in the axes of boxes (..., 2 or 3, 3), broadcast."""
    return _rotated(vectors, boxes, -1.0)


def from_axes(vectors: Array, boxes: Array) -> Array:
    """Returns in the world's axes vectors (..., 3) that are in those of boxes, broadcast."""
    return _rotated(vectors, boxes, 1.0)


def _rotated(vectors: Array, boxes: Array, sense: float) -> Array:
    if boxes.shape[-2] == 2:
        return vectors
    c, s = boxes[..., 2, 0], sense * boxes[..., 2, 1]
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    level = [c * x - s * y, s * x + c * y]
    return np.stack([*level, np.broadcast_to(z, level[0].shape)], axis=-1)


def corners(boxes: Array) -> Array:
    """Returns the corners (..., 8, 3) of boxes (..., 2 or 3, 3); z changes fastest, then y."""
    which = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    local = boxes[..., which, np.arange(3)]
    return from_axes(local, boxes[..., None, :, :])


def around(boxes: Array) -> Array:
    """Returns the smallest boxes (..., 2, 3) parallel to the axes that hold boxes."""
    if boxes.shape[-2] == 2:
        return boxes
    at = corners(boxes)
    return np.stack([at.min(axis=-2), at.max(axis=-2)], axis=-2)


def inside(boxes: Array) -> Array:
    """Returns boxes (..., 2, 3) parallel to the axes inside of boxes (..., 2 or 3, 3)."""
    if boxes.shape[-2] == 2:
        return boxes
    half = np.diff(boxes[..., :2, :], axis=-2)[..., 0, :] / 2
    centre = from_axes(boxes[..., :2, :].mean(axis=-2), boxes)
    c, s = np.abs(boxes[..., 2, 0]), np.abs(boxes[..., 2, 1])
    wide, deep = half[..., 0], half[..., 1]
    share = np.minimum(wide / (c * wide + s * deep), deep / (s * wide + c * deep))
    level = half * np.stack([share, share, np.ones_like(share)], axis=-1)
    return np.stack([centre - level, centre + level], axis=-2)
