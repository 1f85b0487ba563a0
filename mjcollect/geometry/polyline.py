"""Measures polylines, finds places along them, and pulls them tight round boxes."""

from __future__ import annotations

import itertools

import numpy as np

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.tree import Tree

ROUNDS = 60  # Every point is pulled at most so often.


def marks(path: Array) -> Array:
    """Returns the metres (P,) along a polyline (P, 3) to each of its points."""
    length = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(length)])


def interpolate(points: Array, at_points: Array, at: float | Array) -> Array:
    """Returns the points (..., 3) of a polyline (P, 3) at the parameters `at` (...).

    Its own points have the parameters `at_points` (P,), such as `marks`.
    """
    return np.stack([np.interp(at, at_points, points[:, axis]) for axis in range(3)], axis=-1)


def point_along(path: Array, metres: float | Array) -> Array:
    """Returns points (..., 3) at `metres` (...) along a polyline (P, 3), or its end beyond that."""
    return interpolate(path, marks(path), metres)


def path_length(points: Array) -> float:
    """Returns the length in metres of a polyline (P, 3)."""
    return float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def tighten(points: Array, boxes: Tree | Array, radius: float, unit: float = 1.0) -> Array:
    """Shortens a free polyline (P, 3) to (P', 3) while it keeps `radius` metres from every box.

    Pieces that come closer than that already stay as they are. It ends when no point is moved by
    more than a thousandth of `unit` metres.
    """
    boxes = boxes if isinstance(boxes, Tree) else Tree.of(boxes)
    points = _skip(points, boxes, radius)
    if len(points) == 2:
        return points
    # Pieces are split so that corners can slide along edges; then every inner point is pulled
    # towards the line through its neighbours as far as both pieces stay clear.
    points = _split(points)
    for _ in range(ROUNDS):
        before = points.copy()
        for i in range(1, len(points) - 1):
            points[i] = _pulled(points[i - 1], points[i], points[i + 1], boxes, radius)
        if np.max(np.abs(points - before)) < 1e-3 * unit:
            break
    return _skip(points, boxes, radius)


def _skip(points: Array, boxes: Tree, radius: float) -> Array:
    """Drops the points between each kept one and the farthest with a clear straight way to it."""
    kept = [0]
    while kept[-1] < len(points) - 1:
        ahead = np.arange(kept[-1] + 1, len(points))
        clear = segment_clear(points[kept[-1]], points[ahead], boxes, radius)
        clear[0] = True
        kept.append(int(ahead[np.flatnonzero(clear)[-1]]))
    return points[kept]


def _split(points: Array) -> Array:
    parts = [points[:1]]
    for a, b in itertools.pairwise(points):
        share = np.linspace(0.0, 1.0, 3)[1:, None]
        parts.append(a + share * (b - a))
    return np.concatenate(parts)


def _pulled(before: Array, point: Array, after: Array, boxes: Tree, radius: float) -> Array:
    chord = after - before
    share = np.clip(np.dot(point - before, chord) / max(np.dot(chord, chord), 1e-12), 0.0, 1.0)
    foot = before + share * chord
    steps = np.linspace(1.0, 0.0, 17)[:, None]
    candidates = point + steps * (foot - point)
    clear = segment_clear(before, candidates, boxes, radius)
    clear &= segment_clear(candidates, after, boxes, radius)
    clear[-1] = True
    return np.asarray(candidates[int(np.argmax(clear))])
