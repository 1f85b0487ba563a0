"""Flying a policy without noise from many starts, and the named random streams of a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjcollect.batch import Simulations
from mjcollect.course import Course
from mjcollect.episode import Rules
from mjcollect.racing_line import least_slots
from train.learn_config import LearnConfig


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """The named random stream of a seed: streams of different names are independent."""
    return np.random.SeedSequence([seed, *name.encode()])


@dataclass(frozen=True)
class Evaluation:
    """A policy flown without noise from many starts.

    Attributes:
        success_rate: share of the starts from which it arrived.
        point_success, point_time: whether and in how many seconds it arrived from the point.
        mean_time: over the arrivals, in seconds; NaN if there were none.
        mean_cost: the same with what the places of the stops cost on the next leg.
        mean_return: undiscounted return over all starts.
    """

    success_rate: float
    point_success: bool
    point_time: float
    mean_time: float
    mean_cost: float
    mean_return: float

    @property
    def rank(self) -> tuple[float, ...]:
        """Larger is better: arrive from the point, from everywhere, then sooner."""
        cost = self.mean_cost if math.isfinite(self.mean_cost) else math.inf
        return (float(self.point_success), self.success_rate, -cost)


class Evaluator:
    """Flies policies from the same starts every time."""

    def __init__(self, course: Course, config: LearnConfig, seed: int) -> None:
        """Draw the starts from the stream `evaluate`."""
        self._course = course
        rng = np.random.default_rng(stream(seed, "evaluate"))
        rules = Rules(config.observation, config.reward, config.gamma)
        self.sims = Simulations([course], config.eval_episodes, rules=rules, threads=config.threads)
        point = course.starts("point", 1, rng)
        ball = course.starts("ball", config.eval_episodes - 1, rng)
        self._q = np.concatenate([point[0], ball[0]])
        self._v = np.concatenate([point[1], ball[1]])
        self.least = self._least_time()

    def _least_time(self) -> float:
        """Estimate of the least `Evaluation.mean_cost` in s.

        Whole slots along the shortest paths, and a stop where the ball is nearest to what follows.
        """
        scene, guide = self._course.scene, self._course.guidance[0]
        saved = 0.0 if guide.beyond is None else guide.tolerance / scene.v_max
        return float(least_slots(guide, self._q).mean()) * scene.slot - saved

    def __call__(self, policy: Callable[[np.ndarray], np.ndarray]) -> Evaluation:
        """Evaluate `policy`: observations (N, D) float32 -> actions (N, 3)."""
        sims, count = self.sims, len(self._q)
        sims.place(np.arange(count), self._q, self._v)
        running = np.ones(count, dtype=bool)
        success, slots, total = np.zeros(count, bool), np.zeros(count), np.zeros(count)
        onward = np.zeros(count)
        while running.any():
            outcome = sims.step(policy(sims.observe().astype(np.float32)))
            total += np.where(running, outcome.reward, 0.0)
            # Where a crash does not end the episode, an arrival after one is no success.
            success |= running & outcome.success & ~sims.episodes.crashed
            onward = np.where(running, sims.episodes.onward, onward)
            slots += running
            running &= ~(outcome.terminated | outcome.truncated)
        time = slots * sims.episodes.world.slot
        return Evaluation(
            success_rate=float(success.mean()),
            point_success=bool(success[0]),
            point_time=float(time[0]) if success[0] else math.nan,
            mean_time=float(time[success].mean()) if success.any() else math.nan,
            mean_cost=float((time + onward)[success].mean()) if success.any() else math.nan,
            mean_return=float(total.mean()),
        )

    def close(self) -> None:
        """Stop the simulations' threads."""
        self.sims.close()
