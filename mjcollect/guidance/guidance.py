"""Guides to one goal: by length and direction of the shortest free path from anywhere.

Where a waypoint of the tight path is in sight, both are exact along it. Elsewhere a distance field
(fast marching) gives them. Where obstacles bend the path, a finer field covers the ellipsoid in
which a shorter one could lie: a conservative grid closes passages narrower than two cells.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array, plain
from mjcollect.geometry.polyline import path_length, tighten
from mjcollect.guidance.aim import AIM_ROOM, choose_aim, room_at, room_to_boxes
from mjcollect.guidance.distance_field import DistanceField, NoWay, way_down
from mjcollect.guidance.way import Way, query_rows
from mjcollect.guidance.waypoints import Waypoints
from mjcollect.scene.scene import Scene

# Fields have so many cells along the longest axis: of 20 m, 10 m and 5 m in a 1 km cube.
WIDE, COARSE, FINE = 50, 100, 200
# The coarse field holds paths longer than the wide field's by the greater of two margins: these
# shares of the bounds' longest side, and of the path.
COARSE_SHARE, COARSE_SHARE_OF_PATH = 0.1, 0.3
# The finer field holds paths longer than the coarse field's by a margin of at most so many metres,
# and at most this share of the bounds' longest side.
FINE_MARGIN, FINE_SHARE = 60.0, 0.06
STOP_SHARE = 0.98  # A stop is planned at most this share of the tolerance from its goal.
MARGIN_SHARE = 0.8  # `Guidance.slack` is this share of what the aim leaves of the tolerance.


class GuidanceError(ValueError):
    """Says that no passage to the goal was found, or that slots are too long to steer in."""


class Guidance:
    """Gives distance and direction of the shortest free path to one node, from anywhere in bounds.

    Attributes:
        goal: (3,), position of the target node. aim: (3,), point of its tolerance ball flown to.
        tolerance: metres from the goal within which the body must come to rest. slack: metres
            along the path by which a stop may miss the aim.
        path: (P, 3), the shortest tight free path found from `start` to the aim.
        way: the numbers that distance and direction are read from.
    """

    def __init__(
        self,
        scene: Scene,
        node: int,
        start: Array,
        next_goal: Array | None = None,
        built: tuple[Array, Way] | None = None,
    ) -> None:
        """Builds the fields and the path.

        Args:
            scene: the scene. node: item index, or -1 for the depot.
            start: (3,), where the path begins; the finer field is made for it.
            next_goal: (3,), where the tour goes on to, if it does.
            built: `path` and `way` of the same guidance, from a file of `guidance.cache`.

        Raises:
            GuidanceError: `start` and the goal are not connected on the finest grid, or one slot of
                full acceleration leads farther than the bounds are wide.
        """
        leap, extent = scene.a_max * scene.slot**2 / 2, float(np.ptp(scene.bounds, axis=0).max())
        if leap > extent:
            raise GuidanceError(
                f"slot: {scene.slot} s: too long to steer in: one slot at a_max leads {leap:.3g} m "
                f"far, the bounds are {extent:.3g} m wide; shorten slot or lower a_max"
            )
        self.scene, self.node, self.start, self.next_goal = scene, node, start, next_goal
        self.goal, self.tolerance = scene.point(node), scene.tolerance(node)
        self.aim = choose_aim(scene, self.goal, self.tolerance, start, next_goal)
        self.slack = MARGIN_SHARE * (self.tolerance - float(np.linalg.norm(self.aim - self.goal)))
        if built is not None:
            self.path, self.way = built
            return
        fields = self._coarse_fields(start)  # finest last
        self.path, ways = self._find_path(start, fields)
        self.way = Way(
            **Waypoints.of(scene, self.path, ways)._asdict(),
            stop=self._best_stop(),
            unit=np.array([scene.unit]),
            low=np.stack([field.low for field in fields]),
            spacing=np.stack([field.h for field in fields]),
            nodes=np.array([field.filled.shape for field in fields], dtype=np.int64),
            first=np.cumsum([0, *(field.filled.size for field in fields[:-1])]),
            values=np.concatenate([field.filled.reshape(-1) for field in fields]),
        )

    def _coarse_fields(self, start: Array) -> list[DistanceField]:
        """Returns a wide field and a coarse one where paths can lead, or only a coarse one."""
        scene, wide = self.scene, DistanceField(self.scene, self.aim, WIDE)
        if wide.entry(start) is not None:
            length = path_length(self._tight(self._way_down(wide, start)))
            longest = float(np.ptp(scene.bounds, axis=0).max())
            margin = max(COARSE_SHARE * longest, COARSE_SHARE_OF_PATH * length)
            coarse = DistanceField(scene, self.aim, COARSE, (start, length + margin))
            if coarse.entry(start) is not None:
                return [wide, coarse]
        return [DistanceField(scene, self.aim, COARSE)]

    def _find_path(self, start: Array, fields: list[DistanceField]) -> tuple[Array, list[Array]]:
        """Returns the shortest tight free path found, and the paths that were tightened.

        It appends the finer field to `fields` where the path bends.
        """
        scene, within = self.scene, None
        ways: list[Array] = []
        if fields[-1].entry(start) is not None:
            ways.append(self._way_down(fields[-1], start))
            if len(ways[0]) == 2:
                return ways[0], ways
            margin = min(FINE_MARGIN, FINE_SHARE * float(np.ptp(scene.bounds, axis=0).max()))
            within = (start, path_length(self._tight(ways[0])) + margin)
        fine = DistanceField(scene, self.aim, FINE, within)
        if fine.entry(start) is not None:
            shortest = DistanceField(scene, self.aim, FINE, within, crowding=0.0)
            fields.append(fine)
            ways += [self._way_down(field, start) for field in (fine, shortest)]
        if not ways:
            raise GuidanceError(
                f"no passage from {start.tolist()} to {_name(self.node)} was found on a grid of "
                f"{np.max(fine.h):.3g} m: one of them is walled in, or behind gaps narrower than "
                "two cells; widen the gaps between the obstacles, or move it"
            )
        return min((self._tight(way) for way in ways), key=path_length), ways

    def _way_down(self, field: DistanceField, start: Array) -> Array:
        try:
            return way_down(field, self.scene, start, self.aim)
        except NoWay as error:
            raise GuidanceError(str(error)) from None

    def _tight(self, way: Array) -> Array:
        return tighten(way, self.scene.tree, self.scene.reach, self.scene.unit)

    def _best_stop(self) -> Array:
        """Returns `Way.stop`: a point towards where the tour goes on, or else the aim."""
        radius = STOP_SHARE * self.tolerance
        around = self.tolerance + AIM_ROOM * self.scene.unit
        if self.next_goal is None and room_to_boxes(self.scene, self.goal[None])[0] >= around:
            return np.append(self.aim, radius)  # bounds do not matter to what comes from within
        if self.next_goal is None or room_at(self.scene, self.goal[None])[0] < around:
            return np.append(self.aim, 0.0)
        to_next = self.next_goal - self.goal
        far = float(np.linalg.norm(to_next))
        return np.append(self.goal + to_next / max(far, 1e-9) * min(radius, far), radius)

    @cached_property
    def length(self) -> float:
        """Returns the metres of `path`, led on to the goal itself where the aim is beside it."""
        to_goal = np.array([*self.path[:-1], self.goal])
        if segment_clear(to_goal[-2], self.goal, self.scene.tree, self.scene.reach):
            return path_length(to_goal)
        return path_length(self.path) + float(np.linalg.norm(self.goal - self.aim))

    def query(self, q: Array) -> tuple[Array, Array]:
        """Returns length (N,) in m and direction (N, 3) of the shortest free path from q (N, 3)."""
        distance, direction = np.empty(len(q)), np.empty((len(q), 3))
        query_rows(self.way, np.arange(len(q)), plain(q), distance, direction)
        return distance, direction


def _name(node: int) -> str:
    return "the depot" if node < 0 else f"items[{node}]"
