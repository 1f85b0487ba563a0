"""Flies a course many times in disturbed air, all at once, and records every physics step.

flown = fly_disturbed(course, policy, Disturbance(wind=5.0), flights=100)
print(flown.success_rate)
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from tqdm import tqdm

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.exploration import Exploration
from mjcollect.envs.outcome import Outcome
from mjcollect.envs.recording import SILENT, Flight
from mjcollect.flight.disturbance import STRENGTHS, Disturbance, Disturbances
from mjcollect.flight.moving_boxes import LEAST_WAY, MovingBoxes
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array
from mjcollect.scene.air import Air
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.trajectory import Recorder

HOME, STANDING, MOVING = "home", "standing box", "moving box"
OUTSIDE, LATE = "out of bounds", "too late"
MET = "too near to another UAV"  # only in a fleet
ENDS = (HOME, STANDING, MOVING, OUTSIDE, LATE)  # A flight ends in one of these ways.
CONFIDENCE = 0.95
CLEAR = 20.0  # A box that is drawn begins at least this far (m) from where the flight begins.
Pilot = Callable[[Simulations], Array]  # actions (N, 3) in units of a_max


class Measure(NamedTuple):
    """Holds a measured value with its 95% interval; None where too few flights say nothing."""

    value: float | None
    low: float | None
    high: float | None


class SeesAndActs(Protocol):
    """Is a trained policy, or anything that is like one."""

    @property
    def observation(self) -> str:
        """Returns the name of its observation."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions (N, 3) in units of a_max for observations (N, D) float32."""


@dataclass(frozen=True)
class DisturbedFlight:
    """Holds one flight.

    Attributes:
        ended: how it ended, one of ENDS.
        air: what disturbed it, None in calm air.
        gave_way: share of the slots in which the shield kept less than its margin.
    """

    flight: Flight
    ended: str
    air: Air | None
    gave_way: float = 0.0


@dataclass(frozen=True)
class DisturbedFlights:
    """Holds all flights of a course; what is measured comes with 95% intervals."""

    flights: tuple[DisturbedFlight, ...]

    @property
    def ended(self) -> dict[str, int]:
        """Returns how many flights ended in each of the ways ENDS."""
        return {end: sum(flown.ended == end for flown in self.flights) for end in ENDS}

    @property
    def success_rate(self) -> Measure:
        """Returns the share of flights that came home with everything, with Wilson's interval."""
        return self._share((HOME,))

    @property
    def contact_rate(self) -> Measure:
        """Returns the share of flights that touched a box, with Wilson's interval."""
        return self._share((STANDING, MOVING))

    @property
    def mean_time(self) -> Measure:
        """Returns the mean time (s) of the flights that came home, with Student's interval."""
        return _mean([f.flight.trajectory.duration for f in self.flights if f.ended == HOME])

    @property
    def gave_way(self) -> Measure:
        """Returns the mean share of slots in which the shield kept less than its margin."""
        value, *ends = _mean([flown.gave_way for flown in self.flights])
        return Measure(value, *(None if end is None else min(max(end, 0.0), 1.0) for end in ends))

    @property
    def shown(self) -> int:
        """Returns the number of the first flight that came home, or of the first of all."""
        return next((i for i, flown in enumerate(self.flights) if flown.ended == HOME), 0)

    def _share(self, ends: Sequence[str]) -> Measure:
        count = sum(flown.ended in ends for flown in self.flights)
        result = stats.binomtest(count, len(self.flights))
        interval = result.proportion_ci(CONFIDENCE, method="wilson")
        return Measure(count / len(self.flights), float(interval.low), float(interval.high))


def _mean(values: Sequence[float]) -> Measure:
    """Returns the mean with Student's interval."""
    if len(values) < 2:
        return Measure(values[0] if values else None, None, None)
    mean, error = float(np.mean(values)), float(np.std(values, ddof=1)) / len(values) ** 0.5
    reach = float(stats.t.ppf((1.0 + CONFIDENCE) / 2, len(values) - 1)) * error
    return Measure(mean, mean - reach, mean + reach)


class CourseAir(Disturbances):
    """Disturbs whole courses: boxes move across any of the segments, and so do the scene's own."""

    def __init__(
        self, course: Course, level: Disturbance, count: int, rng: np.random.Generator
    ) -> None:
        """Prepares for `count` flights of a course.

        Raises:
            ValueError: boxes are to move, but every segment is too short for one.
        """
        self.own, self.mover = course.scene.moving, level.mover
        self.nodes = np.array([course.scene.point(node) for node in course.nodes])
        lengths = np.linalg.norm(np.diff(self.nodes, axis=0), axis=1)
        self.long = np.flatnonzero(lengths >= LEAST_WAY)
        if level.mover > 0.0 and len(self.long) == 0:
            raise ValueError(
                f"mover: {level.mover:g}: no segment is {LEAST_WAY:g} m long, so no box would move;"
                " leave it out, or write moving boxes into the scene file"
            )
        self.drawn = level.boxes if level.mover > 0.0 else 0
        fastest = max([level.mover, *(box.speed for box in self.own)])
        super().__init__(replace(level, mover=fastest), count, rng)
        boxes = max(self.drawn + len(self.own), 1)
        self.movers = MovingBoxes(count, boxes, max([2, *(len(box.path) for box in self.own)]))

    def begin(self, which: NDArray[np.intp], start: Array, goal: Array) -> None:
        """Draws anew for the simulations `which` (n,), as `Disturbances` does, and places boxes."""
        whole, self.level = self.level, replace(self.level, mover=0.0)
        super().begin(which, start, goal)
        self.level = whole
        movers, n = self.movers, len(which)
        drawn = MovingBoxes(n)
        for b in range(self.drawn):
            segment = self.rng.choice(self.long, n)
            speed, turned = np.full((n, 1), self.mover), np.radians(self.level.turned)
            ends = self.nodes[segment], self.nodes[segment + 1]
            drawn.begin(np.arange(n), *ends, speed, self.rng, turned)
            for _ in range(3):  # No box begins where the flight does.
                off = np.abs(start - drawn.centres()[:, 0]) - drawn.half[:, 0]
                near = np.linalg.norm(np.maximum(off, 0.0), axis=1) < CLEAR
                drawn.phase[near, 0] = (drawn.phase[near, 0] + 0.25) % 1.0
            movers.path[which, b, :2] = drawn.path[:, 0]
            movers.path[which, b, 2:] = drawn.path[:, 0, -1:]
            movers.half[which, b], movers.phase[which, b] = drawn.half[:, 0], drawn.phase[:, 0]
            movers.speed[which, b] = drawn.speed[:, 0]
        for b, box in enumerate(self.own, self.drawn):
            path = np.array(box.path)
            movers.path[which, b, : len(path)] = path
            movers.path[which, b, len(path) :] = path[-1]
            movers.half[which, b] = np.array(box.size) / 2
            movers.phase[which, b], movers.speed[which, b] = box.phase, box.speed
        movers.time[which] = 0.0

    @property
    def push(self) -> Array:
        """Returns wind and gust (N, 3) now, in m/s²."""
        return self._wind + self._gusts

    def met(self, index: int, world: World, push: Array) -> Air:
        """Returns what flight `index` met, whose slots ended with a push (S, 3) each."""
        movers, moving = self.movers, []
        for b in np.flatnonzero(movers.speed[index] > 0.0):
            path, half = movers.path[index, b], movers.half[index, b]
            last = len(path)  # without the repeated corners at its end
            while last > 2 and np.array_equal(path[last - 1], path[last - 2]):
                last -= 1
            document = {"size": 2 * half, "path": path[:last], "speed": movers.speed[index, b]}
            document["phase"] = movers.phase[index, b]
            moving.append(MovingBox.from_dict(document))
        late = float(self.late_steps(world)[index] * world.step)
        wind, gain = self._wind[index].copy(), float(self._gain[index, 0])
        return Air(index, wind, gain, late, tuple(moving), float(world.slot), push)


def fly_disturbed(
    course: Course,
    policy: SeesAndActs | Sequence[SeesAndActs],
    disturbance: Disturbance,
    flights: int = 100,
    seed: int = 0,
    *,
    shield: bool = True,
    explore: bool = True,
) -> DisturbedFlights:
    """Flies a course by a policy `flights` times from rest at its start, each in air of its own.

    Args:
        policy: one `TrainedPolicy`, or one for each segment, all of one observation.
        disturbance: how strong wind, gusts and so on are. Moving boxes of the scene come on top.
        seed: of all draws; the same seed gives the same flights.
        shield: whether to bend commands that leave no way to stop without touching anything.
        explore: whether the policy tries something else where it gets no nearer.

    Raises:
        ValueError: boxes are to move, but every segment is too short for one.
    """
    policies = list(policy) if isinstance(policy, Sequence) else [policy]
    rules = Rules(policies[0].observation, shield=shield)
    pilot = by_policies(policies, explore=explore)
    return fly_batch(course, pilot, rules, disturbance, flights, seed)


def by_policies(policies: Sequence[SeesAndActs], *, explore: bool = True) -> Pilot:
    """Returns a pilot of one policy, or of one for each segment.

    Args:
        explore: whether it tries something else where it gets no nearer; see `exploration`.
    """
    exploration: Exploration | None = None

    def decided(sims: Simulations) -> Array:
        seen = sims.observe().astype(np.float32)
        if len(policies) == 1:
            return policies[0](seen)
        target, actions = sims.episodes.target, np.zeros((sims.count, 3))
        for segment in np.unique(target):
            rows = np.flatnonzero(target == segment)
            actions[rows] = policies[segment](seen[rows])
        return actions

    def pilot(sims: Simulations) -> Array:
        nonlocal exploration
        if not explore:
            return decided(sims)
        if exploration is None or (sims.episodes.steps == 0).all():
            exploration = Exploration(sims.count)
        return exploration(sims.episodes, decided(sims))

    return pilot


def fly_batch(
    course: Course, pilot: Pilot, rules: Rules, disturbance: Disturbance, flights: int,
    seed: int | Sequence[int], *, bar: bool = True,
) -> DisturbedFlights:  # fmt: skip
    """Flies a course `flights` times by any pilot; further arguments as in `fly_disturbed`.

    Without any disturbance or moving box the flights are calm, and judged as such.
    """
    air = course_air(course, disturbance, flights, np.random.default_rng(seed))
    sims = Simulations([course], flights, rules=rules, disturbances=air)
    segments = len(course.guidance)
    shown = tqdm(
        total=flights * segments, desc="flights", unit="segment", delay=SILENT, leave=False,
        mininterval=0.1 if sys.stderr.isatty() else 10.0, disable=not bar,
    )  # fmt: skip
    try:
        sims.reset()
        tracks = [Track(course, sims, index) for index in range(flights)]
        running = np.arange(flights)
        while len(running):
            outcome = sims.step(pilot(sims))
            push = None if air is None else air.push
            for index in running:
                tracks[index].slot(sims, outcome, push)
            running = np.array([i for i in running if not tracks[i].ended], dtype=int)
            done = sum(segments if track.ended else track.reached for track in tracks)
            shown.update(done - shown.n)
        return DisturbedFlights(tuple(track.flown(sims, air) for track in tracks))
    finally:
        shown.close()
        sims.close()


def course_air(
    course: Course, level: Disturbance, count: int, rng: np.random.Generator
) -> CourseAir | None:
    """Returns what disturbs `count` flights of a course; None if nothing does, and no box moves.

    Raises:
        ValueError: as `CourseAir` says.
    """
    calm = not is_disturbed(level) and not course.scene.moving
    return None if calm else CourseAir(course, level, count, rng)


def is_disturbed(level: Disturbance) -> bool:
    """Returns whether a level disturbs at all."""
    return any(getattr(level, kind) > 0.0 for kind in STRENGTHS)


class Track:
    """Records one of the flights of a batch.

    Attributes:
        ended: how it ended, one of ENDS; empty while it goes on.
    """

    def __init__(self, course: Course, sims: Simulations, index: int) -> None:
        """Begins with where flight `index` of the simulations, on a course, is now."""
        self._scene, self._index, self.ended = course.scene, index, ""
        q, v = sims.episodes.truth[index], sims.episodes.v[index]
        self._recorder = Recorder(q, v, course.scene.physics_step)
        self._arrivals: list[float] = []
        self._shielded: list[bool] = []
        self._gave_way = 0
        self._pushes: list[Array] = []

    @property
    def reached(self) -> int:
        """Returns how many targets were reached so far."""
        return len(self._arrivals)

    def slot(self, sims: Simulations, outcome: Outcome, push: Array | None) -> None:
        """Adds the slot just flown, up to the step that ended the flight if one did."""
        index, slot = self._index, outcome.slot
        rows = int(slot.first_event[index]) + 1
        path, speeds = sims.path[index, :rows], sims.speeds[index, :rows]
        self._recorder.slot(path, speeds, sims.acceleration[index])
        self._shielded.append(bool(outcome.shielded[index]))
        self._gave_way += int(outcome.room[index] < 1.0)
        if push is not None:
            self._pushes.append(push[index])
        if slot.arrived[index]:
            scene = self._scene
            self._arrivals.append(len(self._shielded) * scene.substeps * scene.physics_step)
        for happened, end in (
            (outcome.success, HOME),
            (outcome.struck, MOVING if sims.uavs == 1 else MET),
            (slot.contact, STANDING),
            (slot.outside, OUTSIDE),
            (outcome.truncated, LATE),
        ):
            if happened[index]:
                self.ended = end
                break

    def flown(self, sims: Simulations, air: CourseAir | None) -> DisturbedFlight:
        """Returns the flight, which has ended."""
        trajectory, met = self._recorder.trajectory(), None
        if air is not None:  # What acted differs from the commands, and follows from the rows.
            acted = np.diff(trajectory.v, axis=0) / self._scene.physics_step
            trajectory = replace(trajectory, a=np.append(acted, np.zeros((1, 3)), axis=0))
            met = air.met(self._index, sims.episodes.world, np.reshape(self._pushes, (-1, 3)))
        touched = int(self.ended in (STANDING, MOVING))
        flight = Flight(
            trajectory, self.ended == HOME, touched, tuple(self._arrivals), tuple(self._shielded),
            self._scene.slot,
        )  # fmt: skip
        gave_way = self._gave_way / len(self._shielded)
        return DisturbedFlight(flight, self.ended, met, gave_way)
