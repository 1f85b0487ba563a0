"""The training loop of Algorithm 1 over N simulations at once, with evaluation and checkpoints."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from mjcollect.batch import BatchedFlightEnv, Simulations
from mjcollect.course import Course
from mjcollect.episode import Rules
from mjcollect.reward import time_to_go
from train.ddpg import make_buffer, transitions
from train.lean import LEARNERS
from train.policies import TrainedPolicy


@dataclass(frozen=True)
class LearnConfig:
    """Settings of the learner. Budgets count updates and environment steps, never seconds."""

    updates: int = 6_000
    """Parameter updates in all (the paper's M episodes of P steps with U_2 updates each)."""
    least_updates: int = 1_000
    """Updates after which training may stop early, see `gap`."""
    gap: float = 0.05
    """Seconds: stop when arriving from everywhere within this of the least cost, on average."""
    extra_updates: int = 10_000
    """Further updates, at most, if by then no evaluated policy has arrived from every start."""
    envs: int = 64
    """Simulations side by side."""
    u1: int = 1
    """U_1: environment operations, in every simulation, before each round of updates."""
    u2: int = 8
    """U_2: updates in a round."""
    batch: int = 256
    """Transitions in a batch B."""
    buffer: int = 200_000
    """Capacity of the experience replay buffer D, in transitions."""
    width: int = 128
    """Width of the two hidden layers of actor and critic."""
    learner: Literal["lean", "torchrl"] = "lean"
    """How updates are computed: hand-written gradients, or TorchRL's DDPGLoss; same numbers."""
    residual: float = 0.3
    """Greatest correction of the guidance law that the policy learns; 0: actions of its own, as
    always with the paper's observation, which does not show the law's."""
    hard_residual: float = 0.6
    """The same where the law is slower than `hard_gap`."""
    hard_gap: float = 1.0
    """Seconds that the law needs beyond the least time, on average, in a hard segment."""
    actor_delay: int = 300
    """Updates of the critic alone before the actor's begin."""
    gamma: float = 0.99
    """Discount factor per slot."""
    alpha_actor: float = 1e-3
    """alpha^(theta): learning rate of the actor at the start."""
    alpha_critic: float = 1e-3
    """alpha^(w): learning rate of the critic at the start."""
    alpha_target: float = 0.01
    """Target network learning rate."""
    final_rate: float = 0.1
    """Share of the learning rates left at the end, reached linearly."""
    noise_min: float = 0.05
    """Standard deviation of the Gaussian action noise in the calmest simulation, as a share of the
    correction in force, or of a_max where there is none."""
    noise_max: float = 0.3
    """The same in the wildest; the others lie between."""
    demonstrations: int = 10_000
    """Transitions of the guidance law, with noise, that start the buffer; 0 for none."""
    guided_share: float = 0.25
    """Share of the simulations flown by the guidance law at first; 0 for none."""
    guided_until: float = 0.6
    """Share of the updates after which the policy flies all simulations."""
    eval_every: int = 500
    """Updates between evaluations without noise."""
    eval_episodes: int = 32
    """Starts of an evaluation: the segment's own point, then seeded ones all over its ball."""
    threads: int = 1
    """MuJoCo's threads; the results do not depend on them."""
    observation: str = "guided"
    """Observation: guided or paper."""
    reward: str = "time"
    """Reward preset: time or paper."""

    def __post_init__(self) -> None:
        """Check what would fail late.

        Raises:
            ValueError: naming field, value and fix.
        """
        counts = ("updates", "envs", "u1", "u2", "batch", "width", "threads")
        for field in (*counts, "eval_every", "eval_episodes"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}: {getattr(self, field)}: must be at least 1")
        for field in ("extra_updates", "least_updates", "actor_delay", "demonstrations"):
            if getattr(self, field) < 0:
                raise ValueError(f"{field}: {getattr(self, field)}: must not be negative")
        for field in ("alpha_actor", "alpha_critic"):
            if not 0.0 < getattr(self, field) < math.inf:
                raise ValueError(f"{field}: {getattr(self, field)}: must be a positive number")
        for field in ("gap", "hard_gap"):
            if not 0.0 <= getattr(self, field) < math.inf:
                raise ValueError(f"{field}: {getattr(self, field)}: must be seconds, from 0 on")
        shares = ("alpha_target", "final_rate", "guided_share", "guided_until")
        for field in (*shares, "residual", "hard_residual"):
            if not 0.0 <= getattr(self, field) <= 1.0:
                raise ValueError(f"{field}: {getattr(self, field)}: must lie between 0 and 1")
        if self.buffer < max(self.batch, self.envs, self.demonstrations):
            raise ValueError(
                f"buffer: {self.buffer}: must hold a batch of {self.batch}, one step of "
                f"{self.envs} simulations, and {self.demonstrations} demonstrations"
            )
        if not 0.0 <= self.noise_min <= self.noise_max < math.inf:
            raise ValueError(
                f"noise_max: {self.noise_max}: must be at least noise_min = {self.noise_min}, "
                "and both numbers from 0 on"
            )
        Rules(self.observation, self.reward, self.gamma)


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


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """The named random stream of a seed: streams of different names are independent."""
    return np.random.SeedSequence([seed, *name.encode()])


def torch_seed(seed: int, name: str) -> int:
    """Seed for a torch generator from the named stream."""
    return int(stream(seed, name).generate_state(1, np.uint64)[0] >> 1)


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
        world, guide = self.sims.episodes.world, self._course.guidance[0]
        distance, _ = guide.query(self._q)
        beside = float(np.linalg.norm(guide.aim - guide.goal))
        distance = np.maximum(distance - max(guide.tolerance - beside, 0.0), 0.0)
        time = time_to_go(world, distance, np.zeros(len(distance)))
        saved = 0.0 if guide.beyond is None else guide.tolerance / self._course.scene.v_max
        return float(np.mean(np.ceil(time / world.slot - 1e-6) * world.slot)) - saved

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


class Trainer:
    """Learns one segment. Iterate over `run()`; its whole state is in `state_dict()` and `buffer`.

    Attributes:
        learner, buffer, env: the parts. best: best evaluation so far; best_policy its weights.
        rows: one dict per evaluation, the columns of metrics.csv. finished: nothing
            left to do. seconds: spent training, kept by the caller.
    """

    def __init__(self, course: Course, config: LearnConfig, seed: int, device: str = "cpu") -> None:
        """Build the simulations, the networks and the random streams of `seed`."""
        self.course, self.config, self.seed, self.device = course, config, seed, device
        torch.manual_seed(torch_seed(seed, "torch"))
        rules = Rules(config.observation, config.reward, config.gamma)
        sims = Simulations(
            [course],
            config.envs,
            rules=rules,
            start="spread",
            rng=np.random.default_rng(stream(seed, "start")),
            threads=config.threads,
        )
        self.env = BatchedFlightEnv(sims, device=device)
        size = self.env.observation_spec["observation"].shape[-1]
        self.evaluator = Evaluator(course, config, seed)
        residual = self._residual()
        self.learner = LEARNERS[config.learner](
            size,
            width=config.width,
            gamma=config.gamma,
            alpha_actor=config.alpha_actor,
            alpha_critic=config.alpha_critic,
            alpha_target=config.alpha_target,
            final_rate=config.final_rate,
            total_updates=config.updates,
            residual=residual,
            actor_delay=config.actor_delay,
            device=device,
        )
        self.buffer = make_buffer(config.buffer, config.batch, torch_seed(seed, "replay"))
        self.noise = torch.Generator().manual_seed(torch_seed(seed, "noise"))
        scale = torch.linspace(config.noise_min, config.noise_max, config.envs) * (residual or 1.0)
        self._scale = scale[torch.randperm(config.envs, generator=self.noise)][:, None]
        self._guided = torch.arange(config.envs) < round(config.guided_share * config.envs)
        self.env_steps = self.episodes = 0
        self.rows: list[dict[str, float]] = []
        self.best: Evaluation | None = None
        self.best_policy: dict[str, torch.Tensor] | None = None
        self.finished = False
        self.seconds = 0.0
        self._returns = torch.zeros(config.envs, 1)
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=200)
        self._losses: list[torch.Tensor] = []
        self._now = self.env.reset()

    def _residual(self) -> float:
        """The correction in force: larger where the guidance law leaves much to be gained."""
        if self.config.observation != "guided":
            return 0.0
        episodes = self.evaluator.sims.episodes
        law = self.evaluator(lambda _: episodes.guidance_action())
        hard = not law.mean_cost <= self.evaluator.least + self.config.hard_gap
        return self.config.hard_residual if hard or law.success_rate < 1.0 else self.config.residual

    def run(self) -> Iterator[int]:
        """Train to the end of the budget, yielding the number of updates after each round."""
        config = self.config
        while len(self.buffer) < max(config.demonstrations, config.batch):
            self._operate(guided=torch.full_like(self._guided, config.demonstrations > 0))
        if not self.rows:
            self._evaluate()  # of what nothing has been learned for yet
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
        """Updates in all; fewer if there is nothing to gain, more while not every start arrives."""
        config, best = self.config, self.best
        good = best is not None and best.success_rate == 1.0
        done = good and best is not None and best.mean_cost <= self.evaluator.least + config.gap
        if good and self.learner.updates >= (config.least_updates if done else config.updates):
            return self.learner.updates
        return config.updates + (0 if good else config.extra_updates)

    @property
    def _spent(self) -> bool:
        return self.learner.updates >= self.budget

    @torch.no_grad()
    def _operate(self, guided: torch.Tensor) -> None:
        """One environment operation in every simulation, stored in the buffer."""
        step = self.learner.actor(self._now)
        action = step["action"].cpu()
        if guided.any():
            law = torch.from_numpy(self.env.simulations.episodes.guidance_action()).float()
            action = torch.where(guided[:, None], law, action)
        noise = torch.randn(action.shape, generator=self.noise) * self._scale
        step["action"] = (action + noise).clamp(-1.0, 1.0).to(self.device)
        step, self._now = self.env.step_and_maybe_reset(step)
        self.buffer.extend(transitions(step).cpu())
        self.env_steps += self.config.envs
        self._count(step["next"])

    def _count(self, after: TensorDictBase) -> None:
        self._returns += after["reward"].cpu()
        done = after["done"].cpu().squeeze(-1)
        for index in torch.nonzero(done).flatten().tolist():
            self.episodes += 1
            success, crashed = after["success"][index].item(), after["crashed"][index].item()
            self._recent.append((self._returns[index].item(), float(success), float(crashed)))
        self._returns[done] = 0.0

    @property
    def policy(self) -> TrainedPolicy:
        """The current actor, without noise."""
        return TrainedPolicy(self.learner.actor, self.config.observation)

    def _evaluate(self) -> None:
        """Fly the actor and the average of past actors; keep the better if it is the best yet."""
        tried = [
            (self.evaluator(TrainedPolicy(actor, self.config.observation)), actor)
            for actor in (self.learner.actor, self.learner.averaged)
        ]
        result, actor = max(tried, key=lambda pair: pair[0].rank)
        if self.best is None or result.rank > self.best.rank:
            self.best = result
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
            }
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything but the buffer's content and the settings."""
        episodes = self.env.simulations.episodes
        return {
            "learner": self.learner.state_dict(),
            "env_steps": self.env_steps,
            "episodes": self.episodes,
            "noise": self.noise.get_state(),
            "start_rng": self.env.simulations.rng.bit_generator.state,
            "simulations": torch.from_numpy(self.env.simulations.state.copy()),
            "episode_state": {
                name: torch.from_numpy(getattr(episodes, name).copy())
                for name in ("q", "v", "target", "collected", "steps", "crashed")
            },
            "now": self._now.to_dict(),
            "returns": self._returns.clone(),
            "recent": list(self._recent),
            "losses": list(self._losses),
            "rows": list(self.rows),
            "best": None if self.best is None else dataclasses.asdict(self.best),
            "best_policy": self.best_policy,
            "finished": self.finished,
            "seconds": self.seconds,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state of `state_dict`."""
        self.learner.load_state_dict(state["learner"])
        self.env_steps, self.episodes = state["env_steps"], state["episodes"]
        self.noise.set_state(state["noise"])
        sims = self.env.simulations
        sims.rng.bit_generator.state = state["start_rng"]
        sims.state = state["simulations"].numpy().copy()
        sims.episodes.load(
            {name: value.numpy().copy() for name, value in state["episode_state"].items()}
        )
        self._now = TensorDict(state["now"], batch_size=self.env.batch_size, device=self.device)
        self._returns = state["returns"].clone()
        self._recent.clear()
        self._recent.extend(tuple(entry) for entry in state["recent"])
        self._losses = list(state["losses"])
        self.rows = list(state["rows"])
        self.best = None if state["best"] is None else Evaluation(**state["best"])
        self.best_policy = state["best_policy"]
        self.finished, self.seconds = state["finished"], state["seconds"]

    def close(self) -> None:
        """Stop all simulation threads."""
        self.env.close()
        self.evaluator.close()
