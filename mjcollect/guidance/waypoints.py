"""Places waypoints, the corners of a path to fly, with clearance to cut them at speed.

A body that turns with a_max from one straight piece into the next cuts the corner between them by
v^2 |u - w|^2 / (8 a_max), u and w being the directions before and after. So corners are moved
outwards by what a body at v_max would cut, as far as boxes allow, and each knows how much it may
be cut and so how fast it may be flown.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.boxes import inflate
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length, tighten
from mjcollect.geometry.tree import Tree
from mjcollect.geometry.turns import in_axes
from mjcollect.guidance.distance_field import WAY_ROOM
from mjcollect.scene.scene import Scene

# Distances are in units of the scene, see `Scene.unit`.
CLEARANCES = (WAY_ROOM, 1.5, 0.75)  # Clearances that are tried in turn.
SIGHT_SHARE = 0.3  # A line of sight to a waypoint keeps this share of the clearance.
STRAIGHT_SIGHT = 1.5  # Clearance of the line of sight to the aim on a straight path
SHIFT_SHARE = 0.4  # A corner that is moved out keeps this share of the clearance.
CUT_SHARE = 0.5  # A turn may cut this share of the clearance.
MOST_SHIFT = 15.0  # A corner is moved out by this at most.
ENDS = 12.0  # A path may keep less clearance so far from either end.
LEAST_CUT = 0.1  # A turn may cut every corner by this at least.


class Waypoints(NamedTuple):
    """Holds a path from a start to an aim as P points without the start; the last is the aim.

    Attributes:
        points: (P, 3) m. remaining: (P,) m, from each point along the others to the aim.
        next_direction: (P, 3), unit vectors to the next point.
        cut: (P,) m, by how much a turn may cut each corner.
        tree: of the M boxes. margin: (P, M) m, by how much the boxes are inflated for each point; a
            point is in sight where the line to it misses all. most_margin: (P,) the most of each.
    """

    points: Array
    remaining: Array
    next_direction: Array
    cut: Array
    tree: Tree
    margin: Array
    most_margin: Array

    @classmethod
    def of(cls, scene: Scene, path: Array, ways: Sequence[Array]) -> Waypoints:
        """Returns the waypoints of the shortest of the paths with most clearance.

        Args:
            path: (P, 3), the tight path, start and aim included. ways: free polylines (P, 3) with
                the same ends, not tight.
        """
        boxes, radius, unit = scene.tree, scene.reach, scene.unit
        if len(path) == 2 and _keeps(path, boxes, radius + STRAIGHT_SIGHT * unit):
            return cls._from(scene, path, np.zeros(2), STRAIGHT_SIGHT * unit)
        for clearance in np.array(CLEARANCES) * unit:
            tight = [tighten(way, boxes, radius + clearance, unit) for way in ways]
            tight = [
                way
                for way in tight
                if _keeps_midway(way, boxes, radius + 0.99 * clearance, ENDS * unit)
            ]
            if tight:
                way = min(tight, key=path_length)
                way, shift = _moved_out(way, scene, radius + SHIFT_SHARE * clearance)
                return cls._from(scene, way, shift + CUT_SHARE * clearance, SIGHT_SHARE * clearance)
        return cls._from(scene, path, np.zeros(len(path)), 0.0)

    @classmethod
    def _from(cls, scene: Scene, way: Array, cut: Array, sight: float) -> Waypoints:
        steps = np.diff(way, axis=0)
        length = np.linalg.norm(steps, axis=1)
        units = steps / np.maximum(length, 1e-9)[:, None]
        boxes, kept = scene.boxes, []
        low, high = boxes[:, 0], boxes[:, 1]
        for before, point in itertools.pairwise(way):
            # A box close to the point is inflated less, or the point would never be in sight.
            at = in_axes(point, boxes)
            beside = np.maximum(low - at, at - high).max(axis=1)
            margin = np.clip(0.9 * beside, scene.reach, scene.reach + sight)
            # The corners of inflated boxes must not hide it from the point before it either.
            for less in (scene.reach, scene.reach / np.sqrt(3)):
                hidden = _crosses(before, point, inflate(boxes, margin))
                margin = np.where(hidden, less, margin)
            kept.append(margin)
        return cls(
            points=way[1:].copy(),
            remaining=np.append(np.cumsum(length[:0:-1])[::-1], 0.0),
            next_direction=np.concatenate([units[1:], units[-1:]]),
            cut=cut[1:] + LEAST_CUT * scene.unit,
            tree=scene.tree,
            margin=np.stack(kept),
            most_margin=np.max(kept, axis=1, initial=0.0),
        )


def _keeps(way: Array, boxes: Tree, radius: float) -> bool:
    return all(bool(segment_clear(a, b, boxes, radius)) for a, b in itertools.pairwise(way))


def _keeps_midway(way: Array, boxes: Tree, radius: float, least: float) -> bool:
    """Returns whether a way keeps `radius` but for its first and last `least` metres.

    There it may have to come nearer, to a goal beside a wall.
    """
    kept = np.array([_keeps(way[i : i + 2], boxes, radius) for i in range(len(way) - 1)])
    if not kept.any():
        return False
    first, last = np.flatnonzero(kept)[[0, -1]]
    ends = path_length(way[: first + 1]), path_length(way[last + 1 :])
    return bool(kept[first : last + 1].all()) and max(ends) <= least


def _crosses(start: Array, end: Array, boxes: Array) -> NDArray[np.bool_]:
    """Returns which (M,) boxes (M, 2, 3) the segment between two points (3,) meets."""
    at, step = (np.atleast_2d(in_axes(vector, boxes)) for vector in (start, end - start))
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    share = (boxes[:, :2] - at[:, None]) / step[:, None]
    enter, leave = share.min(axis=1).max(axis=1), share.max(axis=1).min(axis=1)
    return np.asarray((enter <= leave) & (leave >= 0.0) & (enter <= 1.0))


def _moved_out(way: Array, scene: Scene, radius: float) -> tuple[Array, Array]:
    """Returns the way (P, 3) with corners moved out while it keeps `radius`, and the shifts (m)."""
    way, shift = way.copy(), np.zeros(len(way))
    for i in range(1, len(way) - 1):
        before, after = way[i] - way[i - 1], way[i + 1] - way[i]
        reach = min(np.linalg.norm(before), np.linalg.norm(after))
        turn = before / np.linalg.norm(before) - after / np.linalg.norm(after)
        size = float(np.linalg.norm(turn))
        if size < 1e-3:
            continue
        speed = min(scene.v_max, np.sqrt(2 * scene.a_max * reach))
        out = min((speed * size) ** 2 / (8 * scene.a_max), MOST_SHIFT * scene.unit)
        while out > LEAST_CUT * scene.unit / 2:
            moved = np.clip(way[i] + turn / size * out, *scene.bounds)
            corner = np.stack([way[i - 1], moved, way[i + 1]])
            if _keeps(corner, scene.tree, radius):
                way[i], shift[i] = moved, out
                break
            out /= 2
    return way, shift
