"""Settings of the learner, each a flag of the programs that train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mjcollect.envs.episode import Rules


@dataclass(frozen=True)
class LearnConfig:
    """Settings of the learner. Budgets count updates and environment steps, never seconds."""

    updates: int = 6_000
    """Parameter updates in all (the paper's M episodes of P steps with U_2 updates each)."""
    least_updates: int = 1_000
    """Updates after which training may stop early, see `gap`; the default counts as 0 where
    learning goes on from a policy."""
    gap: float = 0.05
    """Seconds: stop when arriving from everywhere within this of the least cost, on average."""
    patience: int = 2_500
    """Updates without a better evaluation after which training stops early."""
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
    optimizer: Literal["adam", "sgd"] = "adam"
    """Gradient steps: Adam's, or the plain ones of Algorithm 1."""
    actor_delay: int = 300
    """Updates of the critic alone before the actor's begin."""
    gamma: float = 0.95
    """Discount factor per slot."""
    alpha_actor: float = 1e-3
    """alpha^(theta): learning rate of the actor at the start."""
    alpha_critic: float = 1e-3
    """alpha^(w): learning rate of the critic at the start."""
    alpha_target: float = 0.01
    """Target network learning rate."""
    final_rate: float = 0.1
    """Share of the learning rates left at the end, reached linearly."""
    average_rate: float = 0.002
    """Rate of the Polyak average of the actors that is evaluated beside the actor; 0: none."""
    flown: Literal["best", "last"] = "best"
    """Which evaluated policy is flown: the best, or the last as in Algorithm 1."""
    noise_min: float = 0.05
    """Standard deviation of the Gaussian action noise in the calmest simulation, as a share of
    a_max."""
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
    observation: str = "path"
    """Observation: path (guided, as seen from the path), guided, robust (guided, and what last kept
    the flight from its command), or paper."""
    reward: str = "lost"
    """Reward preset: lost, time, careful (crashes cost more) or paper."""
    shield: bool = True
    """Bend commands that leave no way to stop without touching anything; else a crash ends an
    episode."""

    def __post_init__(self) -> None:
        """Check what would fail late.

        Raises:
            ValueError: naming field, value and fix.
        """
        counts = ("updates", "patience", "envs", "u1", "u2", "batch", "width", "threads")
        for field in (*counts, "eval_every", "eval_episodes"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}: {getattr(self, field)}: must be at least 1")
        for field in ("extra_updates", "least_updates", "actor_delay", "demonstrations"):
            if getattr(self, field) < 0:
                raise ValueError(f"{field}: {getattr(self, field)}: must not be negative")
        for field in ("alpha_actor", "alpha_critic"):
            if not 0.0 < getattr(self, field) < math.inf:
                raise ValueError(f"{field}: {getattr(self, field)}: must be a positive number")
        for field in ("gap",):
            if not 0.0 <= getattr(self, field) < math.inf:
                raise ValueError(f"{field}: {getattr(self, field)}: must be a number from 0 on")
        shares = ("alpha_target", "average_rate", "final_rate", "guided_share", "guided_until")
        for field in shares:
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
        self.rules  # noqa: B018  (raises for unknown names)

    @property
    def rules(self) -> Rules:
        """Of the episodes that are learned and flown."""
        return Rules(self.observation, self.reward, self.gamma, self.shield)
