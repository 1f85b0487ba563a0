"""Thins a flown path to few waypoints whose straight legs are as free as the path itself."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mjcollect.geometry.boxes import segment_gaps
from mjcollect.geometry.compiled import Array, Indices, plain


def thin(path: Array, kept: Iterable[int], boxes: Array, clear: float, off: float) -> Indices:
    """Returns the rows of a path (R, 3) that are kept as waypoints.

    A leg is halved at the point farthest from it, as by Ramer, Douglas and Peucker, until no point
    of the path is more than `off` metres away and it keeps `clear` metres from all boxes (M, 2, 3).
    Pieces of the path itself are never halved.

    Args:
        kept: rows that are kept in any case; the first and last row always are.
    """
    ends = np.union1d(np.fromiter(kept, int), [0, len(path) - 1])
    legs, out = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)), ends.tolist()
    while legs:
        first, last = legs.pop()
        if last - first < 2:
            continue
        distance = distances(path[first + 1 : last], path[first], path[last])
        if distance.max() <= off and is_clear(path[first], path[last], boxes, clear):
            continue
        middle = first + 1 + int(distance.argmax())
        if distance.max() < 1e-6:  # a straight piece with a box beside it
            middle = (first + last) // 2
        out.append(middle)
        legs += [(first, middle), (middle, last)]
    return np.array(sorted(out), dtype=np.intp)


def distances(points: Array, start: Array, end: Array) -> Array:
    """Returns the distances (n,) in m of points (n, 3) to the piece from start to end (3,)."""
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


def is_clear(start: Array, end: Array, boxes: Array, clear: float) -> bool:
    """Returns whether the piece from start to end (3,) keeps `clear` metres from boxes."""
    gap, count = np.empty(len(boxes)), len(boxes)
    one, two = (plain(np.broadcast_to(point, (count, 3))) for point in (start, end))
    segment_gaps(one, two, plain(boxes), gap)
    return bool(np.all(gap >= clear))
