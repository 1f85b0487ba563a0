"""Episode bookkeeping over N simulations: targets, collection, reward and termination.

The one place where commands, events, rewards and observations meet; it knows positions and
velocities only, not which simulator moves the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.observation import ADAPTIVE, FRAMED, OBSERVATIONS, Parts, State
from mjcollect.envs.reward import PRESETS
from mjcollect.envs.targets import Targets
from mjcollect.flight import disturbance_estimate
from mjcollect.flight.collection import command
from mjcollect.flight.contact import BOUNDS_TOLERANCE, Slot, judge
from mjcollect.flight.disturbance import MARGIN, REST_SPEED, Disturbances
from mjcollect.flight.shield import shield
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array, Bools, Indices
from mjcollect.guidance.approach import Approach

SAVED = (
    "truth",
    "observed",
    "v",
    "drift",
    "commanded",
    "sums",
    "target",
    "collected",
    "steps",
    "crashed",
    "held",
    "left",
)  # an episode's state
GAMMA = 0.99  # discount per slot, also that of the learner


@dataclass(frozen=True)
class Rules:
    """Which observation and reward an episode uses, and its discount.

    Raises:
        ValueError: unknown names, or a discount outside (0, 1).
    """

    observation: str = "guided"
    reward: str = "time"
    gamma: float = GAMMA
    shield: bool = True

    def __post_init__(self) -> None:
        """Check the names."""
        for field, choices in (("observation", OBSERVATIONS), ("reward", PRESETS)):
            if getattr(self, field) not in choices:
                raise ValueError(
                    f"{field}: {getattr(self, field)!r}: must be one of {', '.join(choices)}"
                )
        if not 0.0 < self.gamma < 1.0:
            raise ValueError(f"gamma: {self.gamma}: must lie between 0 and 1")


@dataclass(frozen=True)
class Outcome:
    """Result of one slot, each (N,).

    Attributes:
        reward: of the slot. slot: its events.
        terminated: the course is finished, or a crash ended it. truncated: the step limit did.
        success: the course is finished. shielded: the shield changed the command.
    """

    reward: Array
    slot: Slot
    terminated: Bools
    truncated: Bools
    success: Bools
    shielded: Bools


class Episodes:
    """N episodes, each on a course of its own or all on one.

    Attributes:
        truth, observed, v: (N, 3) positions, the same as far as they are known if disturbed, and
            velocities. target: (N,) index of each one's current target.
        commanded, drift: (N, 3) m/s^2, the last slot's command, and by how much its acceleration
            differed from it. sums: of both so far, see `adaptation`.
        collected: (N, K) flags. steps: (N,) slots flown. crashed: (N,) any crash so far.
        approach: how each one stands towards its target.
    """

    def __init__(
        self,
        courses: Sequence[Course],
        count: int,
        rules: Rules,
        disturbances: Disturbances | None = None,
    ) -> None:
        """Prepare `count` episodes, on one course or one each.

        Raises:
            ValueError: the number of courses is neither 1 nor `count`.
        """
        self.targets = Targets(courses, count)
        self.count, self.rules, self.disturbances = count, rules, disturbances
        self._observation, self._preset = OBSERVATIONS[rules.observation], PRESETS[rules.reward]
        self._adapts = rules.observation in ADAPTIVE
        self._framed = rules.observation in FRAMED
        scenes = [course.scene for course in courses]
        if self._adapts or disturbances is not None:  # each has a world of its own
            scenes = [self.course(index).scene for index in range(count)]
        elif all(scene is scenes[0] for scene in scenes):
            scenes = scenes[:1]
        self.world = World.stack(scenes)
        self.truth, self.observed, self.v, self.drift, self.commanded = (
            np.zeros((count, 3)) for _ in range(5)
        )
        self.sums = np.zeros((count, disturbance_estimate.SUMS))
        self._gain, self._push = disturbance_estimate.estimate(self.sums)
        self._mover = np.zeros((count, 6))
        self.target, self.collected = self.targets.first.copy(), self.targets.before.copy()
        self.steps = np.zeros(count, dtype=np.int64)
        self.crashed, self.shielded, self._stop = (np.zeros(count, dtype=bool) for _ in range(3))
        self.held, self.left = np.zeros((count, 3)), np.zeros(count, dtype=np.intp)
        self._all = np.arange(count)
        self._update_estimates()
        self.approach = self._approach()

    @property
    def q(self) -> Array:
        """Positions (N, 3) as far as they are known: what decisions are made from."""
        return self.truth if self.disturbances is None else self.observed

    @property
    def boxes(self) -> Array:
        """Boxes (N, M, 2, 3) as decisions see them, moving ones last; N is 1 where all are one."""
        return self._seen_world.boxes

    def course(self, index: int) -> Course:
        """The course of episode `index`."""
        return self.targets.course(index)

    def reset(self, which: Indices, q: Array, v: Array) -> None:
        """Begin anew at q, v (n, 3) in the episodes `which` (n,) (indices)."""
        self.truth[which], self.v[which] = q, v
        self.commanded[which] = self.drift[which] = self.sums[which] = 0.0
        self.target[which] = self.targets.first[which]
        if self.disturbances is not None:
            self.disturbances.begin(which, q, self.targets.goal[self.target[which]])
            self.observed[which] = self.disturbances.seen(q, which)
        self.collected[which] = self.targets.before[which]
        self.steps[which] = 0
        self.crashed[which] = False
        self.left[which] = 0
        self._update_estimates()
        self._update_approach(self.approach, which)

    def load(self, state: dict[str, Array]) -> None:
        """Go on from saved attributes, `SAVED`."""
        for name, value in state.items():
            setattr(self, name, value)
        self._update_estimates()
        self.approach = self._approach()

    def begin_slot(self, action: Array) -> Array:
        """Accelerations (N, 3) in m/s^2 to hold for the next slot, from raw actions (N, 3).

        Actions are in units of a_max, in the frame of the path with an observation in FRAMED.
        """
        goal, tolerance = self.targets.goal[self.target], self.targets.tolerance[self.target]
        if self._framed:
            known = np.where(np.isfinite(action), action, 0.0)
            action = np.einsum("nk,nkj->nj", known, self.approach.frame)
        self.commanded, self._stop = command(self.world, self.q, self.v, action, goal, tolerance)
        if self.rules.shield:
            shield(
                self._seen_world, self.q, self.v, self.commanded, self._stop, self.held, self.left,
                self.shielded,
            )  # fmt: skip
        return self.commanded

    def end_slot(self, path: Array, v: Array, sensed: Bools) -> Outcome:
        """Judge the slot just flown and move on to the next target where one was reached.

        Args:
            path: (N, n, 3) positions after each physics step. v: (N, 3) velocity at the end.
            sensed: (N, n) contact sensor after each step.
        """
        margin = BOUNDS_TOLERANCE if self.disturbances is None else MARGIN
        if self.disturbances is not None and self.disturbances.level.mover > 0.0:
            whole = np.concatenate([self.truth[:, None], path], axis=1)
            sensed = sensed | self.disturbances.movers.touched(self.world, whole)
            self.disturbances.movers.move(self.world.slot)
        slot = judge(self.world, self.truth, path, sensed, self._stop, margin)
        before = self.approach
        self.drift = (v - self.v) / self.world.slot - self.commanded
        if self._adapts:
            a_max = self.world.a_max
            self.sums = disturbance_estimate.gather(
                self.sums, self.commanded / a_max, self.drift / a_max
            )
        self.truth, self.v = path[:, -1].copy(), v.copy()
        if self._preset.crash_ends:
            ended = slot.crashed
        else:
            # Contact is sensed, not resolved: motion went on, so the stop holds all the same.
            ended = np.zeros(self.count, dtype=bool)
            slot = Slot(slot.contact, slot.outside, self._stop.copy(), slot.first_event)
        if self.disturbances is not None:
            slot = replace(slot, arrived=slot.arrived & self._rests())
            self.observed = self.disturbances.seen(self.truth)
        self._update_estimates()
        after = self._approach()
        reward = self._preset.reward(self.world, before, after, slot, self.rules.gamma)
        self.crashed |= slot.crashed
        self.steps += 1
        success = slot.arrived & (self.target == self.targets.last)
        node = self.targets.node[self.target]
        taken = np.flatnonzero(slot.arrived & (node >= 0))
        self.collected[taken, node[taken]] = True
        moving = slot.arrived & ~success
        self.approach = after
        if moving.any():
            self.target = self.target + moving
            self._update_approach(after, np.flatnonzero(moving))
        terminated = success | ended
        truncated = ~terminated & (self.steps >= self.targets.step_limit)
        return Outcome(reward, slot, terminated, truncated, success, self.shielded.copy())

    def _rests(self) -> Bools:
        """Where (N,) a disturbed stop is one: slow enough, and within the tolerance."""
        miss = np.linalg.norm(self.truth - self.targets.goal[self.target], axis=1)
        slow = np.linalg.norm(self.v, axis=1) <= REST_SPEED
        return np.asarray(slow & (miss <= self.targets.tolerance[self.target]))

    def observe(self, which: Indices | None = None) -> Parts:
        """Named parts of the observation, each (N, d); only the rows `which` (n,) if given."""
        state = State(
            self.q, self.v, self.approach, self.targets.items, self.collected, self.commanded,
            self.drift, self._gain, self._push, self._mover,
        )  # fmt: skip
        if which is None:
            return self._observation(self._seen_world, state)
        return self._observation(self._seen_world.rows(which), state.rows(which))

    @property
    def next_cost(self) -> Array:
        """Seconds (N,) at full speed that the current place costs on the tour's next segment."""
        return np.asarray(self.approach.next_excess / self.world.v_max[..., 0])

    def guidance_action(self) -> Array:
        """Actions (N, 3) of the guidance law from here, see `guidance.law`.

        With an adaptive observation, for the acceleration that is left, and against the push.
        """
        law = self.targets.law(self._seen_world, self.target, self.q, self.v)
        if self._adapts:
            law *= disturbance_estimate.usable(self._gain, self._push)
            law = disturbance_estimate.counter(law, self._gain, self._push)
        if self._framed:
            law = np.einsum("nj,nkj->nk", law, self.approach.frame)
        return law

    def _update_estimates(self) -> None:
        """Bring up to date what is known of disturbances: the world as decisions see it."""
        self._seen_world = self.world
        if self._adapts:
            self._gain, self._push = disturbance_estimate.estimate(self.sums)
            a_max = self.world.a_max * disturbance_estimate.usable(self._gain, self._push)
            self._seen_world = self._seen_world._replace(a_max=a_max)
        if self.disturbances is not None and self.disturbances.level.mover > 0.0:
            movers = self.disturbances.movers
            boxes = np.concatenate([self.world.boxes, movers.boxes], axis=1)
            self._seen_world = self._seen_world._replace(boxes=boxes)
            self._mover = movers.seen(self.q, self.world.v_max)

    def _approach(self) -> Approach:
        """A new approach of all episodes."""
        approach = Approach.empty(self.count)
        self._update_approach(approach, self._all)
        return approach

    def _update_approach(self, approach: Approach, which: Indices) -> None:
        """Write the rows `which` of an approach."""
        self.targets.update_approach(self._seen_world, self.target, self.q, self.v, which, approach)
