"""Decides how many slots each segment of a mission gets, by a small model of all segments.

A segment flown in M whole slots covers at most `reach(M)` metres. Its way leads from stop to stop
round fixed corners, so its length is a convex function of the two stops. An allotment, which is a
number of slots for each segment, is enough if there are stops in their balls for which no way is
longer than its slots reach; the length left over on every segment at once is the allotment's
margin. Each answer is one cone program of about a millisecond.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import clarabel
import numpy as np
from scipy import sparse

from mjcollect.geometry.compiled import Array
from mjcollect.planners.cone_solver import Rows, minimise, settings, within
from mjcollect.scene.scene import Scene

Slots = tuple[int, ...]


@dataclass(frozen=True)
class Route:
    """Holds how a segment's length depends on its stops.

    Attributes:
        corners: (P, 3) fixed points between its stops (m); P may be 0.
        toll: extra length that stands for the cost of turning (m).
    """

    corners: Array
    toll: float

    @property
    def fixed(self) -> float:
        """Returns the length from the first corner to the last plus the toll (m)."""
        return float(np.linalg.norm(np.diff(self.corners, axis=0), axis=1).sum()) + self.toll


def reach(scene: Scene, slots: int) -> float:
    """Returns the greatest distance (m) on a line from rest to rest in a number of slots.

    The velocity at slot starts is the least of ramp up, v_max and ramp down. From rest to rest,
    semi-implicit steps cover the sum of these velocities times the slot.
    """
    k = np.arange(slots + 1)
    ramp = scene.a_max * scene.slot * np.minimum(k, slots - k)
    return float(np.minimum(ramp, scene.v_max).sum() * scene.slot)


def least_slots(scene: Scene, distance: float) -> int:
    """Returns the least number of slots, at least 1, from rest to rest over a distance (m)."""
    slots = 1
    while reach(scene, slots) < distance:
        slots += max(1, int((distance - reach(scene, slots)) / (scene.v_max * scene.slot)))
    return slots


class Allotments:
    """Computes and remembers the margins of allotments for the L segments of one mission."""

    def __init__(
        self,
        scene: Scene,
        start: Array,
        balls: Sequence[tuple[Array, float]],
        routes: Sequence[Route],
    ) -> None:
        """Builds the program that all allotments share.

        Args:
            start: (3,) point where the first segment begins (m). balls: centre (3,) and radius (m)
                of the ball in which each segment ends. routes: route of each segment.
        """
        self._scene, self._start = scene, start
        self._known = dict[Slots, tuple[float, Array]]()
        self._fixed = [route.fixed for route in routes]
        count = len(routes)
        at_stop = np.arange(3 * count).reshape(-1, 3)
        at_out, at_in = at_stop.size + np.arange(2 * count).reshape(2, -1)
        at_margin = 5 * count
        rows = Rows()
        # Constraint out + in + margin <= reach - fixed; `_solve` fills in the right-hand sides.
        rows.add(np.zeros(count), (at_out, 1.0), (at_in, 1.0), (np.full(count, at_margin), 1.0))
        rows.add(np.zeros(count), (at_in, -1.0))
        for wall, side in zip(scene.bounds, (-1.0, 1.0), strict=True):
            rows.add(np.tile(side * (wall - start), count), (at_stop.ravel(), side))
        rows.cones = [clarabel.NonnegativeConeT(rows.count)]
        for k, (centre, radius) in enumerate(balls):
            within(rows, at_stop[k], centre - start, radius=radius)
            corners = routes[k].corners - start
            before = at_stop[k - 1] if k else np.full(3, -1)
            if len(corners):
                within(rows, before, corners[0], at_radius=int(at_out[k]))
                within(rows, at_stop[k], corners[-1], at_radius=int(at_in[k]))
            else:
                column = np.concatenate([at_out[k : k + 1], at_stop[k]])
                less = np.concatenate([[-1], before])
                rows.add(np.zeros(4), (column, -1.0), (less, 1.0), cone=4)
        self._right, self._cones = np.concatenate(rows.right), rows.cones
        row, column = np.concatenate(rows.row), np.concatenate(rows.column)
        entries = np.concatenate(rows.value), (row, column)
        self._matrix = sparse.csc_matrix(entries, shape=(rows.count, at_margin + 1))
        self._none = sparse.csc_matrix((at_margin + 1, at_margin + 1))
        self._cost = np.zeros(at_margin + 1)
        self._cost[-1] = -1.0
        self._settings, self.statuses = settings(), Counter[str]()

    def margin(self, slots: Slots) -> float:
        """Returns the length left over on every segment (m), negative if slots are too few."""
        return self._solve(slots)[0]

    def stops(self, slots: Slots) -> Array:
        """Returns the stops (L, 3) of all segments with that margin (m)."""
        return self._solve(slots)[1]

    def _solve(self, slots: Slots) -> tuple[float, Array]:
        if slots not in self._known:
            right = self._right.copy()
            for k, (number, fixed) in enumerate(zip(slots, self._fixed, strict=True)):
                right[k] = reach(self._scene, number) - fixed
            best = minimise(
                self._none, self._cost, self._matrix, right, self._cones, self._settings,
                self.statuses,
            )  # fmt: skip
            if best is None:
                self._known[slots] = -np.inf, np.full((len(slots), 3), np.nan)
            else:
                stops = self._start + best[: 3 * len(slots)].reshape(-1, 3)
                self._known[slots] = float(best[-1]), stops
        return self._known[slots]

    def fewer(self, slots: Slots) -> list[Slots]:
        """Returns allotments with one slot less in all, those with the best margins first."""
        less = [_moved(slots, k, None) for k in range(len(slots)) if slots[k] > 1]
        if not less:
            return []
        best = max(less, key=self.margin)
        tried = {best}
        while True:
            segments = range(len(best))
            shifts = [
                _moved(best, i, j) for i in segments for j in segments if i != j and best[i] > 1
            ]
            tried.update(shifts)
            better = max(shifts, key=self.margin, default=best)
            if self.margin(better) <= self.margin(best) + 1e-6:
                return sorted(tried, key=self.margin, reverse=True)
            best = better


def _moved(slots: Slots, taken: int, given: int | None) -> Slots:
    """Returns `slots` with one slot taken from a segment and given to another, or to none."""
    new = list(slots)
    new[taken] -= 1
    if given is not None:
        new[given] += 1
    return tuple(new)
