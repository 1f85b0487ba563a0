"""Model predictive control: the best motion of the next slots, planned anew in every slot.

The strong peer of the learned policy. The model is the environment's own slot, box constraints are
hard, and every plan ends at rest: what is left of the last plan is therefore always safe, and is
flown where the solver finds nothing better. As soon as the target can be reached within the
horizon, the plan is the one with the fewest slots; until then it gets as far as it can along the
shortest path. Spare time in the last slot goes into a stop nearer to the next target.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes
from mjcollect.envs.recording import Flight, record
from mjcollect.flight.straight_line import time_to_go
from mjcollect.flight.world import World
from mjcollect.geometry.boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import marks, path_length, point_along
from mjcollect.guidance.guidance import Guidance
from mjcollect.planners.plan import Plan, is_flyable
from mjcollect.planners.slot_program import COMFORT, Program
from mjcollect.scene.scene import Scene

HORIZON = 25  # slots
LEAD = 40.0  # metres from a plan's end to the carrot on the path ahead of it, at most
GRAIN = 2.0  # metres between the places on the path tried for being in sight
JOIN = 60.0  # metres along the path within which it is joined between its corners
FIRST_SHARE = 0.6  # of a_max at which the first guess moves along the path
ROUNDS = 6  # of solving anew round the last solution where there is no plan yet
SETTLED = 0.5  # metres by which a round's end moves when nothing more is to be gained
TRIES = 3  # numbers of slots tried in a decision
INSIDE = 1e-3  # metres of the tolerance kept in reserve


class Guided(Protocol):
    """What is flown: a `Course`, or a part of one."""

    @property
    def scene(self) -> Scene:
        """The scene."""

    @property
    def guidance(self) -> Sequence[Guidance]:
        """One for each target."""


@dataclass(frozen=True)
class _SegmentView:
    """The decision's view of the current leg.

    Attributes:
        q, v: (3,) present state. way: (P, 3) shortest free path to the target from here.
        centre, radius: of the ball in which to stop. next_goal: (3,) where the next segment leads.
        least: no motion arrives in fewer slots. likely: an estimate along the path.
    """

    q: Array
    v: Array
    way: Array
    centre: Array
    radius: float
    next_goal: Array
    least: int
    likely: int


class Mpc:
    """Flies a course by planning, one decision a slot.

    Attributes:
        counts: `decisions`, `solves`, and how decisions ended: `planned` anew, `replayed` (what is
            left of the last plan, always so in the slot that stops), `law` (the guidance law, for
            want of any plan); `refused` counts solutions that the rules of flight refuse.
    """

    def __init__(
        self,
        course: Guided,
        horizon: int = HORIZON,
        look_past: bool = True,
    ) -> None:
        """Prepare for `course`.

        Args:
            horizon: slots planned. look_past: within its ball, stop as near to the next target as
                the time allows.

        Raises:
            ValueError: the horizon is too short.
        """
        if horizon < 2:
            raise ValueError(f"horizon: {horizon}: must be at least 2 slots")
        self._course, self._horizon, self._look_past = course, horizon, look_past
        self._scene = course.scene
        self._world = World.stack([course.scene])
        self._program = Program(course.scene)
        self._plan: Plan | None = None
        self._target = -1
        self.counts: Counter[str] = Counter()

    @property
    def statuses(self) -> Counter[str]:
        """How often the solver ended in which status."""
        return self._program.statuses

    def summary(self) -> str:
        """How the decisions were made, in a sentence."""
        counts, statuses = self.counts, self.statuses
        ended = ", ".join(f"{status} {count}" for status, count in sorted(statuses.items()))
        return (
            f"{counts['decisions']} decisions: {counts['planned']} planned anew, "
            f"{counts['replayed']} from the plan before, {counts['law']} by the guidance law; "
            f"{counts['solves']} cone programs ({ended}), {counts['refused']} plans refused by the "
            "rules of flight."
        )

    def see(self, boxes: Array) -> None:
        """Plan from now on round the boxes (B, 2, 3), as if all of them stood still."""
        self._scene, self._program.scene = (
            _among(scene, boxes) for scene in (self._scene, self._program.scene)
        )
        self._world = self._world._replace(boxes=boxes[None])

    def action(self, episodes: Episodes) -> Array:
        """Action (3,) in units of a_max, |action| <= 1, for the only episode of `episodes`."""
        q, v, target = episodes.q[0], episodes.v[0], int(episodes.target[0])
        plan = self.plan(q, v, target)
        if plan is None:
            self.counts["law"] += 1
            return np.asarray(episodes.guidance_action()[0])
        return np.asarray(plan.a[0] / self._scene.a_max)

    def plan(self, q: Array, v: Array, target: int) -> Plan | None:
        """The plan from a state (3,) m, (3,) m/s to target number `target` of the course.

        States are expected in the order of flight: each plan grows out of the last one.
        """
        self.counts["decisions"] += 1
        last = self._plan if target == self._target else None
        rest = None
        if last is not None and (last.slots > 1 or not last.arrives):
            rest = last.later(q, v)
        leg = self._look(q, v, target)
        plan = self._first(leg) if rest is None else self._next(leg, rest)
        if plan is not None:
            self.counts["planned"] += 1
        elif rest is not None and is_flyable(self._world, rest):
            self.counts["replayed"] += 1
            plan = rest
        self._plan, self._target = plan, target
        return plan

    def _first(self, leg: _SegmentView) -> Plan | None:
        """A plan out of nothing."""
        for slots in self._numbers(leg.likely):
            plan = self._solve(leg, self._guess(leg, slots), arrive=True, rounds=ROUNDS)
            if plan is not None:
                return plan
        return self._solve(leg, self._guess(leg, self._horizon), arrive=False, rounds=ROUNDS)

    def _next(self, leg: _SegmentView, rest: Plan) -> Plan | None:
        """A plan out of what is left of the last one."""
        path = rest.q
        if rest.arrives:
            # As the path moves, its planes turn: a slot less may do by now.
            for slots in range(max(rest.slots - 1, leg.least, 2), rest.slots + 1):
                shorter = np.concatenate([path[:slots], path[-1:]])
                plan = self._solve(leg, shorter, arrive=True)
                if plan is not None:
                    return plan
            return None
        for slots in self._numbers(leg.likely):
            plan = self._solve(leg, path[: slots + 1], arrive=True)
            if plan is not None:
                return plan
        return self._solve(leg, path, arrive=False)

    def _numbers(self, likely: int) -> range:
        """Numbers of slots in which to try to arrive."""
        return range(max(likely, 2), min(likely + TRIES - 1, self._horizon) + 1)

    def _solve(
        self, leg: _SegmentView, path: Array, *, arrive: bool, rounds: int = 1
    ) -> Plan | None:
        """A flyable plan near `path` (M + 1, 3), or None.

        Args:
            rounds: more than one where the path is a first guess, through boxes perhaps.
        """
        best: Plan | None = None
        elastic = rounds > 1
        for _ in range(rounds):
            pull = leg.next_goal if arrive else self._carrot(leg.way, path[-1])
            ball = (leg.centre, leg.radius) if arrive else None
            self.counts["solves"] += 1
            solution = self._program.solve(leg.v, path, pull, ball, elastic)
            if solution is None:
                break
            path = solution.q
            elastic = elastic and solution.slack > COMFORT
            if elastic:
                continue
            arrives = arrive or np.linalg.norm(path[-1] - leg.centre) <= leg.radius
            plan = Plan(solution.q, solution.v, self._scene.slot, bool(arrives))
            if not is_flyable(self._world, plan):
                self.counts["refused"] += 1
                continue
            settled = best is not None and np.linalg.norm(plan.q[-1] - best.q[-1]) < SETTLED
            best = plan
            if settled:
                break
        return best

    def _carrot(self, way: Array, end: Array) -> Array:
        """The point of `way` (P, 3), at most LEAD beyond a plan's end (3,), that the end sees.

        One out of sight would pull the plan against the box between them and hold it there.
        """
        scene = self._scene
        there = _along(way, end) + LEAD
        point = point_along(way, there)
        if segment_clear(end, point, scene.obstacles, scene.uav_radius):
            return point
        points = point_along(way, np.arange(there, 0.0, -GRAIN))
        seen = segment_clear(end, points, scene.obstacles, scene.uav_radius)
        return np.asarray(points[int(seen.argmax())])

    def _look(self, q: Array, v: Array, target: int) -> _SegmentView:
        guidance = self._course.guidance[target]
        following = self._course.guidance[target + 1 : target + 2]
        next_goal = following[0].path[1] if following and self._look_past else guidance.aim
        way = self._way(q, guidance.path)
        straight = guidance.goal - q
        least = self._slots(float(np.linalg.norm(straight)), straight, v, guidance.tolerance)
        likely = self._slots(path_length(way), way[1] - way[0], v, guidance.tolerance)
        return _SegmentView(
            q=q,
            v=v,
            way=way,
            centre=guidance.goal,
            radius=guidance.tolerance - min(INSIDE, guidance.tolerance / 2),
            next_goal=next_goal,
            least=least,
            likely=max(least, likely),
        )

    def _slots(self, distance: float, direction: Array, v: Array, tolerance: float) -> int:
        """Least slots to rest within `tolerance` of a point `distance` metres away on a line."""
        scene = self._scene
        closing = float(v @ direction) / max(float(np.linalg.norm(direction)), 1e-9)
        braking = max(closing, 0.0) ** 2 / (2 * scene.a_max)
        # Full braking may well end beyond the near side of the ball.
        stop = min(max(braking, distance - tolerance, 0.0), distance + tolerance)
        time = time_to_go(self._world, np.array([stop]), np.array([closing]))[0]
        return int(np.ceil(time / scene.slot - 1e-6))

    def _way(self, q: Array, path: Array) -> Array:
        """From `q` (3,) straight to the farthest point of `path` (P, 3) in sight, then along it."""
        scene = self._scene
        if segment_clear(q, path[-1], scene.obstacles, scene.uav_radius):
            return np.stack([q, path[-1]])
        corners = marks(path)
        here = _along(path, q)
        joins = here + np.arange(0.0, JOIN, GRAIN)
        tried = np.unique(np.concatenate([joins[joins < corners[-1]], corners[corners > here]]))
        points = point_along(path, tried)
        seen = np.flatnonzero(segment_clear(q, points, scene.obstacles, scene.uav_radius))
        entry = int(seen[-1]) if len(seen) else 0
        return np.concatenate([[q, points[entry]], path[corners > tried[entry]]])

    def _guess(self, leg: _SegmentView, slots: int) -> Array:
        """Positions (slots + 1, 3) of a gentle motion from rest to rest along the way."""
        scene = self._scene
        push, time = FIRST_SHARE * scene.a_max, slots * scene.slot
        ramp = min(time / 2, scene.v_max / push)
        t = np.arange(slots + 1) * scene.slot
        speed = push * np.minimum(np.minimum(t, time - t), ramp)
        covered = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * scene.slot)])
        length = path_length(leg.way)
        return point_along(leg.way, covered * min(1.0, length / max(covered[-1], 1e-9)))


def _among(scene: Scene, boxes: Array) -> Scene:
    """The scene with other obstacles, without the checks of a file: a box may pass an item."""
    other = copy.copy(scene)
    object.__setattr__(other, "obstacles", boxes)
    return other


def _along(path: Array, point: Array) -> float:
    """Metres along `path` (P, 3) to its place nearest to `point` (3,)."""
    step = np.diff(path, axis=0)
    length = np.linalg.norm(step, axis=1)
    share = np.sum((point - path[:-1]) * step, axis=1) / np.maximum(length**2, 1e-12)
    share = np.clip(share, 0.0, 1.0)
    gap = np.linalg.norm(path[:-1] + share[:, None] * step - point, axis=1)
    nearest = int(gap.argmin())
    return float(length[:nearest].sum() + share[nearest] * length[nearest])


def fly_mpc(course: Course) -> tuple[Flight, str]:
    """Fly `course` by a new MPC, without the shield; also how it decided, in a sentence."""
    planner = Mpc(course)
    return record(course, lambda _, task: planner.action(task.episodes)), planner.summary()
