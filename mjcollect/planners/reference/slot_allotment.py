"""How many slots each leg of a mission gets, by a small model of all legs: a millisecond an answer.

A leg flown in M whole slots covers at most `reach(M)` metres. Its way leads from stop to stop
round fixed corners, so its length is a convex function of the two stops. A number of slots for
each leg is enough if stops can be found in their balls for which no way is longer than its slots
reach; the metres to spare on every leg at once are the allotment's margin.
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
    """How a leg's length depends on its stops.

    Attributes:
        corners: (P, 3) points between its stops, fixed; P may be 0.
        toll: metres that turning costs beyond the way's length.
    """

    corners: Array
    toll: float

    @property
    def fixed(self) -> float:
        """Metres between the first corner and the last, and the toll."""
        return float(np.linalg.norm(np.diff(self.corners, axis=0), axis=1).sum()) + self.toll


def reach(scene: Scene, slots: int) -> float:
    """Metres covered on a line from rest to rest in whole slots, at most.

    The velocity at slot starts is the least of ramp up, v_max and ramp down; at rest at both ends,
    the semi-implicit steps of a slot add up to its mean.
    """
    k = np.arange(slots + 1)
    ramp = scene.a_max * scene.slot * np.minimum(k, slots - k)
    return float(np.minimum(ramp, scene.v_max).sum() * scene.slot)


def least_slots(scene: Scene, distance: float) -> int:
    """Least whole slots from rest to rest over a straight distance in m; at least one."""
    slots = 1
    while reach(scene, slots) < distance:
        slots += max(1, int((distance - reach(scene, slots)) / (scene.v_max * scene.slot)))
    return slots


class Allotments:
    """Margins of allotments for the legs of one mission."""

    def __init__(
        self,
        scene: Scene,
        start: Array,
        balls: Sequence[tuple[Array, float]],
        routes: Sequence[Route],
    ) -> None:
        """Prepare.

        Args:
            start: (3,) where the first leg begins. balls: centre (3,) and radius in m of where
                each leg ends. routes: of each leg.
        """
        self._scene, self._start = scene, start
        self._known = dict[Slots, tuple[float, Array]]()
        self._fixed = [route.fixed for route in routes]
        count = len(routes)
        at_stop = np.arange(3 * count).reshape(-1, 3)
        at_out, at_in = at_stop.size + np.arange(2 * count).reshape(2, -1)
        at_margin = 5 * count
        rows = Rows()
        # out + in + margin <= reach - fixed: right-hand sides are filled in for each allotment.
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
        """Metres to spare on every leg at once, negative where the slots are not enough."""
        return self._solve(slots)[0]

    def stops(self, slots: Slots) -> Array:
        """Where each leg ends (L, 3) with that margin."""
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
        """Allotments of one slot less in all, those with the best margins first."""
        less = [_moved(slots, k, None) for k in range(len(slots)) if slots[k] > 1]
        if not less:
            return []
        best = max(less, key=self.margin)
        seen = {best}
        while True:
            legs = range(len(best))
            shifts = [_moved(best, i, j) for i in legs for j in legs if i != j and best[i] > 1]
            seen.update(shifts)
            better = max(shifts, key=self.margin, default=best)
            if self.margin(better) <= self.margin(best) + 1e-6:
                return sorted(seen, key=self.margin, reverse=True)
            best = better


def _moved(slots: Slots, taken: int, given: int | None) -> Slots:
    """A slot taken from one leg and given to another, or to none."""
    new = list(slots)
    new[taken] -= 1
    if given is not None:
        new[given] += 1
    return tuple(new)
