"""Actor and critic, TorchRL modules."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, TanhModule, ValueOperator


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
    shrink_last(net)
    made = TensorDictModule(net, in_keys=["observation"], out_keys=["param"])
    return TensorDictSequential(made, TanhModule(in_keys=["param"], out_keys=["action"]))


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
    shrink_last(net)
    return ValueOperator(net, in_keys=["observation", "action"])


def shrink_last(net: nn.Sequential, share: float = 0.1) -> None:
    """Small last layer, so that actions and values start near zero (Lillicrap et al., sec. 7)."""
    last = [layer for layer in net if isinstance(layer, nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(share)
        last.bias.zero_()
