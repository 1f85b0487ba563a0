"""Defines the settings of the learner, each a flag of the programs that train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mjcollect.envs.episode import Rules


@dataclass(frozen=True)
class LearnConfig:
    """Holds the settings of the learner.

    Budgets count updates and environment steps, never seconds.
    """

    updates: int = 6_000
    """Sets the number of updates in all (the paper: M episodes of P steps, U_2 updates each)."""
    least_updates: int = 1_000
    """Forbids an early stop by --gap before this many updates; by default 0 if given a policy."""
    gap: float = 0.05
    """Stops once every start arrives and the mean cost is within this many seconds of the least."""
    patience: int = 2_500
    """Stops after this many updates without a better evaluation."""
    extra_updates: int = 10_000
    """Allows up to this many further updates while no evaluated policy arrives from every start."""
    envs: int = 64
    """Sets the number of simulations that run side by side."""
    u1: int = 1
    """Sets U_1, the slots flown in every simulation before each round of updates."""
    u2: int = 8
    """Sets U_2, the number of updates in a round."""
    batch: int = 256
    """Sets the size of a batch B, in transitions."""
    buffer: int = 200_000
    """Sets the capacity of the experience replay buffer D, in transitions."""
    width: int = 128
    """Sets the width of the two hidden layers of actor and critic."""
    learner: Literal["lean", "torchrl"] = "lean"
    """Computes updates with hand-written gradients (lean) or TorchRL's DDPGLoss (torchrl); both
    give the same numbers."""
    optimizer: Literal["adam", "sgd"] = "adam"
    """Takes the gradient steps of Adam (adam) or the plain ones of Algorithm 1 (sgd)."""
    actor_delay: int = 300
    """Updates the critic alone for this many updates at the beginning."""
    gamma: float = 0.95
    """Sets the discount factor per slot."""
    alpha_actor: float = 1e-3
    """Sets alpha^(theta), the learning rate of the actor at the start."""
    alpha_critic: float = 1e-3
    """Sets alpha^(w), the learning rate of the critic at the start."""
    alpha_target: float = 0.01
    """Sets the learning rate of the target networks."""
    final_rate: float = 0.1
    """Sets the share of both learning rates that is left at the end; they fall linearly."""
    average_rate: float = 0.002
    """Sets the rate of the Polyak average of the actors, evaluated beside the actor; 0 for none."""
    flown: Literal["best", "last"] = "best"
    """Flies the best evaluated policy (best), or the last one as Algorithm 1 does (last)."""
    noise_min: float = 0.05
    """Sets the Gaussian action noise of the calmest simulation (standard deviation over a_max)."""
    noise_max: float = 0.3
    """Sets the action noise of the noisiest simulation; the others lie evenly between."""
    demonstrations: int = 10_000
    """Starts the buffer with this many transitions of the guidance law plus noise; 0 for none."""
    guided_share: float = 0.25
    """Lets the guidance law fly this share of the simulations at first; 0 for none."""
    guided_until: float = 0.6
    """Lets the policy fly all simulations after this share of the updates."""
    eval_every: int = 500
    """Evaluates the policy, without noise, every this many updates."""
    eval_episodes: int = 32
    """Sets the number of evaluation starts: the segment's own point, others random in its ball."""
    threads: int = 1
    """Sets the number of MuJoCo's threads, on which the results do not depend."""
    observation: str = "path"
    """Selects the observation: guided, path (guided in the frame of the path), robust (path, and
    what is known of disturbances, moving boxes and bounds), fleet (path, and the nearest other
    UAVs), or paper."""
    reward: str = "lost"
    """Selects the reward: lost (time lost), time (flown), careful (crashes cost more) or paper."""
    shield: bool = True
    """Bends commands that leave no way to stop without touching anything; without the shield, a
    crash ends an episode."""

    def __post_init__(self) -> None:
        """Checks what would fail late.

        Raises:
            ValueError: a setting is out of range; the message names field, value and fix.
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
        self.rules  # noqa: B018  (raises ValueError for unknown names)

    @property
    def rules(self) -> Rules:
        """Returns the rules of the episodes that are learned and flown."""
        return Rules(self.observation, self.reward, self.gamma, self.shield)
