"""Decides how many slots each segment of a mission gets, by a small model of all segments.

A segment flown in M whole slots covers at most `reach(M)` metres. Its way leads from stop to stop
round fixed corners, so its length is a convex function of the two stops. Beside a box a body at
v_max turns on a circle of radius v_max^2 / a_max, so a way round corners takes longer than its
length says: a segment that was flown in M slots counts as no shorter than `reach(M - 1)`. An
allotment, which is a number of slots for each segment, is enough if there are stops in their balls
for which no way is longer than its slots reach; the length left over on every segment at once is
the allotment's margin. Each answer is one cone program of about a millisecond.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import clarabel
import numpy as np
from scipy import sparse

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import path_length
from mjcollect.planners.cone_solver import Rows, minimise, settings, within
from mjcollect.scene.scene import Scene

Slots = tuple[int, ...]


def fastest(scene: Scene, slots: int) -> Array:
    """Returns the speeds (slots + 1,) in m/s at slot starts of the farthest motion on a line.

    From rest to rest, each is the least of ramp up, v_max and ramp down.
    """
    k = np.arange(slots + 1)
    ramp = scene.a_max * scene.slot * np.minimum(k, slots - k)
    return np.minimum(ramp, scene.v_max)


def reach(scene: Scene, slots: int) -> float:
    """Returns the greatest distance (m) on a line from rest to rest in a number of slots.

    From rest to rest, semi-implicit steps cover the sum of the speeds times the slot.
    """
    return float(fastest(scene, slots).sum() * scene.slot)


class Allotments:
    """Computes and remembers the margins of allotments for the L segments of one mission."""

    def __init__(
        self,
        scene: Scene,
        balls: Sequence[tuple[Array, float]],
        ways: Sequence[Array],
        flown: Slots,
        statuses: Counter[str],
    ) -> None:
        """Builds the program that all allotments share.

        Args:
            balls: centre (3,) and radius (m) of the ball in which each segment ends.
            ways: tight polyline (P, 3) of each segment in m, its stops included. flown: number of
                slots in which each was flown. statuses: counts of the solver's statuses, to which
                those of all answers are added.
        """
        self._scene, self._start, self._statuses = scene, ways[0][0], statuses
        start = self._start
        self._known = dict[Slots, Array]()
        # The length between the first corner and the last, and what turning costs besides.
        turning = [
            max(0.0, reach(scene, slots - 1) - path_length(way))
            for way, slots in zip(ways, flown, strict=True)
        ]
        self._fixed = np.array([path_length(way[1:-1]) for way in ways]) + turning
        count = len(ways)
        at_stop = np.arange(3 * count).reshape(-1, 3)
        at_out, at_in = at_stop.size + np.arange(2 * count).reshape(2, -1)
        at_margin = 5 * count
        rows = Rows()
        # Constraint out + in + margin <= reach - fixed; `_best` fills in the right-hand sides.
        rows.add(np.zeros(count), (at_out, 1.0), (at_in, 1.0), (np.full(count, at_margin), 1.0))
        rows.add(np.zeros(count), (at_in, -1.0))
        for wall, side in zip(scene.bounds, (-1.0, 1.0), strict=True):
            rows.add(np.tile(side * (wall - start), count), (at_stop.ravel(), side))
        rows.cones = [clarabel.NonnegativeConeT(rows.count)]
        for k, (centre, radius) in enumerate(balls):
            within(rows, at_stop[k], centre - start, radius=radius)
            corners = ways[k][1:-1] - start
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
        self._cost = np.zeros(at_margin + 1)
        self._cost[-1] = -1.0

    def margin(self, slots: Slots) -> float:
        """Returns the length left over on every segment (m), negative if slots are too few."""
        return float(self._best(slots)[-1])

    def stops(self, slots: Slots) -> Array:
        """Returns the stops (L, 3) of all segments with that margin (m)."""
        return self._start + self._best(slots)[: 3 * len(slots)].reshape(-1, 3)

    def _best(self, slots: Slots) -> Array:
        """Returns the best variables, all of them minus infinity without a solution."""
        if slots not in self._known:
            right = self._right.copy()
            right[: len(slots)] = [reach(self._scene, number) for number in slots] - self._fixed
            linear = sparse.csc_matrix((len(self._cost), len(self._cost)))
            best = minimise(
                linear, self._cost, self._matrix, right, self._cones, settings(), self._statuses
            )
            self._known[slots] = np.full(len(self._cost), -np.inf) if best is None else best
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
