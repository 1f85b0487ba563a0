"""Puts our networks into Stable-Baselines3's DDPG, the rival in two benchmarks.

Needs the optional dependencies: `pip install .[bench]`.
"""

from __future__ import annotations

import importlib.metadata
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import shrink_last


class LayerNormPolicy(TD3Policy):
    """Has the networks of our `make_actor` and `make_critic`: Linear, LayerNorm, ReLU."""

    def make_actor(self, features_extractor: Any = None) -> Actor:
        actor = super().make_actor(features_extractor)
        actor.mu = self._network(actor.features_dim, 3, squash_output=True)
        return actor.to(self.device)

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)
        critic.qf0 = self._network(self.actor.features_dim + 3, 1)
        critic.q_networks = [critic.qf0]
        return critic.to(self.device)

    def _network(self, inputs: int, outputs: int, **kwargs: bool) -> nn.Sequential:
        norms = [nn.LayerNorm]
        layers = create_mlp(inputs, outputs, self.net_arch, post_linear_modules=norms, **kwargs)
        network = nn.Sequential(*layers)
        shrink_last(network)
        return network


class Spaces(gymnasium.Env):
    """Is an environment that only tells its spaces, for a learner that is fed by hand."""

    def __init__(self, observation_size: int) -> None:
        high = np.full(observation_size, np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)


class FlightGym(Spaces):
    """Puts the single dm-control environment behind Gymnasium, with a flat observation (D,)."""

    def __init__(self, course: Course, config: LearnConfig, seed: int) -> None:
        self.environment = make_environment(
            course,
            observation=config.observation,
            reward=config.reward,
            start="spread",
            random=seed,
            shield=config.shield,
        )
        super().__init__(len(self.reset()[0]))

    @staticmethod
    def _flat(parts: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate(list(parts.values())).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        return self._flat(self.environment.reset().observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        now = self.environment.step(action)
        ended = now.discount == 0.0
        truncated = now.last() and not ended
        return self._flat(now.observation), float(now.reward), ended, truncated, {}

    def guidance_action(self) -> np.ndarray:
        """Returns the action (3,) of the guidance law."""
        return self.environment.task.episodes.guidance_action()[0]


def make_sb3(env: gymnasium.Env, width: int, *, fused: bool = False, **settings: Any) -> DDPG:
    """Returns SB3's DDPG with our networks; if `fused`, with torch's fused Adam."""
    policy = {"net_arch": [width, width], "optimizer_kwargs": {"fused": True} if fused else {}}
    model = DDPG(LayerNormPolicy, env, policy_kwargs=policy, device="cpu", **settings)
    model.set_logger(Logger(None, []))
    return model


def peer_versions() -> dict[str, str]:
    """Returns the versions of SB3 and Gymnasium."""
    return {name: importlib.metadata.version(name) for name in ("stable-baselines3", "gymnasium")}
