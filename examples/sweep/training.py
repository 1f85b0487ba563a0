"""Trains the trials of `examples.sweep`: several seeds at once, each in a process of a pool."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjcollect.envs.course import Course
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.evaluation import Evaluation, Evaluator
from mjcollect.learning.trainer import segment_trainer
from mjcollect.scene.bounds import segment_bound
from mjcollect.scene.scene import Scene
from train.jobs.processes import importing_pool
from train.support.run_folder import RunError

JUDGED = 1_000_000  # Policies are judged from starts of this seed, in which no training evaluates.
NEVER_ARRIVED = 3.0  # A start without arrival counts as so many times the bound.


@dataclass(frozen=True)
class Task:
    """Says what every training learns, and how it is judged; it goes to the processes."""

    folder: Path
    order: tuple[int, ...]
    segment: int
    config: LearnConfig
    judged: int

    @functools.cached_property
    def course(self) -> Course:
        """Returns the segment, with the guidance in the folder if it is there."""
        scene = Scene.load(self.folder / "scene.json")
        return Course.segment(scene, self.order, self.segment, self.folder / "guidance")


class Training:
    """Trains with one seed, from evaluation to evaluation, in a process of the pool."""

    def __init__(self, task: Task, settings: Mapping[str, Any], seed: int) -> None:
        """Prepares the training."""
        self.task = task
        self.trainer = segment_trainer(
            task.course, dataclasses.replace(task.config, **settings), seed
        )
        self._updates = self.trainer.run()

    def advance(self) -> float:
        """Trains until the next evaluation; returns the score of the best policy so far."""
        rows = len(self.trainer.rows)
        while len(self.trainer.rows) == rows and next(self._updates, None) is not None:
            pass
        assert self.trainer.best is not None
        return score(self.task, self.trainer.best)

    def judge(self) -> tuple[float, float]:
        """Returns score and success rate of the best policy, flown from starts new to it."""
        trainer, task = self.trainer, self.task
        for _ in self._updates:
            pass
        assert trainer.best_policy is not None
        trainer.learner.actor.load_state_dict(trainer.best_policy)
        starts = dataclasses.replace(task.config, eval_episodes=task.judged)
        judge = Evaluator([task.course], starts, JUDGED)
        result = judge(trainer.policy)
        judge.close()
        return score(task, result), result.success_rate


def score(task: Task, result: Evaluation) -> float:
    """Returns the mean time over the lower bound, which holds for every start in the ball."""
    bound = segment_bound(task.course.scene, *task.course.nodes)
    arrived = result.success_rate * result.mean_time / bound if result.success_rate else 0.0
    return arrived + (1.0 - result.success_rate) * NEVER_ARRIVED


TRAININGS: dict[int, Training] = {}  # Those of a process, by their seed.


def begin(task: Task, settings: Mapping[str, Any], seed: int) -> None:
    """Begins a training, in a process, in place of the one that had the seed before."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    end(seed)
    TRAININGS[seed] = Training(task, settings, seed)


def advance(seed: int) -> float:
    """Is `Training.advance`, in the process that began it."""
    return TRAININGS[seed].advance()


def judge(seed: int) -> tuple[float, float]:
    """Is `Training.judge`, in the process that began it."""
    return TRAININGS[seed].judge()


def end(seed: int) -> None:
    """Ends a training, if it was begun."""
    if (training := TRAININGS.pop(seed, None)) is not None:
        training.trainer.close()


class Crew:
    """Calls functions for several seeds side by side, a seed always in the same process."""

    def __init__(self, jobs: int) -> None:
        """Starts the processes."""
        self._lanes: list[Executor] = [importing_pool(1) for _ in range(jobs)]

    def each(self, call: Callable[..., Any], seeds: Sequence[int]) -> list[Any]:
        """Returns call(seed) of every seed.

        Raises:
            RunError: a process was killed.
        """
        try:
            futures = [
                self._lanes[k % len(self._lanes)].submit(call, seed) for k, seed in enumerate(seeds)
            ]
            return [future.result() for future in futures]
        except BrokenExecutor:
            raise RunError("a training process was killed; go on with --resume") from None

    def close(self) -> None:
        """Ends the processes, when they are done with what they do now."""
        for lane in self._lanes:
            lane.shutdown(cancel_futures=True)


def train(
    crew: Crew, task: Task, settings: Mapping[str, Any], seeds: Sequence[int],
    worse: Callable[[int, float], bool] = lambda evaluation, mean: False,
) -> tuple[list[float], float]:  # fmt: skip
    """Trains with all seeds; returns the score of each, and their mean success rate.

    Args:
        worse: called with the number of evaluations and the mean score; if it returns true, the
            training ends there, the scores are those of the evaluation, and the success rate NaN.
    """
    try:
        crew.each(functools.partial(begin, task, settings), seeds)
        for evaluation in range(1, task.config.updates // task.config.eval_every):
            scores = crew.each(advance, seeds)
            if worse(evaluation, float(np.mean(scores))):
                return scores, math.nan
        scores, successes = zip(*crew.each(judge, seeds), strict=True)
        return list(scores), float(np.mean(successes))
    finally:
        with contextlib.suppress(RunError):  # a process was killed
            crew.each(end, seeds)


@contextlib.contextmanager
def hired(jobs: int) -> Iterator[Crew]:
    """Gives a crew, and sends it home."""
    crew = Crew(jobs)
    try:
        yield crew
    finally:
        crew.close()
