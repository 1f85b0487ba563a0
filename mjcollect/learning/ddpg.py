"""DDPG, Algorithm 1 of the paper, from TorchRL's parts: networks, loss, targets, replay buffer.

Names follow the paper: learning rates alpha_critic (alpha^(w)) and alpha_actor (alpha^(theta)),
discount gamma, alpha_target, U_1 environment operations, then U_2 updates.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from mjcollect.learning.networks import make_actor, make_critic
from mjcollect.learning.replay import sample


def make_optimizer(kind: str, parameters: Any) -> torch.optim.Optimizer:
    """Adam, or for `sgd` the plain gradient steps of Algorithm 1; the rate is set at every update.

    The critic's loss is the mean square error: its gradient is twice that in Algorithm 1.
    """
    made = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[kind]
    return made(parameters, lr=1e-3, fused=True)


class BaseLearner:
    """Networks, learning rates and the U_2 loop; how one update is made is the subclass's matter.

    Attributes:
        actor, critic: the networks. averaged: Polyak average of the actors, to evaluate.
        gamma, alpha_target, average_rate: as given. kind: of the optimiser. updates: made so far.
    """

    def __init__(
        self,
        observation_size: int,
        *,
        width: int,
        gamma: float,
        alpha_actor: float,
        alpha_critic: float,
        alpha_target: float,
        final_rate: float,
        total_updates: int,
        average_rate: float = 0.002,
        optimizer: str = "adam",
        actor_delay: int = 0,
        device: str = "cpu",
        weights: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        """Build everything on `device`; learning rates fall linearly to `final_rate` of theirs.

        Args:
            weights: state of an actor of this size to start from.
        """
        self.device = device
        self.kind = optimizer
        self._delay = actor_delay
        self.actor = make_actor(observation_size, width).to(device)
        if weights is not None:
            self.actor.load_state_dict(weights)
        self.critic = make_critic(observation_size, width).to(device)
        self.averaged = copy.deepcopy(self.actor).requires_grad_(False)
        self.gamma, self.alpha_target, self.average_rate = gamma, alpha_target, average_rate
        self._rates = (alpha_critic, alpha_actor)
        self._final_rate, self._total = final_rate, total_updates
        self.updates = 0

    @property
    def rates(self) -> tuple[float, float]:
        """Learning rates of critic and actor at the next update."""
        share = min(self.updates / max(self._total, 1), 1.0)
        factor = 1.0 + (self._final_rate - 1.0) * share
        return self._rates[0] * factor, self._rates[1] * factor * (self.updates >= self._delay)

    def update(self, batch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """One critic, actor and target update on a batch of transitions; the two losses."""
        raise NotImplementedError

    def learn(self, buffer: TensorDictReplayBuffer, count: int) -> torch.Tensor:
        """`count` updates on batches drawn in one call: losses (count, 2), critic's and actor's.

        The batches are those that `count` calls of `buffer.sample()` would draw.
        """
        batch = sample(buffer, count).to(self.device)
        losses = [self.update(part) for part in batch.split(len(batch) // count)]
        return torch.stack([torch.stack(pair) for pair in losses])

    def state_dict(self) -> dict[str, Any]:
        """Networks, targets, average, optimisers and the number of updates, as copies."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state of `state_dict`."""
        raise NotImplementedError


class Learner(BaseLearner):
    """The update from TorchRL's parts: DDPGLoss, SoftUpdate, autograd."""

    def __init__(self, observation_size: int, **settings: Any) -> None:
        """Take the keywords of `BaseLearner`."""
        super().__init__(observation_size, **settings)
        self.loss = DDPGLoss(self.actor, self.critic, delay_actor=True, delay_value=True)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=self.gamma)
        self.targets = SoftUpdate(self.loss, tau=self.alpha_target)
        self.actor_optimizer = make_optimizer(
            self.kind, self.loss.actor_network_params.flatten_keys().values()
        )
        self.critic_optimizer = make_optimizer(
            self.kind, self.loss.value_network_params.flatten_keys().values()
        )

    def update(self, batch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """One critic, actor and target update on a batch of transitions; the two losses."""
        losses = self.loss(batch)
        optimizers = (self.critic_optimizer, self.actor_optimizer)
        for optimizer, rate in zip(optimizers, self.rates, strict=True):
            optimizer.param_groups[0]["lr"] = rate
            optimizer.zero_grad(set_to_none=True)
        # Both gradients before either step: the actor's goes back through the critic, and autograd
        # does not notice that a step has changed the critic's weights under the detached copy.
        losses["loss_value"].backward()
        losses["loss_actor"].backward()
        for optimizer in optimizers:
            optimizer.step()
        self.targets.step()
        with torch.no_grad():
            pairs = zip(self.averaged.parameters(), self.actor.parameters(), strict=True)
            for average, parameter in pairs:
                average.lerp_(parameter, self.average_rate)
        self.updates += 1
        return losses["loss_value"].detach(), losses["loss_actor"].detach()

    def state_dict(self) -> dict[str, Any]:
        """Networks, targets, average, optimisers and the number of updates, as copies."""
        return copy.deepcopy(
            {
                "networks": self.loss.state_dict(),
                "averaged": self.averaged.state_dict(),
                "critic_optimizer": self.critic_optimizer.state_dict(),
                "actor_optimizer": self.actor_optimizer.state_dict(),
                "updates": self.updates,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state of `state_dict`."""
        self.loss.load_state_dict(state["networks"])
        self.averaged.load_state_dict(state["averaged"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.updates = state["updates"]
