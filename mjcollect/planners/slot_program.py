"""Finds one plan by a cone program: slot dynamics, norm limits and half-spaces.

A second-order cone program keeps both norm limits exact. Clarabel was the fastest of the solvers
measured on programs of flown missions: OSQP needs the cones cut into facets and is 50 times
slower, SCS is twice as slow, and ECOS is about as fast but under the GPL and without a quadratic
cost.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import joined
from mjcollect.planners.cone_solver import Rows, minimise, norms, settings, within
from mjcollect.planners.foresight import Foresight
from mjcollect.planners.separating_planes import SIGHT, separate
from mjcollect.scene.scene import Scene

# A box costs as soon as the clearance is less than this above the least one, in units of the scene.
COMFORT = 0.5
# The cost of one metre of missing comfort in one slot, in metres of distance to the pulling point.
PROXIMITY_COST = 1e-3
ELASTIC_COST = 30.0  # This replaces PROXIMITY_COST while boxes may be overlapped.
GIVING_COST = 0.3  # This replaces PROXIMITY_COST while the margin in disturbed air may give way.
EFFORT_COST = 1e-6  # The cost of an acceleration: metres of distance per (m/s^2)^2 and slot.
SHORT = 1e-5  # This share of each limit stays unused: more than the solver's tolerance takes.
SOLVER_MARGIN_M = 1e-3  # This margin to boxes (m) is added to the proven one, for the same reason.


@dataclass(frozen=True)
class Solution:
    """Holds an optimal motion of M slots.

    Attributes:
        q, v: (M + 1, 3) m and m/s at slot starts, the given state first; v ends with zeros.
        slack: the most by which a slot's clearance falls short of the comfortable one (m), beyond
            what a margin that may give way allows.
    """

    q: Array
    v: Array
    slack: float


class Program:
    """Finds the best motion of M slots that ends at rest, near a given path.

    Variables: v_k, q_k at slot starts k = 0..M (q relative to q_0; v_0, q_0, v_M are fixed), one
    slack variable (m) for each slot, and the distance t of q_M from the pulling point. A program's
    shape changes with every plan, and an interior-point method has no use for an old solution, so
    nothing is kept between solves.

    Attributes:
        scene: scene whose limits and boxes hold. foresight: what is known of disturbances, if any.
        statuses: counts of Clarabel's final statuses.
    """

    def __init__(self, scene: Scene) -> None:
        """Prepares programs for flights in `scene`."""
        self.scene = scene
        self.foresight: Foresight | None = None
        self._settings = settings()
        self.statuses: Counter[str] = Counter()

    def solve(
        self,
        v: Array,
        path: Array,
        pull: Array,
        ball: tuple[Array, float] | None = None,
        elastic: bool = False,
        give: bool = False,
    ) -> Solution | None:
        """Returns the motion that ends nearest to a pulling point, or None without a solution.

        Args:
            v: (3,) present velocity (m/s). path: (M + 1, 3) positions (m) at slot starts from the
                present one on, M >= 2; every slot stays on the same side of the boxes as here.
            pull: (3,) the pulling point (m).
            ball: centre (3,) and radius (m) of the ball in which the motion must end, if any.
            elastic: whether boxes may be overlapped at a cost, for a path that is a first guess.
            give: whether the margins of disturbed air may give way at a cost.
        """
        count, start = len(path) - 1, path[0]
        margin = np.zeros(count)
        if self.foresight is not None:
            margin = self.foresight.margins(count, self.scene.slot)
        # Columns of v_k and q_k (M + 1, 3), slack_k (M,) and t.
        at_v = np.arange(3 * (count + 1)).reshape(-1, 3)
        at_q, at_slack = at_v + at_v.size, 2 * at_v.size + np.arange(count)
        at_t = 2 * at_v.size + count
        rows = Rows()
        self._dynamics(rows, at_q, at_v)
        zero = rows.count
        given = margin if give else np.zeros(count)
        self._boxes(rows, at_q, at_slack, path, elastic, margin, given)
        self._bounds(rows, at_q, at_v, path)
        rows.cones = [clarabel.ZeroConeT(zero), clarabel.NonnegativeConeT(rows.count - zero)]
        self._limits(rows, at_v)
        if ball is not None:
            within(rows, at_q[-1], ball[0] - start, radius=ball[1])
        within(rows, at_q[-1], pull - start, at_radius=at_t)

        fixed = np.full(at_t + 1, np.nan)
        fixed[at_v[0]], fixed[at_q[0]], fixed[at_v[-1]] = v, 0.0, 0.0
        cost = np.zeros(at_t + 1)
        cost[at_slack] = ELASTIC_COST if elastic else GIVING_COST if give else PROXIMITY_COST
        cost[at_t] = 1.0
        z = self._solve(rows, cost, fixed, at_v)
        if z is None:
            return None
        slack = float((z[at_slack] - given).max())
        return Solution(np.concatenate([start[None], start + z[at_q[1:]]]), z[at_v], slack)

    def _dynamics(self, rows: Rows, at_q: NDArray[np.intp], at_v: NDArray[np.intp]) -> None:
        """Adds the dynamics of a slot of n physics steps with a_k = (v_{k+1} - v_k) / slot.

        They are q_{k+1} = q_k + slot v_k + a_k slot^2 (n + 1) / (2 n).
        """
        scene = self.scene
        share = (scene.substeps + 1) / (2 * scene.substeps)
        rows.add(
            np.zeros(at_q[1:].size),
            (at_q[1:].ravel(), 1.0),
            (at_q[:-1].ravel(), -1.0),
            (at_v[:-1].ravel(), -scene.slot * (1 - share)),
            (at_v[1:].ravel(), -scene.slot * share),
        )

    def _boxes(
        self,
        rows: Rows,
        at_q: NDArray[np.intp],
        at_slack: NDArray[np.intp],
        path: Array,
        elastic: bool,
        margin: Array | float = 0.0,
        given: Array | float = 0.0,
    ) -> None:
        """Keeps both ends of every slot's piece on the free side of its planes.

        Within a slot the motion is a parabola, which deviates from the straight piece between its
        ends by up to a_max slot^2 / 8. What a moving box sweeps in a slot is that slot's box.

        Args:
            rows: all constraints. at_q, at_slack, path, elastic: as in `solve`.
            margin: (M,) m that a slot keeps on top of what is proven.
            given: (M,) m by which it may give way.
        """
        scene, boxes, count = self.scene, self.scene.boxes, len(at_slack)
        if self.foresight is not None:
            moving = self.foresight.swept(count, scene.slot)
            still = np.broadcast_to(boxes, (count, *boxes.shape))
            boxes = joined(still, moving, axis=1)
        planes = separate(path, boxes, SIGHT * scene.unit)
        piece, normal = planes.piece, planes.normal
        proven = scene.reach + scene.a_max * scene.slot**2 / 8 + SOLVER_MARGIN_M
        least = proven + np.broadcast_to(margin, count)[piece]
        # The present position cannot be moved, so the first slot keeps the clearance that it has.
        here = normal @ path[0] - planes.offset
        first = piece == 0
        least[first] = np.minimum(least, np.maximum(here - SOLVER_MARGIN_M, scene.reach))[first]
        right = normal @ path[0] - planes.offset - least - COMFORT * scene.unit
        later = ~first
        rows.add(right, (at_q[piece + 1], -normal), (at_slack[piece], -1.0))
        piece, normal, right = piece[later], normal[later], right[later]
        rows.add(right, (at_q[piece], -normal), (at_slack[piece], -1.0))
        rows.add(np.zeros(count), (at_slack, -1.0))
        most = 1e4 if elastic else COMFORT * scene.unit + given
        rows.add(np.array(np.broadcast_to(most, count)), (at_slack, 1.0))

    def _bounds(
        self,
        rows: Rows,
        at_q: NDArray[np.intp],
        at_v: NDArray[np.intp],
        path: Array,
    ) -> None:
        """Keeps the motion inside the bounds at every instant; only near walls get rows.

        A slot's parabola lies in the triangle of its ends and the point where its tangents meet,
        q_k + slot / 2 (v_k + a_k step / 2); step / 2 comes from the semi-implicit physics step.
        """
        scene = self.scene
        lag = scene.physics_step / 4
        for wall, side in zip(scene.bounds, (-1.0, 1.0), strict=True):
            piece, axis = np.nonzero(np.abs(path[1:] - wall) < SIGHT * scene.unit)
            clearance = side * (wall - path[0])[axis]
            rows.add(clearance - 1e-7, (at_q[piece + 1, axis], side))
            rows.add(
                clearance,
                (at_q[piece, axis], side),
                (at_v[piece, axis], side * (scene.slot / 2 - lag)),
                (at_v[piece + 1, axis], side * lag),
            )

    def _limits(self, rows: Rows, at_v: NDArray[np.intp]) -> None:
        """Adds |v_{k+1} - v_k| <= a_max slot for each slot, |v_k| <= v_max at inner slot starts."""
        scene = self.scene
        norms(rows, scene.a_max * scene.slot * (1 - SHORT), (at_v[1:], 1.0), (at_v[:-1], -1.0))
        norms(rows, scene.v_max * (1 - SHORT), (at_v[1:-1], 1.0))

    def _solve(self, rows: Rows, cost: Array, fixed: Array, at_v: NDArray[np.intp]) -> Array | None:
        """Returns all variables, or None without a solution.

        Args:
            rows: all constraints. cost: (n,) linear cost. fixed: (n,) given values, NaN elsewhere.
            at_v: (M + 1, 3) columns of the velocities.
        """
        given = ~np.isnan(fixed)
        free = np.flatnonzero(~given)
        place = np.full(len(fixed), -1)
        place[free] = np.arange(len(free))
        row, column = np.concatenate(rows.row), np.concatenate(rows.column)
        value, right = np.concatenate(rows.value), np.concatenate(rows.right)
        known = given[column]
        right = right - np.bincount(
            row[known], value[known] * fixed[column[known]], minlength=len(right)
        )
        row, column, value = row[~known], place[column[~known]], value[~known]
        matrix = sparse.csc_matrix((value, (row, column)), shape=(len(right), len(free)))
        # The effort is the sum of |v_{k+1} - v_k|^2 / slot^2; v_M, a fixed end, is zero.
        weight = 2 * EFFORT_COST / self.scene.slot**2
        inner = place[at_v[1:-1]]
        cost = cost[free]
        cost[inner[0]] -= weight * fixed[at_v[0]]
        pairs = inner[:-1].ravel(), inner[1:].ravel()
        values = [np.full(inner.size, 2 * weight), np.full(pairs[0].size, -weight)]
        quadratic = sparse.csc_matrix(
            (
                np.concatenate(values),
                (
                    np.concatenate([inner.ravel(), pairs[0]]),
                    np.concatenate([inner.ravel(), pairs[1]]),
                ),
            ),
            shape=(len(free), len(free)),
        )
        best = minimise(quadratic, cost, matrix, right, rows.cones, self._settings, self.statuses)
        if best is None:
            return None
        z = fixed.copy()
        z[free] = best
        return z
