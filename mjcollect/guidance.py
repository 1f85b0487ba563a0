"""Guidance to one goal: shortest free path length and direction from anywhere, and a tight path.

A distance field (fast marching) gives both; where the straight line to the goal is clear they are
exact. Where obstacles bend the way, a finer field covers the ellipsoid in which a shorter way
could lie, since gaps narrower than two cells are closed on a conservative grid.
"""

from __future__ import annotations

import itertools
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect import kernels
from mjcollect.compiled import plain
from mjcollect.distance_field import DistanceField
from mjcollect.geometry import Array, inflate, point_box_distance, segment_clear
from mjcollect.scene import Scene

COARSE, FINE = 100, 200  # cells along the longest axis: 10 m and 5 m in a 1 km cube
# Metres by which ways through the finer field may be longer than the coarse one: at most, and as a
# share of the bounds' longest side.
FINE_SLACK, FINE_SLACK_SHARE = 60.0, 0.06
AIM_ROOM = 2.0  # metres wanted between an aim and boxes or bounds
AIM_SHARE = 0.7  # of the tolerance: how far an aim may lie from its goal
SIGHT_CLEARANCE = 3.0  # metres beyond the body for the line of sight to the aim


class GuidanceError(ValueError):
    """No passage to the goal was found on the finest grid."""


class Way(NamedTuple):
    """The numbers that guidance is read from, see `kernels.query`; F fields, the finest last.

    Attributes:
        aim: (3,). keep: (M, 2, 3) boxes that a free line of sight to it misses.
        low, spacing: (F, 3) m. nodes: (F, 3), nodes along each axis.
        first: (F,) index of each field's first node in `values` (V,), in metres.
    """

    aim: Array
    keep: Array
    low: Array
    spacing: Array
    nodes: NDArray[np.int64]
    first: NDArray[np.int64]
    values: NDArray[np.float32]


class Guidance:
    """Shortest-path distance and direction to one node of a scene, from anywhere in the bounds.

    Attributes:
        goal: (3,) position of the target node. aim: (3,) point flown to: the goal, or the nearest
            point of its tolerance ball where the body fits.
        tolerance: metres within which the body must come to rest.
        path: (P, 3) the shortest tight free path found from `start` to the aim.
        way: what distance and direction are read from.
    """

    def __init__(self, scene: Scene, node: int, start: Array) -> None:
        """Build the fields.

        Args:
            scene: the scene. node: item index, or -1 for the depot.
            start: (3,) where the way begins; the finer field is made for it.

        Raises:
            GuidanceError: `start` and the goal are not connected on the finest grid.
        """
        self.scene, self.node, self.start = scene, node, start
        self.goal, self.tolerance = scene.point(node), scene.tolerance(node)
        self.aim = feasible_aim(scene, self.goal, self.tolerance)
        # Less clearance from a box that the aim is close to: else the aim would never be in sight.
        low, high = scene.obstacles[:, 0], scene.obstacles[:, 1]
        beside = np.maximum(low - self.aim, self.aim - high).max(axis=1)
        margin = np.clip(0.99 * beside, scene.uav_radius, scene.uav_radius + SIGHT_CLEARANCE)
        fields = [DistanceField(scene, self.aim, COARSE)]  # finest last
        self.path = self._find_path(start, fields)
        self.way = Way(
            aim=self.aim,
            keep=inflate(scene.obstacles, margin),
            low=np.stack([field.low for field in fields]),
            spacing=np.stack([field.h for field in fields]),
            nodes=np.array([field.filled.shape for field in fields], dtype=np.int64),
            first=np.cumsum([0, *(field.filled.size for field in fields[:-1])]),
            values=np.concatenate([field.filled.reshape(-1) for field in fields]),
        )

    def _find_path(self, start: Array, fields: list[DistanceField]) -> Array:
        """The shortest tight free path found; adds the finer field where the way bends."""
        scene, coarse, within = self.scene, None, None
        if fields[0].entry(start) is not None:
            coarse = way_down(fields[0], scene, start, self.aim)
            if len(coarse) == 2:
                return coarse
            slack = min(FINE_SLACK, FINE_SLACK_SHARE * float(np.ptp(scene.bounds, axis=0).max()))
            within = (start, path_length(coarse) + slack)
        fine = DistanceField(scene, self.aim, FINE, within)
        shortest = DistanceField(scene, self.aim, FINE, within, crowding=0.0)
        if fine.entry(start) is not None:
            fields.append(fine)
            ways = [way_down(field, scene, start, self.aim) for field in (fine, shortest)]
            return min(ways if coarse is None else [coarse, *ways], key=path_length)
        if coarse is None:
            raise GuidanceError(
                f"no passage from {start.tolist()} to {_name(self.node)} was found on a grid of "
                f"{np.max(fine.h):.3g} m: widen the gaps between the obstacles to two cells, or "
                "move the item"
            )
        return coarse

    @cached_property
    def length(self) -> float:
        """Metres of `path`, led to the goal itself where the aim is beside it."""
        to_goal = np.array([*self.path[:-1], self.goal])
        if segment_clear(to_goal[-2], self.goal, self.scene.obstacles, self.scene.uav_radius):
            return path_length(to_goal)
        return path_length(self.path) + float(np.linalg.norm(self.goal - self.aim))

    def query(self, q: Array) -> tuple[Array, Array]:
        """Shortest free path length (N,) in m and its unit direction (N, 3) from q (N, 3)."""
        distance, direction = np.empty(len(q)), np.empty((len(q), 3))
        kernels.query(self.way, np.arange(len(q)), plain(q), distance, direction)
        return distance, direction


def way_down(field: DistanceField, scene: Scene, start: Array, aim: Array) -> Array:
    """A tight free path (P, 3) from `start` down a field to its aim, both (3,).

    Raises:
        GuidanceError: the field does not join them.
    """
    points, node = [start], field.entry(start)
    while not segment_clear(points[-1], aim, scene.obstacles, scene.uav_radius):
        if node is None:
            raise GuidanceError(f"no way down from {points[-1].tolist()} to {aim.tolist()}")
        points.append(field.points(np.array(node)))
        node = field.descend(node)
    return tighten(np.array([*points, aim]), scene)


def path_length(points: Array) -> float:
    """Length in metres of a polyline (P, 3)."""
    return float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def tighten(points: Array, scene: Scene, rounds: int = 60) -> Array:
    """Shorten a free polyline (P, 3) while the body keeps clear of every box. (P', 3)."""
    radius, boxes = scene.uav_radius, scene.obstacles
    points = _skip(points, boxes, radius)
    if len(points) == 2:
        return points
    # Split the pieces so that corners can slide along edges, then pull every inner point towards
    # the line through its neighbours as far as both pieces stay clear.
    points = _split(points)
    for _ in range(rounds):
        before = points.copy()
        for i in range(1, len(points) - 1):
            points[i] = _pulled(points[i - 1], points[i], points[i + 1], boxes, radius)
        if np.max(np.abs(points - before)) < 1e-3:
            break
    return _skip(points, boxes, radius)


def _skip(points: Array, boxes: Array, radius: float) -> Array:
    """Drop the points between each kept one and the farthest that it sees."""
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


def _pulled(before: Array, point: Array, after: Array, boxes: Array, radius: float) -> Array:
    chord = after - before
    share = np.clip(np.dot(point - before, chord) / max(np.dot(chord, chord), 1e-12), 0.0, 1.0)
    foot = before + share * chord
    steps = np.linspace(1.0, 0.0, 17)[:, None]
    candidates = point + steps * (foot - point)
    clear = segment_clear(before, candidates, boxes, radius)
    clear &= segment_clear(candidates, after, boxes, radius)
    clear[-1] = True
    return np.asarray(candidates[int(np.argmax(clear))])


def feasible_aim(scene: Scene, goal: Array, tolerance: float) -> Array:
    """The point (3,) of a goal's ball to fly to: the goal, or where there is room around it.

    Nearest to the goal among those with the most room, up to AIM_ROOM metres, to boxes (beyond
    the body's radius) and to the bounds: an approach must not have to be exact to a millimetre
    where a wall is behind the goal, as at a depot in the corner of the cube.
    """
    steps = np.linspace(-AIM_SHARE, AIM_SHARE, 25) * tolerance
    ball = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    far = np.linalg.norm(ball, axis=1)
    near_first = np.argsort(far, kind="stable")
    near_first = near_first[far[near_first] <= AIM_SHARE * tolerance * (1 + 1e-9)]
    points = goal + ball[near_first]
    low, high = scene.bounds
    room = np.minimum(points - low, high - points).min(axis=1)
    if len(scene.obstacles):
        gap = point_box_distance(points[:, None], scene.obstacles).min(axis=1)
        room = np.minimum(room, gap - scene.uav_radius)
    room = np.minimum(room, AIM_ROOM)
    best = float(room.max())
    return np.asarray(points[int(np.argmax(room >= best - 1e-9))])


def _name(node: int) -> str:
    return "the depot" if node < 0 else f"items[{node}]"
