"""Runs N episodes slot by slot: commands, events, rewards, observations and termination.

This is the one place where these meet. It knows positions and velocities only, not which simulator
moves the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.observation import (
    FRAMED,
    OBSERVATIONS,
    SHOW_DISTURBANCES,
    SHOW_OTHERS,
    Parts,
    State,
    places,
)
from mjcollect.envs.outcome import Outcome
from mjcollect.envs.reward import PRESETS
from mjcollect.envs.targets import Targets
from mjcollect.flight import disturbance_estimate as air
from mjcollect.flight.collection import command
from mjcollect.flight.contact import BOUNDS_TOLERANCE, MARGIN, Slot, judge
from mjcollect.flight.disturbance import REST_SPEED, Disturbances
from mjcollect.flight.disturbance_estimate import Estimate
from mjcollect.flight.disturbed_shield import Margins, disturbed_shield
from mjcollect.flight.moving_boxes import SHOWN, SOON, STEPS
from mjcollect.flight.separation import others_seen, too_near
from mjcollect.flight.shield import shield
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array, Bools, Indices
from mjcollect.geometry.turns import joined
from mjcollect.guidance.approach import Approach
from mjcollect.guidance.right_of_way import RightOfWay, Seen

SAVED = (  # These attributes of `Episodes` are an episode's whole state.
    "truth",
    "observed",
    "v",
    "sums",
    "target",
    "collected",
    "steps",
    "crashed",
    "held",
    "left",
    "asked",
    "home",
)
FLEET_SAVED = ("shielded", "makes_room")  # And these, of fleets.
ESTIMATES = ("flight", "truth", "none")
GAMMA = 0.99  # The default discount factor per slot of an environment.


@dataclass(frozen=True)
class Rules:
    """Says by which rules an episode runs.

    Attributes:
        observation, reward: names in `OBSERVATIONS` and `PRESETS`.
        gamma: discount per slot.
        shield: whether to bend commands that leave no way to stop without touching anything.
        estimate: what decisions know of disturbances: what the flight shows (flight), all but the
            gusts to come (truth), or nothing (none). Commands counter what is known.
    """

    observation: str = "guided"
    reward: str = "time"
    gamma: float = GAMMA
    shield: bool = True
    estimate: str = "flight"

    def __post_init__(self) -> None:
        """Checks the names and the discount.

        Raises:
            ValueError: a name is unknown, or the discount lies outside (0, 1).
        """
        names = ("observation", OBSERVATIONS), ("reward", PRESETS), ("estimate", ESTIMATES)
        for field, choices in names:
            if getattr(self, field) not in choices:
                raise ValueError(
                    f"{field}: {getattr(self, field)!r}: must be one of {', '.join(choices)}"
                )
        if not 0.0 < self.gamma < 1.0:
            raise ValueError(f"gamma: {self.gamma}: must lie between 0 and 1")


class Episodes:
    """Runs N episodes, each on a course of its own or all on one.

    Attributes:
        truth, observed: (N, 3) true positions, and positions as measured if disturbed (m).
        v: (N, 3) velocities (m/s). target: (N,) index of each episode's current target.
        seen_world: the world as decisions see it, with the a_max to count on and moving boxes last.
        known: what is known of disturbances. sums: what it is made of, if it is of the flight.
        collected: (N, K) flags. steps: (N,) slots flown, but for those it waited for others to
            land. crashed: (N,) whether any slot crashed.
        home: (N,) whether it has finished, and waits for the others of its fleet.
        held, left, asked: (N, 3), (N,), (N,) the shield's state. room: (N,) share of its margin
            that it kept. approach: how each stands towards its target.
    """

    def __init__(
        self,
        courses: Sequence[Course],
        count: int,
        rules: Rules,
        disturbances: Disturbances | None = None,
        uavs: int = 1,
    ) -> None:
        """Prepares `count` episodes, on one course or one each.

        Args:
            uavs: M, so many episodes that follow each other are those of one fleet. Their courses
                are given once for all fleets, or for each.

        Raises:
            ValueError: the number of courses is neither 1 nor `count`.
        """
        self.uavs = uavs
        if 1 < len(courses) == uavs:
            courses = list(courses) * (count // uavs)
        self.targets = Targets(courses, count)
        self.count, self.rules, self.disturbances = count, rules, disturbances
        self._observation, self._preset = OBSERVATIONS[rules.observation], PRESETS[rules.reward]
        self._framed = rules.observation in FRAMED
        self._estimates = disturbances is not None and rules.estimate != "none"
        scenes = [course.scene for course in courses]
        if disturbances is not None:  # Each episode has a world of its own.
            scenes = [self.course(index).scene for index in range(count)]
        elif all(scene.tree is scenes[0].tree for scene in scenes):  # They differ in items only.
            scenes = scenes[:1]
        self.world = World.stack(scenes)
        self.truth, self.observed, self.v = (np.zeros((count, 3)) for _ in range(3))
        self.sums, self.known = np.zeros((count, air.SUMS)), Estimate.calm(count)
        self._movers = np.zeros((count, SHOWN, 2 + len(SOON), 3))
        self.target, self.collected = self.targets.first.copy(), self.targets.before.copy()
        self.steps = np.zeros(count, dtype=np.int64)
        self.crashed, self.shielded, self._stop, self.home = (
            np.zeros(count, dtype=bool) for _ in range(4)
        )
        self.held, self.left = np.zeros((count, 3)), np.zeros(count, dtype=np.intp)
        self.asked, self.room = np.ones(count), np.ones(count)
        self.traffic: RightOfWay | None = None
        if uavs > 1 and rules.shield:
            targets = self.targets
            self.traffic = RightOfWay(targets.guidance, targets.first, targets.last, uavs)
        self._all = np.arange(count)
        self._update_estimates()
        self.approach = self._approach()

    @property
    def q(self) -> Array:
        """Returns the positions (N, 3) in m from which decisions are made."""
        return self.truth if self.disturbances is None else self._seen_q

    @property
    def seen_v(self) -> Array:
        """Returns the velocities (N, 3) in m/s from which decisions are made."""
        return self.v if self.disturbances is None else self._seen_v

    @property
    def makes_room(self) -> Array:
        """Returns the state (N, ...) of the right of way in fleets, nothing without one."""
        return np.zeros((self.count, 0)) if self.traffic is None else self.traffic.state

    @makes_room.setter
    def makes_room(self, state: Array) -> None:
        if self.traffic is not None:
            self.traffic.load(state)

    def course(self, index: int) -> Course:
        """Returns the course of episode `index`."""
        return self.targets.course(index)

    def reset(self, which: Indices, q: Array, v: Array) -> None:
        """Begins the episodes with indices `which` (n,) anew at q, v (n, 3) in m and m/s."""
        self.truth[which], self.v[which] = q, v
        self.target[which] = self.targets.first[which]
        if self.disturbances is not None:
            self.disturbances.begin(which, q, self.targets.goal[self.target[which]])
            self.observed[which] = self.disturbances.seen(q, which)
            air.begin(self.sums, which, self.observed[which])
        self.collected[which] = self.targets.before[which]
        self.steps[which] = 0
        self.crashed[which] = self.home[which] = False
        self.left[which], self.asked[which] = 0, 1.0
        self.shielded[which] = False
        if self.traffic is not None:
            self.traffic.reset(which)
        self._update_estimates()
        self._update_approach(self.approach, which)

    def load(self, state: dict[str, Array]) -> None:
        """Goes on from saved values of the attributes `SAVED`."""
        for name, value in state.items():
            setattr(self, name, value)
        self._update_estimates()
        self.approach = self._approach()

    def begin_slot(self, action: Array) -> Array:
        """Returns the accelerations (N, 3) in m/s^2 to hold for the next slot.

        Args:
            action: (N, 3) raw actions in units of a_max, in world axes, or in the frame of the path
                if the observation is in FRAMED.
        """
        goal, tolerance = self.targets.goal[self.target], self.targets.tolerance[self.target]
        if self._framed:
            action = np.where(np.isfinite(action), action, 0.0)
            action = np.einsum("nk,nkj->nj", action, self.approach.frame)
        if self.traffic is not None:
            action = self.traffic.actions(self._seen_fleet(), action)
            tolerance = np.where(self.traffic.kept_out, -np.inf, tolerance)
        if self.uavs > 1:
            action = np.where(self.home[:, None], 0.0, action)
        world, q, v = self.seen_world, self.q, self.seen_v
        a, self._stop = command(world, q, v, action, goal, tolerance)
        if self._estimates:
            known, a_max = self.known, self.world.a_max
            a = known.flown(known.counter(a, a_max))  # as far as the actuators can follow
            if self.rules.shield:
                disturbed_shield(
                    world._replace(boxes=self.world.boxes), self._margins(), q, v, a, self._stop,
                    self.held, self.left, self.asked, self.room, self.shielded,
                )  # fmt: skip
            a = known.counter(a, a_max)
        elif self.rules.shield:
            shield(world, q, v, a, self._stop, self.held, self.left, self.shielded, self.uavs)
        return a

    def _seen_fleet(self) -> Seen:
        """Returns what the fleets know."""
        return Seen(self.world, self.target, self.q, self.seen_v, self.shielded, self.home)

    def _margins(self) -> Margins:
        """Returns what the shield keeps clear of in disturbed air."""
        assert self.disturbances is not None
        movers = self.disturbances.movers
        return Margins.of(self.known, self.world.a_max, self.seen_v, movers.boxes, movers.ahead())

    def end_slot(self, path: Array, v: Array, sensed: Bools) -> Outcome:
        """Judges the slot just flown and moves on to the next target where one was reached.

        Args:
            path: (N, n, 3) positions after each physics step (m). v: (N, 3) final velocity (m/s).
            sensed: (N, n) contact sensor after each physics step.
        """
        margin = BOUNDS_TOLERANCE if self.disturbances is None else MARGIN
        struck = np.zeros(sensed.shape, dtype=bool)
        if self.disturbances is not None and self.disturbances.level.mover > 0.0:
            whole = np.concatenate([self.truth[:, None], path], axis=1)
            struck = self.disturbances.movers.touched(self.world, whole)
            self.disturbances.movers.move(self.world.slot)
        if self.uavs > 1:
            whole = np.concatenate([self.truth[:, None], path], axis=1)
            struck = struck | too_near(self.world, self.uavs, whole)
        slot = judge(self.world, self.truth, path, sensed | struck, self._stop, margin)
        before, old_v = self.approach, self.v
        self.truth, self.v = path[:, -1].copy(), v.copy()
        if self._preset.crash_ends:
            ended = slot.crashed
        else:
            # Contact is sensed, not resolved: motion goes on, so a stop counts all the same.
            ended = np.zeros(self.count, dtype=bool)
            slot = Slot(slot.contact, slot.outside, self._stop.copy(), slot.first_event)
        if self.disturbances is not None:
            slot = replace(slot, arrived=slot.arrived & self._rests())
            self.observed = self.disturbances.seen(self.truth)
            if self.rules.estimate == "flight":
                sent = self.disturbances.last
                air.gather(self.world, self.sums, old_v, self.v, sent, self.observed)
        self._update_estimates()
        after = self._approach()
        reward = self._preset.reward(self.world, before, after, slot, self.rules.gamma)
        self.crashed |= slot.crashed
        # The time until others have landed is not its own.
        self.steps += 1 if self.traffic is None else self.traffic.lands_after < 0
        success = slot.arrived & (self.target == self.targets.last)
        if self.uavs > 1:
            reward = np.where(self.home, 0.0, reward)
            self.home |= success
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
        return Outcome(
            reward, slot, terminated, truncated, success, self.shielded.copy(), self.room.copy(),
            np.asarray(struck.any(axis=1)),
        )  # fmt: skip

    def _rests(self) -> Bools:
        """Returns which disturbed stops (N,) count: slow enough and within the tolerance."""
        miss = np.linalg.norm(self.truth - self.targets.goal[self.target], axis=1)
        slow = np.linalg.norm(self.v, axis=1) <= REST_SPEED
        return np.asarray(slow & (miss <= self.targets.tolerance[self.target]))

    def observe(self, which: Indices | None = None) -> Parts:
        """Returns the observation's named parts, each (N, d), or only their rows `which` (n,)."""
        state = State(
            self.q, self.seen_v, self.approach, self.targets.items, self.collected, self.known,
            self.asked, self._movers, self._met(), self._others(),
        )  # fmt: skip
        if which is None:
            return self._observation(self.seen_world, state)
        return self._observation(self.seen_world.rows(which), state.rows(which))

    def _met(self) -> Array:
        """Returns what `MovingBoxes.met` shows of where each body may fly."""
        shows = self.rules.observation in SHOW_DISTURBANCES
        if self.disturbances is None or self.disturbances.level.mover == 0.0 or not shows:
            return np.zeros((self.count, SHOWN, 2, 4))
        ways = places(self.seen_world, self.q, self.seen_v, self.approach, STEPS)
        return self.disturbances.movers.met(ways)

    def _others(self) -> Array:
        """Returns what `others_seen` shows of each UAV's fleet."""
        uavs = self.uavs if self.rules.observation in SHOW_OTHERS else 1
        return others_seen(self.seen_world, uavs, self.q, self.seen_v)

    @property
    def next_cost(self) -> Array:
        """Returns the time (N,) in s, at v_max, that the place costs on the next segment."""
        return np.asarray(self.approach.next_excess / self.world.v_max[..., 0])

    def guidance_action(self) -> Array:
        """Returns the actions (N, 3) of the guidance law of `guidance.law` in units of a_max."""
        return self.raw(self.targets.law(self.seen_world, self.target, self.q, self.seen_v))

    def raw(self, action: Array) -> Array:
        """Returns actions (N, 3) in world axes as the raw actions that `begin_slot` takes."""
        if self._framed:
            action = np.einsum("nj,nkj->nk", action, self.approach.frame)
        return action

    def _update_estimates(self) -> None:
        """Updates what is known of disturbances, and so the state and world as decisions see it."""
        self.seen_world = self.world
        if self.disturbances is None:
            return
        self._seen_q, self._seen_v = self.observed, self.v
        if self._estimates:
            if self.rules.estimate == "truth":
                self.known = self.disturbances.truth(self.world)
                self.sums[:, air.AT.position] = self.truth
                self.sums[:, air.AT.last] = self.disturbances.last / self.world.a_max
            else:
                self.known = air.estimate(self.world, self.sums)
            self._seen_q, self._seen_v = air.foretell(
                self.world, self.sums, self.known, self.sums[:, air.AT.position], self.v
            )
            a_max = self.known.usable(self.world.a_max)
            self.seen_world = self.seen_world._replace(a_max=a_max)
        movers = self.disturbances.movers
        if self.disturbances.level.mover > 0.0:
            movers.told = self.rules.estimate == "truth"
            boxes = joined(self.world.boxes, movers.boxes, axis=1)
            self.seen_world = self.seen_world._replace(boxes=boxes)
            self._movers = movers.seen(self.q, self.seen_v, self.world.v_max)

    def _approach(self) -> Approach:
        """Returns a new approach of all episodes."""
        approach = Approach.empty(self.count)
        self._update_approach(approach, self._all)
        return approach

    def _update_approach(self, approach: Approach, which: Indices) -> None:
        """Writes the rows `which` (n,) of an approach."""
        self.targets.update_approach(
            self.seen_world, self.target, self.q, self.seen_v, which, approach
        )
