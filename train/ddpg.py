"""DDPG, Algorithm 1 of the paper, from TorchRL's parts: networks, loss, targets, replay buffer.

Names follow the paper: learning rates alpha_critic (alpha^(w)) and alpha_actor (alpha^(theta)),
discount gamma, alpha_target, U_1 environment operations, then U_2 updates.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, TanhModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

# What a transition {S, A, R, S', D'} is stored as.
KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def make_actor(observation_size: int, width: int) -> TensorDictSequential:
    """Policy pi(S; theta): observation (..., D) -> action (..., 3) in [-1, 1], 1 = a_max."""
    net = MLP(
        in_features=observation_size,
        out_features=3,
        num_cells=[width, width],
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm,
        norm_kwargs=[{"normalized_shape": width}] * 2,
    )
    _shrink_last(net)
    return TensorDictSequential(
        TensorDictModule(net, in_keys=["observation"], out_keys=["param"]),
        TanhModule(in_keys=["param"], out_keys=["action"]),
    )


def make_critic(observation_size: int, width: int) -> ValueOperator:
    """Value q(S, A; w)."""
    net = MLP(
        in_features=observation_size + 3,
        out_features=1,
        num_cells=[width, width],
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm,
        norm_kwargs=[{"normalized_shape": width}] * 2,
    )
    _shrink_last(net)
    return ValueOperator(net, in_keys=["observation", "action"])


def _shrink_last(net: nn.Sequential) -> None:
    """Small last layer, so that actions and values start near zero (Lillicrap et al., sec. 7)."""
    last = [layer for layer in net if isinstance(layer, nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()


class Learner:
    """Networks, targets, optimisers and the U_2 loop."""

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
        device: str = "cpu",
    ) -> None:
        """Build everything on `device`; learning rates fall linearly to `final_rate` of theirs."""
        self.actor = make_actor(observation_size, width).to(device)
        self.critic = make_critic(observation_size, width).to(device)
        self.loss = DDPGLoss(self.actor, self.critic, delay_actor=True, delay_value=True)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.targets = SoftUpdate(self.loss, tau=alpha_target)
        self.actor_optimizer = torch.optim.Adam(
            self.loss.actor_network_params.flatten_keys().values(), lr=alpha_actor, fused=True
        )
        self.critic_optimizer = torch.optim.Adam(
            self.loss.value_network_params.flatten_keys().values(), lr=alpha_critic, fused=True
        )
        self._rates = (alpha_actor, alpha_critic)
        self._final_rate, self._total = final_rate, total_updates
        self.updates = 0

    def update(self, batch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """One critic, actor and target update on a batch of transitions; the two losses."""
        share = min(self.updates / max(self._total, 1), 1.0)
        factor = 1.0 + (self._final_rate - 1.0) * share
        for optimizer, rate in zip(
            (self.actor_optimizer, self.critic_optimizer), self._rates, strict=True
        ):
            optimizer.param_groups[0]["lr"] = rate * factor
        losses = self.loss(batch)
        self.critic_optimizer.zero_grad(set_to_none=True)
        losses["loss_value"].backward()
        self.critic_optimizer.step()
        self.actor_optimizer.zero_grad(set_to_none=True)
        losses["loss_actor"].backward()
        self.actor_optimizer.step()
        self.targets.step()
        self.updates += 1
        return losses["loss_value"].detach(), losses["loss_actor"].detach()


def make_buffer(capacity: int, batch: int, seed: int) -> TensorDictReplayBuffer:
    """Experience replay buffer D of transitions, sampled uniformly by its own random stream."""
    generator = torch.Generator().manual_seed(seed)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity), batch_size=batch, generator=generator
    )


def transitions(step: TensorDictBase) -> TensorDict:
    """The stored part of environment steps, flat over the batch."""
    return step.select(*KEYS).reshape(-1)
