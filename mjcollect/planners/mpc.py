"""Flies by model predictive control: plans the best motion of the next slots anew in every slot.

It is the strong rival of the learned policy. The model is the environment's own slot, box
constraints are hard, and every plan ends at rest: the remainder of the last plan is therefore
always safe, and is flown where the solver finds nothing better. As soon as the target can be
reached within the horizon, the plan is the one with the fewest slots; until then it gets as far as
it can along the shortest path. Time left in the last slot moves the stop nearer to the next target.

In disturbed air it plans with the estimates that every pilot gets there: from the foretold state,
with the acceleration to count on, a margin to boxes that grows with the time, and each moving box
in each slot where it is believed to be by then.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes
from mjcollect.flight.straight_line import time_to_go
from mjcollect.flight.world import World
from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import marks, path_length, point_along
from mjcollect.planners.foresight import Foresight
from mjcollect.planners.plan import Plan, is_flyable
from mjcollect.planners.slot_program import COMFORT, Program

HORIZON = 25  # A plan has at most this many slots.
# Distances are in units of the scene, see `Scene.unit`, unless they say otherwise.
LEAD = 40.0  # The carrot, which pulls a plan's end along the path, is at most this far ahead.
BEYOND = (25.0, 50.0)  # Where a moving box holds it, it is farther ahead by these.
PEEK = 0.5  # The carrot is in sight along a line with this share of the body's room.
GRAIN = 2.0  # Points of the path are this far apart when they are tested for being in sight.
JOIN = 60.0  # The path may be joined between its corners within this distance along it.
FIRST_SHARE = 0.6  # The first guess accelerates along the path at this share of a_max.
ROUNDS = 6  # Where there is no plan yet, the program is solved this often round its last solution.
SETTLED = 0.5  # These rounds end when the plan's end moves by less than this.
TRIES = 3  # A decision tries at most this many numbers of slots.
INSIDE = 1e-3  # A plan stops inside the tolerance by this margin (m).


@dataclass(frozen=True)
class _SegmentView:
    """Holds what a decision knows of the current segment.

    Attributes:
        q, v: (3,) present state (m, m/s).
        way: (P, 3) shortest free path from q to the target (m).
        centre, radius: (3,) and float, the ball in which to stop (m).
        next_goal: (3,) point towards which the next segment leads (m).
        least: number of slots below which no motion arrives.
        likely: estimate along the path.
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
    """Flies a course by planning, with one decision per slot.

    Attributes:
        counts: `decisions`, `solves`, and how decisions ended: `planned` anew, `replayed` (the
            remainder of the last plan, always so in the slot that stops), `law` (the guidance law,
            where there is no plan); `refused` counts solutions that the rules of flight refuse.
    """

    def __init__(self, course: Course, horizon: int = HORIZON) -> None:
        """Prepares to fly `course` with plans of at most `horizon` slots.

        Raises:
            ValueError: the horizon is shorter than 2 slots.
        """
        if horizon < 2:
            raise ValueError(f"horizon: {horizon}: must be at least 2 slots")
        self._course, self._horizon = course, horizon
        self._scene = course.scene
        self._world = World.stack([course.scene])
        self._program = Program(course.scene)
        self._foresight: Foresight | None = None
        self._plan: Plan | None = None
        self._target = -1
        self.counts: Counter[str] = Counter()

    @property
    def statuses(self) -> Counter[str]:
        """Returns how often the solver ended in each status."""
        return self._program.statuses

    def summary(self) -> str:
        """Returns a sentence that says how the decisions were made."""
        counts, statuses = self.counts, self.statuses
        ended = ", ".join(f"{status} {count}" for status, count in sorted(statuses.items()))
        return (
            f"{counts['decisions']} decisions: {counts['planned']} planned anew, "
            f"{counts['replayed']} from the plan before, {counts['law']} by the guidance law; "
            f"{counts['solves']} cone programs ({ended}), {counts['refused']} plans refused by the "
            "rules of flight."
        )

    def look(self, episodes: Episodes) -> None:
        """Makes later plans reckon with what the one episode, if disturbed, knows of the air."""
        if episodes.disturbances is None:
            return
        foresight = Foresight.of(episodes)
        self._scene = foresight.scene(self._course.scene, episodes.q[0])
        self._world = World.stack([self._scene])
        self._foresight = foresight
        self._program.scene, self._program.foresight = self._scene, foresight

    def action(self, episodes: Episodes) -> Array:
        """Returns the raw action (3,) for one episode: as planned, or the guidance law's.

        In disturbed air it looks first, and its commands are countered as any pilot's.
        """
        planned = self.planned_action(episodes)
        if planned is not None:
            return planned
        self.counts["law"] += 1
        return np.asarray(episodes.guidance_action()[0])

    def planned_action(self, episodes: Episodes) -> Array | None:
        """Returns the raw action (3,) of the plan for one episode, or None where there is none."""
        self.look(episodes)
        q, v, target = episodes.q[0], episodes.seen_v[0], int(episodes.target[0])
        plan = self.plan(q, v, target)
        if plan is None:
            return None
        return np.asarray(episodes.raw(plan.a[:1] / self._scene.a_max)[0])

    def plan(self, q: Array, v: Array, target: int) -> Plan | None:
        """Returns the plan from a state to target number `target` of the course, or None.

        Call it with the states in the order of flight: each plan starts from the last one.

        Args:
            q: (3,) present position (m).
            v: (3,) present velocity (m/s).
            target: number of the target, from 0.
        """
        self.counts["decisions"] += 1
        last = self._plan if target == self._target else None
        rest = None
        if last is not None and (last.slots > 1 or not last.arrives):
            rest = last.later(q, v)
        segment = self._view(q, v, target)
        plan = self._first(segment) if rest is None else self._next(segment, rest)
        if plan is None and rest is not None and is_flyable(self._world, rest, self._foresight):
            self.counts["replayed"] += 1
            plan = rest
        else:
            if plan is None and rest is not None and self._foresight is not None:
                plan = self._first(segment)  # A gust may have made the last plan worthless.
            if plan is not None:
                self.counts["planned"] += 1
        self._plan, self._target = plan, target
        return plan

    def _first(self, segment: _SegmentView) -> Plan | None:
        """Returns a plan where there is no last one, or None."""
        near = [self._guess(segment, slots) for slots in self._numbers(segment.likely)]
        far = [self._guess(segment, self._horizon)]
        return self._any(segment, near, arrive=True, rounds=ROUNDS) or self._any(
            segment, far, arrive=False, rounds=ROUNDS
        )

    def _next(self, segment: _SegmentView, rest: Plan) -> Plan | None:
        """Returns a plan near the remainder `rest` of the last one, or None."""
        path, disturbed = rest.q, self._foresight is not None
        if rest.arrives:
            # As the path moves, its planes turn, so one slot less may be enough by now.
            numbers = range(max(rest.slots - 1, segment.least, 2), rest.slots + 1)
            paths = [np.concatenate([path[:slots], path[-1:]]) for slots in numbers]
            if disturbed:  # A gust may also have made some slots more necessary.
                most = min(rest.slots + TRIES, self._horizon)
                path = np.concatenate([path, np.repeat(path[-1:], TRIES, axis=0)])
                paths += [path[: slots + 1] for slots in range(max(rest.slots, 1) + 1, most + 1)]
        else:
            paths = [path[: slots + 1] for slots in self._numbers(segment.likely)]
        plan = self._any(segment, paths, arrive=True)
        if plan is None and (disturbed or not rest.arrives):
            plan = self._any(segment, [path[: self._horizon + 1]], arrive=False)
        return plan

    def _any(
        self, segment: _SegmentView, paths: Sequence[Array], *, arrive: bool, rounds: int = 1
    ) -> Plan | None:
        """Returns the first plan that there is near one of the paths, or None.

        In disturbed air the margins give way where there is none with all of them.
        """
        for give in (False,) if self._foresight is None else (False, True):
            for path in paths:
                plan = self._solve(segment, path, arrive=arrive, rounds=rounds, give=give)
                if plan is not None:
                    return plan
        return None

    def _numbers(self, likely: int) -> range:
        """Returns the numbers of slots in which to try to arrive."""
        return range(max(likely, 2), min(likely + TRIES - 1, self._horizon) + 1)

    def _solve(
        self, segment: _SegmentView, path: Array, *, arrive: bool, rounds: int, give: bool
    ) -> Plan | None:
        """Returns a flyable plan near `path` (M + 1, 3), or None.

        Args:
            arrive: whether it must end in the target's ball.
            rounds: more than one where the path is a first guess that may cross boxes.
            give: whether the margins of disturbed air may give way.
        """
        best: Plan | None = None
        elastic = rounds > 1
        for _ in range(rounds):
            pull = segment.next_goal if arrive else self._carrot(segment.way, path)
            ball = (segment.centre, segment.radius) if arrive else None
            self.counts["solves"] += 1
            solution = self._program.solve(segment.v, path, pull, ball, elastic, give)
            if solution is None:
                break
            path = solution.q
            elastic = elastic and solution.slack > COMFORT * self._scene.unit
            if elastic:
                continue
            arrives = arrive or np.linalg.norm(path[-1] - segment.centre) <= segment.radius
            plan = Plan(solution.q, solution.v, self._scene.slot, bool(arrives))
            if not is_flyable(self._world, plan, self._foresight):
                self.counts["refused"] += 1
                continue
            settled = (
                best is not None
                and np.linalg.norm(plan.q[-1] - best.q[-1]) < SETTLED * self._scene.unit
            )
            best = plan
            if settled:
                break
        return best

    def _carrot(self, way: Array, path: Array) -> Array:
        """Returns the point (3,) that pulls a plan near `path` (M + 1, 3) along `way` (P, 3).

        Moving boxes that hide the carrot from the plan's end are gone round. Where one hides it in
        itself, a point farther along the way takes its place.
        """
        end, foresight = path[-1], self._foresight
        carrot = self._carrot_in_sight(way, end)
        if foresight is None:
            return carrot
        beyond = (LEAD + np.array(BEYOND)) * self._scene.unit
        farther = point_along(way, _along(way, end) + beyond)
        for pull in (carrot, *farther):
            point = foresight.way_round(end, pull, len(path) - 1, self._scene)
            if point is not None:
                return point
        return carrot

    def _carrot_in_sight(self, way: Array, end: Array) -> Array:
        """Returns the farthest point of `way` (P, 3), up to LEAD ahead, in sight of a plan's end.

        A point out of sight would pull the plan against the box between them and hold it there. At
        a corner the sight round it must not need all the room that a body needs: where the way is
        tight, the plan's end would have to be exactly at the corner to see on.
        """
        scene, unit = self._scene, self._scene.unit
        there = _along(way, end) + LEAD * unit
        point = point_along(way, there)
        room = PEEK * scene.reach
        if segment_clear(end, point, scene.tree, room):
            return point
        points = point_along(way, np.arange(there, 0.0, -GRAIN * unit))
        in_sight = segment_clear(end, points, scene.tree, room)
        return np.asarray(points[int(in_sight.argmax())])

    def _view(self, q: Array, v: Array, target: int) -> _SegmentView:
        guidance = self._course.guidance[target]
        following = self._course.guidance[target + 1 : target + 2]
        next_goal = following[0].path[1] if following else guidance.aim
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
        """Returns the least number of slots to rest within `tolerance` (m) of a point on a line.

        Args:
            distance: to the point (m).
            direction: (3,) towards it.
            v: (3,) velocity (m/s).
        """
        scene = self._scene
        closing = float(v @ direction) / max(float(np.linalg.norm(direction)), 1e-9)
        braking = max(closing, 0.0) ** 2 / (2 * scene.a_max)
        # Full braking may end beyond the near side of the ball.
        stop = min(max(braking, distance - tolerance, 0.0), distance + tolerance)
        time = time_to_go(self._world, np.array([stop]), np.array([closing]))[0]
        return int(np.ceil(time / scene.slot - 1e-6))

    def _way(self, q: Array, path: Array) -> Array:
        """Returns the way from q (3,) straight to the farthest visible point of `path`, then on."""
        scene = self._scene
        if segment_clear(q, path[-1], scene.tree, scene.reach):
            return np.stack([q, path[-1]])
        corners = marks(path)
        here = _along(path, q)
        joins = here + np.arange(0.0, JOIN, GRAIN) * self._scene.unit
        tried = np.unique(np.concatenate([joins[joins < corners[-1]], corners[corners > here]]))
        if len(tried) == 0:  # It is beside the very end, out of its sight.
            return np.stack([q, path[-1]])
        points = point_along(path, tried)
        in_sight = np.flatnonzero(segment_clear(q, points, scene.tree, scene.reach))
        entry = int(in_sight[-1]) if len(in_sight) else 0
        return np.concatenate([[q, points[entry]], path[corners > tried[entry]]])

    def _guess(self, segment: _SegmentView, slots: int) -> Array:
        """Returns positions (slots + 1, 3) of a gentle motion from rest to rest along the way."""
        scene = self._scene
        push, time = FIRST_SHARE * scene.a_max, slots * scene.slot
        ramp = min(time / 2, scene.v_max / push)
        t = np.arange(slots + 1) * scene.slot
        speed = push * np.minimum(np.minimum(t, time - t), ramp)
        covered = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * scene.slot)])
        length = path_length(segment.way)
        return point_along(segment.way, covered * min(1.0, length / max(covered[-1], 1e-9)))


def _along(path: Array, point: Array) -> float:
    """Returns the distance along `path` (P, 3) to its place nearest to `point` (3,), in m."""
    step = np.diff(path, axis=0)
    length = np.linalg.norm(step, axis=1)
    share = np.sum((point - path[:-1]) * step, axis=1) / np.maximum(length**2, 1e-12)
    share = np.clip(share, 0.0, 1.0)
    distance = np.linalg.norm(path[:-1] + share[:, None] * step - point, axis=1)
    nearest = int(distance.argmin())
    return float(length[:nearest].sum() + share[nearest] * length[nearest])
