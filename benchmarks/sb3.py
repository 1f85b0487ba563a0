"""Stable-Baselines3's side of the benchmarks: our networks in its DDPG.

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

from mjcollect.learning.networks import shrink_last
from train.support.run_folder import versions


class LayerNormPolicy(TD3Policy):
    """DDPG's policy with the networks of `make_actor`, `make_critic`: Linear, LayerNorm, ReLU."""

    def make_actor(self, features_extractor: Any = None) -> Actor:
        actor = super().make_actor(features_extractor)
        actor.mu = nn.Sequential(*self._layers(actor.features_dim, 3, squash_output=True))
        shrink_last(actor.mu)
        return actor.to(self.device)

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)
        inputs = self.actor.features_dim + 3
        critic.qf0 = nn.Sequential(*self._layers(inputs, 1))
        shrink_last(critic.qf0)
        critic.q_networks = [critic.qf0]
        return critic.to(self.device)

    def _layers(self, inputs: int, outputs: int, **kwargs: bool) -> list[nn.Module]:
        norms = [nn.LayerNorm]
        return create_mlp(inputs, outputs, self.net_arch, post_linear_modules=norms, **kwargs)


class Spaces(gymnasium.Env):
    """An environment that only tells its spaces, for a learner that is fed by hand."""

    def __init__(self, observation_size: int) -> None:
        high = np.full(observation_size, np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)


def make_sb3(env: gymnasium.Env, width: int, *, fused: bool = False, **settings: Any) -> DDPG:
    """SB3's DDPG with our networks; `fused`: with torch's fused Adam in place of its default."""
    model = DDPG(
        LayerNormPolicy,
        env,
        policy_kwargs={
            "net_arch": [width, width],
            "optimizer_kwargs": {"fused": True} if fused else {},
        },
        device="cpu",
        **settings,
    )
    model.set_logger(Logger(None, []))
    return model


def peer_versions() -> dict[str, str]:
    """Versions of what a result depends on, SB3 and Gymnasium with the rest."""
    peers = ("stable-baselines3", "gymnasium")
    return versions() | {name: importlib.metadata.version(name) for name in peers}
