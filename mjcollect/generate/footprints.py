"""Covers footprints of buildings with few turned rectangles.

A footprint is covered by its smallest enclosing rectangle. While that adds too much area, the
footprint is cut in two across the rectangle, where both parts' rectangles are smallest, and each
part is covered by itself. The rectangles always hold the whole footprint.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from mjcollect.geometry.compiled import Array

EXCESS = 0.1  # A rectangle adds at most this share to the area of what it covers,
LEAST_EXCESS = 4.0  # or so many m²,
DEEPEST = 7  # unless it has been cut so often.
_CUTS = np.linspace(0.1, 0.9, 9)  # Cuts are tried at these shares of a rectangle's sides,
_CORNERS = 16  # and at the corners of a footprint with no more than so many.
_SLIVER = 0.05  # m²; parts that are smaller are left out.
_GRID = 0.01  # metres to which corners are rounded, or cuts along a wall would leave slivers of it.


class Rectangle:
    """Holds a rectangle: its centre (2,), half its sides (2,) in m, and its yaw in degrees."""

    def __init__(self, outline: Any, grow: float = 0.0) -> None:
        """Measures a shapely rectangle, grown by some metres on all sides."""
        corners = shapely.get_coordinates(outline)[:4]
        one, two = corners[1] - corners[0], corners[2] - corners[1]
        self.centre = corners.mean(axis=0)
        self.half = np.array([np.linalg.norm(one), np.linalg.norm(two)]) / 2 + grow
        self.yaw = float(np.degrees(np.arctan2(one[1], one[0])))

    @property
    def axes(self) -> Array:
        """Returns unit vectors (2, 2) along its sides."""
        angle = np.radians(self.yaw)
        return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def smallest(part: Any, window: Any | None) -> Any:
    """Returns the smallest rectangle around a polygon; upright if a turned one left the window."""
    outline = shapely.oriented_envelope(part)
    if window is not None and not shapely.covers(window, outline):
        outline = shapely.envelope(part)
    return outline


def cover(footprint: Any, excess: float = EXCESS, window: Any | None = None) -> list[Rectangle]:
    """Returns rectangles that hold a footprint.

    Args:
        footprint: a valid shapely Polygon in metres, holes allowed. excess: share of its area that
            the rectangles may add. window: a polygon that they must lie in, as the footprint does.
    """
    parts, found = [footprint], []
    if window is not None:  # with room for what rounding takes off
        window = shapely.buffer(window, -2 * _GRID, join_style="mitre")
        parts = polygons(shapely.intersection(footprint, window))
    todo = [(part, 0) for part in parts]
    while todo:
        part, depth = todo.pop()
        outline = smallest(part, window)
        added = outline.area - part.area
        if added > max(excess * part.area, LEAST_EXCESS) and depth < DEEPEST:
            halves = _cut(part, Rectangle(outline), window)
            if halves:
                todo += [(half, depth + 1) for half in halves]
                continue
        found.append(Rectangle(outline, _GRID))  # what rounding took off
    return found


def _cut(part: Any, around: Rectangle, window: Any | None) -> list[Any]:
    """Returns the polygons that a footprint is best cut into across one side of its rectangle."""
    corners = shapely.get_coordinates(part)
    seen = (corners - around.centre) @ around.axes.T
    best, least = [], np.inf
    for side in range(2):
        size = around.half[side]
        at = seen[:, side]
        places = np.unique(np.round(at[np.abs(at) < size - 0.5], 3))
        if len(corners) > _CORNERS or len(places) == 0:
            places = size * (2 * _CUTS - 1)
        for place in places:
            halves = [_half(part, around, side, place, sign) for sign in (-1, 1)]
            pieces = [piece for half in halves for piece in polygons(half)]
            if min(half.area for half in halves) < _SLIVER:
                continue
            area = sum(smallest(piece, window).area for piece in pieces)
            if area < least:
                best, least = pieces, area
    return best


def _half(part: Any, around: Rectangle, side: int, place: float, sign: int) -> Any:
    """Returns what of a part lies on one side of a line across its rectangle."""
    far, other = 2 * around.half[side] + 1.0, around.half[1 - side] + 1.0
    ends = sorted([place, sign * far])
    corners = [[ends[0], -other], [ends[1], -other], [ends[1], other], [ends[0], other]]
    local = np.array(corners) if side == 0 else np.array(corners)[:, ::-1]
    side_of = shapely.Polygon(around.centre + local @ around.axes)
    return shapely.intersection(part, side_of, grid_size=_GRID)


def polygons(shape: Any) -> list[Any]:
    """Returns the polygons that a shape consists of; lines and points are left out."""
    parts = shapely.get_parts(shape)
    nested = [each for part in parts for each in shapely.get_parts(part)]
    return [part for part in nested if part.geom_type == "Polygon" and part.area >= _SLIVER]
