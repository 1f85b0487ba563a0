"""Runs Algorithm 1 over N simulations at once, with evaluation, checkpoints and an early stop."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from mjcollect.envs.batch import Batch, BatchedFlightEnv, Simulations
from mjcollect.envs.course import Course
from mjcollect.flight.disturbance import Disturbances
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import make_buffer, perturbed, transitions
from mjcollect.learning.evaluation import Evaluation, Evaluator
from mjcollect.learning.fast_ddpg import LEARNERS
from mjcollect.learning.lessons import Lessons
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.learning.random_streams import stream, torch_seed


class Trainer:
    """Trains a policy: iterate over `run()`. Its state is in `state_dict()` and `buffer`.

    Attributes:
        learner, buffer, env: networks with their update, replay buffer, and environment.
        best, best_policy, best_update: the evaluation, weights and update of the policy to fly,
            which is the best evaluated so far, or the last one if `config.flown` says so.
        last: last evaluation of the averaged actor, or of the actor where there is no average.
        rows: one dict per evaluation, the columns of metrics.csv.
        finished: whether nothing is left to do.
        seconds, row_seconds: time spent (s), and that until each row; kept by the caller.
        endings, failures: (N,) episodes that ended in each simulation, and those without success.
    """

    def __init__(
        self,
        simulations: Batch,
        evaluator: Evaluator,
        config: LearnConfig,
        seed: int,
        device: str = "cpu",
        weights: Mapping[str, torch.Tensor] | None = None,
        lessons: Lessons | None = None,
    ) -> None:
        """Builds the networks and the random streams of `seed`.

        Args:
            simulations: `config.envs` simulations to learn in.
            evaluator: flies the policies.
            device: device of the networks.
            weights: state of an actor to start from, if any.
            lessons: of a teacher, on that device, if there is one.
        """
        self.config, self.seed, self.device = config, seed, device
        self.evaluator = evaluator
        torch.manual_seed(torch_seed(seed, "torch"))
        self.env = BatchedFlightEnv(simulations, device=device)
        size = self.env.observation_spec["observation"].shape[-1]
        self.learner = LEARNERS[config.learner](
            size,
            width=config.width,
            gamma=config.gamma,
            alpha_actor=config.alpha_actor,
            alpha_critic=config.alpha_critic,
            alpha_target=config.alpha_target,
            final_rate=config.final_rate,
            average_rate=config.average_rate,
            optimizer=config.optimizer,
            total_updates=config.updates,
            actor_delay=config.actor_delay,
            device=device,
            weights=weights,
        )
        self.learner.lessons = lessons
        self._starts_from_policy = weights is not None
        self.buffer = make_buffer(config.buffer, config.batch, torch_seed(seed, "replay"))
        self.noise = torch.Generator().manual_seed(torch_seed(seed, "noise"))
        scale = torch.linspace(config.noise_min, config.noise_max, config.envs)
        self._scale = scale[torch.randperm(config.envs, generator=self.noise)][:, None]
        self._guided = torch.arange(config.envs) < round(config.guided_share * config.envs)
        self.env_steps = self.episodes = 0
        self.rows: list[dict[str, float]] = []
        self.best: Evaluation | None = None
        self.best_policy: dict[str, torch.Tensor] | None = None
        self.best_update = 0
        self.finished = False
        self.seconds = 0.0
        self.row_seconds: list[float] = []
        self._returns = torch.zeros(config.envs, 1)
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=200)
        self._losses: list[torch.Tensor] = []
        self.endings, self.failures = (np.zeros(config.envs, dtype=np.int64) for _ in range(2))
        self._shielded = self._flown = 0  # These count slots since the last evaluation.
        self.last: Evaluation | None = None
        self._now = self.env.reset()

    def move(self, simulations: Batch) -> None:
        """Goes on learning in other simulations, at the start of their episodes."""
        self.env.close()
        self.env = BatchedFlightEnv(simulations, device=self.device)
        self._returns.zero_()
        self.endings[:] = self.failures[:] = 0
        self._now = self.env.reset()

    def run(self) -> Iterator[int]:
        """Trains to the end of the budget, yielding the number of updates after each round."""
        config = self.config
        if not self.rows and self._starts_from_policy:
            self._evaluate()  # What is learned must beat what it begins from,
            self.finished = self._spent  # which may already be good enough.
        while not self.finished and len(self.buffer) < max(config.demonstrations, config.batch):
            self._operate(guided=torch.full_like(self._guided, config.demonstrations > 0))
        while not self.finished:
            for _ in range(config.u1):
                early = self.learner.updates < config.guided_until * config.updates
                self._operate(guided=self._guided & early)
            before = self.learner.updates // config.eval_every
            count = min(config.u2, self.budget - self.learner.updates)
            self._losses.append(self.learner.learn(self.buffer, count))
            if self.learner.updates // config.eval_every > before or self._spent:
                self._evaluate()
            self.finished = self._spent
            yield self.learner.updates

    @property
    def budget(self) -> int:
        """Returns the updates in all: fewer at a standstill, more while not every start arrives."""
        config, best, count = self.config, self.best, self.learner.updates
        if best is None or best.success_rate < 1.0:
            return config.updates + config.extra_updates
        done = best.mean_cost <= self.evaluator.least + config.gap and count >= config.least_updates
        idle = count - self.best_update >= config.patience
        return count if done or idle or count >= config.updates else config.updates

    @property
    def _spent(self) -> bool:
        return self.learner.updates >= self.budget

    @torch.no_grad()
    def _operate(self, guided: torch.Tensor) -> None:
        """Flies and stores one slot of every simulation, by the guidance law if `guided` (N,)."""
        if guided.any():
            law = torch.from_numpy(self.env.simulations.law()).float()
        if guided.all():
            step, action = self._now.copy(), law
        else:
            step = self.learner.actor(self._now)
            action = step["action"].cpu()
            action = torch.where(guided[:, None], law, action) if guided.any() else action
        step["action"] = perturbed(action, self._scale, self.noise).to(self.device)
        step, self._now = self.env.step_and_maybe_reset(step)
        self.buffer.extend(transitions(step).cpu())
        self.env_steps += self.config.envs
        self._count(step["next"])

    def _count(self, after: TensorDictBase) -> None:
        self._returns += after["reward"].cpu()
        self._shielded += int(after["shielded"].sum())
        self._flown += self.config.envs
        done = after["done"].cpu().squeeze(-1)
        for index in torch.nonzero(done).flatten().tolist():
            self.episodes += 1
            success, crashed = after["success"][index].item(), after["crashed"][index].item()
            self._recent.append((self._returns[index].item(), float(success), float(crashed)))
            self.endings[index] += 1
            self.failures[index] += not success
        self._returns[done] = 0.0

    @property
    def policy(self) -> TrainedPolicy:
        """Returns the current actor as a policy without noise."""
        return TrainedPolicy(self.learner.actor, self.config.observation)

    def _evaluate(self) -> None:
        """Evaluates the actor and the average of past actors; keeps the better if it is to fly."""
        actors = [self.learner.actor]
        if self.config.average_rate > 0.0 and self.learner.updates > 0:  # At 0 they are the same.
            actors.append(self.learner.averaged)
        tried = [
            (self.evaluator(TrainedPolicy(actor, self.config.observation)), actor)
            for actor in actors
        ]
        result, actor = max(tried, key=lambda pair: pair[0].rank)
        plain, self.last = tried[0][0], tried[-1][0]
        average = self.last if self.config.average_rate > 0.0 else None
        last = self.config.flown == "last"
        if last or self.best is None or result.rank > self.best.rank:
            self.best, self.best_update = result, self.learner.updates
            self.best_policy = {
                name: value.detach().cpu().clone() for name, value in actor.state_dict().items()
            }
        critic_loss, actor_loss = (
            torch.cat(self._losses).mean(dim=0).tolist() if self._losses else (math.nan, math.nan)
        )
        self._losses.clear()
        returns, successes, crashes = (
            (float(np.mean(column)) for column in zip(*self._recent, strict=True))
            if self._recent
            else (math.nan, math.nan, math.nan)
        )
        self.rows.append(
            {
                "update": self.learner.updates,
                "env_steps": self.env_steps,
                "episodes": self.episodes,
                "episode_return": returns,
                "success_rate": successes,
                "crash_rate": crashes,
                "critic_loss": critic_loss,
                "actor_loss": actor_loss,
                "eval_return": result.mean_return,
                "eval_success_rate": result.success_rate,
                "eval_time": result.point_time,
                "eval_mean_time": result.mean_time,
                "best_time": self.best.point_time,
                "eval_actor_time": plain.point_time,
                "eval_average_time": average.point_time if average else math.nan,
                "eval_actor_cost": _cost(plain),
                "eval_average_cost": _cost(average) if average else math.nan,
                "shield_share": self._shielded / self._flown if self._flown else math.nan,
                "eval_shield_share": result.shield_share,
            }
        )
        self._shielded = self._flown = 0

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole state, without the buffer's content and the settings."""
        return {
            "learner": self.learner.state_dict(),
            "env_steps": self.env_steps,
            "episodes": self.episodes,
            "noise": self.noise.get_state(),
            "lessons": None if self.learner.lessons is None else self.learner.lessons.state_dict(),
            "simulations": self.env.simulations.state_dict(),
            "now": self._now.to_dict(),
            "returns": self._returns.clone(),
            "recent": list(self._recent),
            "losses": list(self._losses),
            "rows": list(self.rows),
            "best": None if self.best is None else dataclasses.asdict(self.best),
            "last": None if self.last is None else dataclasses.asdict(self.last),
            "shielded": (self._shielded, self._flown),
            "best_policy": self.best_policy,
            "best_update": self.best_update,
            "endings": (self.endings.copy(), self.failures.copy()),
            "finished": self.finished,
            "seconds": self.seconds,
            "row_seconds": list(self.row_seconds),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state that `state_dict` returned."""
        self.learner.load_state_dict(state["learner"])
        self.env_steps, self.episodes = state["env_steps"], state["episodes"]
        self.noise.set_state(state["noise"])
        if self.learner.lessons is not None:
            self.learner.lessons.load_state_dict(state["lessons"])
        self.env.simulations.load_state_dict(state["simulations"])
        self._now = TensorDict(state["now"], batch_size=self.env.batch_size, device=self.device)
        self._returns = state["returns"].clone()
        self._recent.clear()
        self._recent.extend(tuple(entry) for entry in state["recent"])
        self._losses = list(state["losses"])
        self.rows = list(state["rows"])
        self.best, self.last = (
            None if state[name] is None else Evaluation(**state[name]) for name in ("best", "last")
        )
        self._shielded, self._flown = state["shielded"]
        self.endings, self.failures = (counts.copy() for counts in state["endings"])
        self.best_policy, self.best_update = state["best_policy"], state["best_update"]
        self.finished, self.seconds = state["finished"], state["seconds"]
        # Checkpoints of earlier versions have none.
        self.row_seconds = list(state.get("row_seconds", [math.nan] * len(self.rows)))

    def close(self) -> None:
        """Stops all simulation threads."""
        self.env.close()
        self.evaluator.close()


def _cost(result: Evaluation) -> float:
    """Returns the mean cost of an evaluation (s), NaN if not every start arrives."""
    return result.mean_cost if result.success_rate == 1.0 else math.nan


def segment_trainer(
    course: Course,
    config: LearnConfig,
    seed: int,
    device: str = "cpu",
    policy: TrainedPolicy | None = None,
) -> Trainer:
    """Returns a trainer for a course of one segment.

    Args:
        policy: policy to start from, with the observation and width of `config`, if any.
    """
    return Trainer(
        make_simulations([course], config, seed),
        Evaluator([course], config, seed),
        config,
        seed,
        device,
        None if policy is None else policy.actor.state_dict(),
    )


def make_simulations(
    courses: Sequence[Course],
    config: LearnConfig,
    seed: int,
    disturbances: Disturbances | None = None,
    uavs: int = 1,
) -> Simulations:
    """Returns `config.envs` flights for a trainer, on one course or one each, `uavs` to a fleet."""
    return Simulations(
        courses,
        config.envs,
        rules=config.rules,
        start="spread",
        rng=np.random.default_rng(stream(seed, "start")),
        threads=config.threads,
        disturbances=disturbances,
        uavs=uavs,
    )
