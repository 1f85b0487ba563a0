"""Finds planes that keep each piece of a planned path on the free side of the boxes near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import around, from_axes, in_axes

SIGHT = 40.0  # Planners have planes made for boxes within so many units of the scene.
_HALVINGS = 20  # The search for a piece's point nearest to a box halves the piece this often.


@dataclass(frozen=True)
class Planes:
    """Holds P half-spaces normal . x >= offset, each free of one box, for one piece of a path.

    Attributes:
        piece, box: (P,) indices of the piece and the box that the plane separates.
        normal: (P, 3) unit vectors pointing away from the box.
        offset: (P,) coordinate along the normal at which the box ends (m).
        clearance: (P,) distance from box to piece along the normal (m), negative on overlap.
    """

    piece: NDArray[np.intp]
    box: NDArray[np.intp]
    normal: Array
    offset: Array
    clearance: Array


def separate(path: Array, boxes: Array, sight: float = SIGHT) -> Planes:
    """Returns planes between the straight pieces of `path` (M + 1, 3) and boxes within `sight` m.

    `boxes` are (B, 2 or 3, 3), or (M, B, 2 or 3, 3) where each piece has boxes of its own. The
    normal joins the nearest points of piece and box, which gives the largest clearance that any
    plane can. Where they overlap it is the normal of the face with the shortest way out.
    """
    start, end, hull = path[:-1, None], path[1:, None], around(boxes)
    low, high = hull[..., 0, :], hull[..., 1, :]
    gap = np.maximum(low - np.maximum(start, end), np.minimum(start, end) - high)
    near = np.sum(np.maximum(gap, 0.0) ** 2, axis=-1) < sight**2
    piece, box = np.nonzero(near)
    boxes = np.broadcast_to(boxes, (*near.shape, *boxes.shape[-2:]))[piece, box]
    # In the boxes' own axes; rotation keeps what is measured along a normal.
    start, end = in_axes(path[piece], boxes), in_axes(path[piece + 1], boxes)
    low, high = boxes[:, 0], boxes[:, 1]
    point = _nearest_point(start, end, low, high)
    normal = point - np.clip(point, low, high)
    distance = np.linalg.norm(normal, axis=1)
    normal = normal / np.maximum(distance, 1e-9)[:, None]
    ways_out = np.concatenate([np.minimum(start, end) - high, low - np.maximum(start, end)], axis=1)
    face = ways_out.argmax(axis=1)
    outwards = np.concatenate([np.eye(3), -np.eye(3)])[face]
    normal = np.where((distance < 1e-3)[:, None], outwards, normal)
    offset = np.sum(np.where(normal > 0, high, low) * normal, axis=1)
    lowest = np.minimum(np.sum(normal * start, axis=1), np.sum(normal * end, axis=1))
    return Planes(piece, box, from_axes(normal, boxes), offset, lowest - offset)


def _nearest_point(start: Array, end: Array, low: Array, high: Array) -> Array:
    """Returns the point (P, 3) of each piece nearest to its box.

    Bisection finds it, because the distance to a box is convex along a line.
    """
    step = end - start
    left, right = np.zeros((len(start), 1)), np.ones((len(start), 1))
    for _ in range(_HALVINGS):
        middle = (left + right) / 2
        point = start + middle * step
        rising = np.sum((point - np.clip(point, low, high)) * step, axis=1, keepdims=True) > 0
        left, right = np.where(rising, left, middle), np.where(rising, middle, right)
    return np.asarray(start + (left + right) / 2 * step)
