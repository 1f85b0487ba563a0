"""Finds the motion of a whole mission by one cone program, given each segment's number of slots.

The next segment starts where the last one stops in its ball, so only all segments together tell
whether their slots are enough. The program finds the motion whose stops miss their balls least; if
no stop misses its ball, the mission can be flown in these slots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import clarabel
import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array
from mjcollect.planners.cone_solver import Rows, settings, within
from mjcollect.planners.slot_program import ELASTIC_COST, PROXIMITY_COST, Program
from mjcollect.scene.scene import Scene

DUALITY_GAP = 1e-6  # The solver stops at this duality gap, absolute and relative.
LATE = 1e-3  # One slot surely cannot stop a speed that exceeds a_max slot by this share.


@dataclass(frozen=True)
class Motion:
    """Holds the motion of a mission of L segments and N slots.

    Attributes:
        segments: positions (M + 1, 3) in m at each segment's slot starts, both stops included.
        v: (N + 1, 3) velocities in m/s at all slot starts.
        misses: (L,) distances by which stops lie outside their balls (m).
        slack: the most by which a slot's clearance falls short of the comfortable one (m).
    """

    segments: list[Array]
    v: Array
    misses: Array
    slack: float


class TourProgram(Program):
    """Finds the best motion of a mission near given paths, with given numbers of slots."""

    def __init__(self, scene: Scene, balls: Sequence[tuple[Array, float]]) -> None:
        """Prepares programs for missions that stop in `balls` in turn: centre (3,), radius (m)."""
        super().__init__(scene)
        # Long segments at walls are badly conditioned, so failures are retried with other settings.
        self._ways = [settings() for _ in range(3)]
        for way in self._ways:
            way.tol_gap_abs = way.tol_gap_rel = DUALITY_GAP
        _, refined, plain = self._ways
        refined.iterative_refinement_max_iter = 50
        refined.iterative_refinement_reltol = refined.iterative_refinement_abstol = 1e-14
        plain.equilibrate_enable = False
        self._balls = balls

    def best(self, paths: Sequence[Array], elastic: bool) -> Motion | None:
        """Returns the motion near `paths` that misses its balls least, or None without a solution.

        Args:
            paths: positions (M + 1, 3) in m at each segment's slot starts, end to end.
            elastic: whether boxes may be overlapped at a cost, for paths that are a first guess.
        """
        path = np.concatenate([paths[0][:1], *(segment[1:] for segment in paths)])
        count, start = len(path) - 1, path[0]
        ends = np.cumsum([len(segment) - 1 for segment in paths])
        at_v = np.arange(3 * (count + 1)).reshape(-1, 3)
        at_q, at_slack = at_v + at_v.size, 2 * at_v.size + np.arange(count)
        at_miss = 2 * at_v.size + count + np.arange(len(ends))
        rows = Rows()
        self._dynamics(rows, at_q, at_v)
        stops = at_v[ends[:-1]].ravel()
        rows.add(np.zeros(stops.size), (stops, 1.0))
        zero = rows.count
        self._boxes(rows, at_q, at_slack, path, elastic)
        self._bounds(rows, at_q, at_v, path)
        self._stop_late(rows, at_v, paths, ends)
        rows.add(np.zeros(len(ends)), (at_miss, -1.0))
        rows.cones = [clarabel.ZeroConeT(zero), clarabel.NonnegativeConeT(rows.count - zero)]
        self._limits(rows, at_v)
        for end, at, (centre, radius) in zip(ends, at_miss, self._balls, strict=True):
            within(rows, at_q[end], centre - start, radius=radius, at_radius=int(at))

        fixed = np.full(at_miss[-1] + 1, np.nan)
        fixed[at_v[0]], fixed[at_q[0]], fixed[at_v[-1]] = 0.0, 0.0, 0.0
        cost = np.zeros(len(fixed))
        cost[at_slack] = ELASTIC_COST if elastic else PROXIMITY_COST
        cost[at_miss] = 1.0
        z = self._solve(rows, cost, fixed, at_v)
        if z is None:
            return None
        q = start + z[at_q]
        return Motion(
            segments=[
                q[end - len(segment) + 1 : end + 1]
                for segment, end in zip(paths, ends, strict=True)
            ],
            v=z[at_v],
            misses=z[at_miss],
            slack=float(z[at_slack].max()),
        )

    def _solve(self, rows: Rows, cost: Array, fixed: Array, at_v: NDArray[np.intp]) -> Array | None:
        for chosen in self._ways:
            self._settings, before = chosen, self._infeasible
            z = super()._solve(rows, cost, fixed, at_v)
            if z is not None or self._infeasible > before:
                return z
        return None

    @property
    def _infeasible(self) -> int:
        return self.statuses["PrimalInfeasible"] + self.statuses["AlmostPrimalInfeasible"]

    def _stop_late(
        self, rows: Rows, at_v: NDArray[np.intp], paths: Sequence[Array], ends: NDArray[np.intp]
    ) -> None:
        """Keeps the body too fast, two slots before a stop, for collection to stop it there."""
        fast = self.scene.a_max * self.scene.slot * (1 + LATE)
        for segment, end in zip(paths, ends, strict=True):
            if len(segment) < 4:
                continue
            step = segment[-1] - segment[-3]
            size = float(np.linalg.norm(step))
            if size > 1e-6:
                rows.add(np.array([-fast]), (at_v[end - 2][None], -(step / size)[None]))
