"""Evaluates policies by flying them without noise from many starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.flight.disturbance import Disturbances
from mjcollect.flight.straight_line import time_to_go
from mjcollect.flight.world import World
from mjcollect.guidance.guidance import Guidance
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.random_streams import stream


@dataclass(frozen=True)
class Evaluation:
    """Holds the result of flying a policy without noise from many starts.

    Attributes:
        success_rate: share of the starts from which it arrived.
        point_rate: share of the courses on which it arrived from the start point itself.
        point_time: mean time of these arrivals (s), NaN if there were none.
        mean_time: mean time of all arrivals (s), NaN if there were none.
        mean_cost: the same plus the time that the places of the stops cost on the next segment.
        mean_return: mean undiscounted return over all starts.
        failure_seconds: time for which a start without arrival counts in ranking (s); if it is
            infinite, one more arrival is better, however late.
        shield_share: share of all slots flown in which the shield changed the command.
    """

    success_rate: float
    point_rate: float
    point_time: float
    mean_time: float
    mean_cost: float
    mean_return: float
    failure_seconds: float = math.inf
    shield_share: float = 0.0

    @property
    def rank(self) -> tuple[float, ...]:
        """Returns a tuple that is larger for better: arrive from the point, from all, then soon."""
        cost = self.mean_cost if math.isfinite(self.mean_cost) else math.inf
        if math.isfinite(self.failure_seconds):
            return (self.point_rate, -cost - self.failure_seconds * (1.0 - self.success_rate))
        return (self.point_rate, self.success_rate, -cost)


class Evaluator:
    """Flies policies from the same starts, and through the same disturbances, every time."""

    def __init__(
        self,
        courses: Sequence[Course],
        config: LearnConfig,
        seed: int,
        disturbances: Disturbances | None = None,
        failure_seconds: float = math.inf,
        uavs: int = 1,
    ) -> None:
        """Draws the starts on every course, each of one segment, from the stream `evaluate`.

        Args:
            uavs: number of UAVs in a fleet, to which so many flights that follow each other belong.
            disturbances: those of len(courses) * config.eval_episodes simulations, course by
                course, if any.
            failure_seconds: explained at `Evaluation` (s).
        """
        self._failure_seconds = failure_seconds
        rng, each = np.random.default_rng(stream(seed, "evaluate")), config.eval_episodes
        self.sims = Simulations(
            [courses[0]] if len(courses) == 1 else [c for c in courses for _ in range(each)],
            len(courses) * each,
            rules=config.rules,
            threads=config.threads,
            disturbances=disturbances,
            uavs=uavs,
        )
        self._fresh = None if disturbances is None else disturbances.state_dict()
        starts = [
            course.starts(*kind, rng)
            for course in courses
            for kind in (("point", 1), ("ball", each - 1))
        ]
        self._q, self._v = (np.concatenate(part) for part in zip(*starts, strict=True))
        self._points = np.arange(0, len(self._q), each)
        self.least = float(
            np.mean(
                [
                    _least_time(c, self._q[k : k + each])
                    for c, k in zip(courses, self._points, strict=True)
                ]
            )
        )

    def __call__(self, policy: Callable[[np.ndarray], np.ndarray]) -> Evaluation:
        """Evaluates a policy from observations (N, D) float32 to actions (N, 3)."""
        sims, count = self.sims, len(self._q)
        if self._fresh is not None:
            assert sims.episodes.disturbances is not None
            sims.episodes.disturbances.load_state_dict(self._fresh)
        sims.place(np.arange(count), self._q, self._v)
        running = np.ones(count, dtype=bool)
        success, slots, total = np.zeros(count, bool), np.zeros(count), np.zeros(count)
        next_cost, shielded = np.zeros(count), 0
        while running.any():
            outcome = sims.step(policy(sims.observe().astype(np.float32)))
            total += np.where(running, outcome.reward, 0.0)
            # Where a crash does not end the episode, an arrival after one is no success.
            success |= running & outcome.success & ~sims.episodes.crashed
            next_cost = np.where(running, sims.episodes.next_cost, next_cost)
            slots += running
            shielded += int((running & outcome.shielded).sum())
            running &= ~(outcome.terminated | outcome.truncated)
        time = slots * sims.episodes.world.slot
        arrived = self._points[success[self._points]]
        return Evaluation(
            success_rate=float(success.mean()),
            point_rate=len(arrived) / len(self._points),
            point_time=float(time[arrived].mean()) if len(arrived) else math.nan,
            mean_time=float(time[success].mean()) if success.any() else math.nan,
            mean_cost=float((time + next_cost)[success].mean()) if success.any() else math.nan,
            mean_return=float(total.mean()),
            failure_seconds=self._failure_seconds,
            shield_share=shielded / float(slots.sum()),
        )

    def law(self) -> Evaluation:
        """Evaluates the guidance law."""
        return self(lambda _: self.sims.law())

    def close(self) -> None:
        """Stops the simulations' threads."""
        self.sims.close()


def _least_time(course: Course, q: np.ndarray) -> float:
    """Estimates the least `Evaluation.mean_cost` (s) from starts (n, 3) on a course of one segment.

    It assumes whole slots along the shortest paths, and a stop in the ball nearest to what follows.
    """
    scene, guide = course.scene, course.guidance[0]
    saved = 0.0 if guide.next_goal is None else guide.tolerance / scene.v_max
    return float(least_slots(guide, q).mean()) * scene.slot - saved


def least_slots(guide: Guidance, q: np.ndarray) -> np.ndarray:
    """Estimates the least number of slots (N,) from rest at q (N, 3), along the way to the ball."""
    world = World.stack([guide.scene])
    beside = float(np.linalg.norm(guide.aim - guide.goal))
    distance, _ = guide.query(q)
    distance = np.maximum(distance - max(guide.tolerance - beside, 0.0), 0.0)
    time = time_to_go(world, distance, np.zeros(len(q)))
    return np.asarray(np.ceil(time / world.slot - 1e-6))
