"""Computes the DDPG update of `ddpg.Learner` faster, with gradients written out by hand.

All parameters of a network lie in one flat vector, of which the layers are views, so Adam and the
soft update are one call each; the backward pass writes straight into a flat gradient. Losses and
gradients are those of TorchRL's DDPGLoss (tested). It works only for the networks of `make_actor`
and `make_critic`: hidden layers of Linear, LayerNorm, ReLU, then a Linear.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer

from mjcollect.learning.ddpg import BaseLearner, Learner, make_optimizer, sample
from mjcollect.learning.norm_relu import norm_relu_backward

EPS = 1e-5  # The default of nn.LayerNorm, which `make_actor` and `make_critic` use.


class Layers(NamedTuple):
    """Holds a network's layers, or their gradients, as views of one flat vector.

    Attributes:
        flat: (P,) all numbers, in the order of the module's parameters.
        hidden: the Linear's weight and bias and the LayerNorm's, for each hidden layer.
        weight, bias: those of the output layer.
    """

    flat: Tensor
    hidden: list[tuple[Tensor, ...]]
    weight: Tensor
    bias: Tensor

    @classmethod
    def of(cls, module: nn.Module, flat: Tensor) -> Layers:
        """Returns views of `flat` (P,) in the shapes of the module's parameters."""
        sizes = [p.numel() for p in module.parameters()]
        shapes = [p.shape for p in module.parameters()]
        parts = [part.view(s) for part, s in zip(flat.split(sizes), shapes, strict=True)]
        hidden = [tuple(parts[i : i + 4]) for i in range(0, len(parts) - 2, 4)]
        return cls(flat, hidden, *parts[-2:])

    @classmethod
    def take(cls, module: nn.Module) -> Layers:
        """Moves the module's parameters into one vector, of which they become views."""
        layers = cls.of(module, nn.utils.parameters_to_vector(module.parameters()).detach())
        views = [*(part for layer in layers.hidden for part in layer), layers.weight, layers.bias]
        for parameter, view in zip(module.parameters(), views, strict=True):
            parameter.data = view
        return layers


class Record(NamedTuple):
    """Holds what the backward pass needs of a hidden layer of width w.

    Attributes:
        x, h, z: (n, in) inputs, (n, w) outputs, (n, w) the LayerNorm's inputs.
        mean, rstd: (n, 1) mean and 1 / standard deviation of the rows of z.
    """

    x: Tensor
    h: Tensor
    z: Tensor
    mean: Tensor
    rstd: Tensor


def forward(net: Layers, x: Tensor) -> tuple[Tensor, list[Record]]:
    """Returns the outputs (n, out) for inputs (n, in), and the records of the hidden layers."""
    records = []
    for weight, bias, scale, shift in net.hidden:
        z = torch.addmm(bias, x, weight.t())
        y, mean, rstd = torch.native_layer_norm(z, scale.shape, scale, shift, EPS)
        h = y.relu_()
        records.append(Record(x, h, z, mean, rstd))
        x = h
    return torch.addmm(net.bias, x, net.weight.t()), records


def backward(net: Layers, grad: Layers, records: list[Record], d: Tensor, rows: int) -> Tensor:
    """Writes the gradient by the parameters; returns that by the first norm's inputs, (n, width).

    Args:
        net, records: those of `forward`. grad: what is written to.
        d: (n, out) gradient by the outputs.
        rows: number of leading rows that count for the parameters; all count for what is returned.
    """
    torch.mm(d[:rows].t(), records[-1].h[:rows], out=grad.weight)
    torch.sum(d[:rows], 0, out=grad.bias)
    d = d @ net.weight
    for i in reversed(range(len(records))):
        r, (weight, _, scale, _) = records[i], net.hidden[i]
        to_weight, to_bias, to_scale, to_shift = grad.hidden[i]
        out = (to_bias, to_scale, to_shift)
        d = norm_relu_backward(d, r.h, r.z, r.mean, r.rstd, scale, rows, out)
        torch.mm(d[:rows].t(), r.x[:rows], out=to_weight)
        if i > 0:
            d = d @ weight
    return d


class LeanLearner(BaseLearner):
    """Computes the update in plain torch, without autograd."""

    def __init__(self, observation_size: int, **settings: Any) -> None:
        """Takes the keyword arguments of `BaseLearner`."""
        super().__init__(observation_size, **settings)
        self.target_actor = copy.deepcopy(self.averaged)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self._actor, self._critic = Layers.take(self.actor), Layers.take(self.critic)
        self._target_actor = Layers.take(self.target_actor)
        self._target_critic = Layers.take(self.target_critic)
        self._average = Layers.take(self.averaged)
        groups = []
        self._gradients = []
        for module, layers in ((self.critic, self._critic), (self.actor, self._actor)):
            parameter = nn.Parameter(layers.flat)
            parameter.grad = torch.zeros_like(layers.flat)
            self._gradients.append(Layers.of(module, parameter.grad))
            groups.append({"params": [parameter]})
        self.optimizer = make_optimizer(self.kind, groups)

    def update(self, batch: TensorDictBase, lesson: Sequence[Tensor] = ()) -> tuple[Tensor, Tensor]:
        """Makes the update that `BaseLearner.update` describes."""
        return self._update(*self._columns(batch), *lesson)

    def learn(self, buffer: TensorDictReplayBuffer, count: int) -> Tensor:
        """Makes `count` updates; returns the losses (count, 2) of critic and actor."""
        columns = self._columns(sample(buffer, count).to(self.device))
        if self.lessons is not None:
            columns += self.lessons.sample(count)
        batches = zip(*(column.chunk(count) for column in columns), strict=True)
        return torch.stack([torch.stack(self._update(*batch)) for batch in batches])

    def _columns(self, batch: TensorDictBase) -> tuple[Tensor, ...]:
        """Returns S, A, R, S' and the discount of what follows, each (n, ...)."""
        after = batch["next"]
        gamma = self.gamma
        if "steps_to_next_obs" in batch:  # TorchRL's multi-step transforms write this.
            gamma = gamma ** batch["steps_to_next_obs"].view_as(after["reward"])
        discount = gamma * ~after["terminated"]
        return (
            batch["observation"],
            batch["action"],
            after["reward"],
            after["observation"],
            discount,
        )

    @torch.no_grad()
    def _update(self, *columns: Tensor) -> tuple[Tensor, Tensor]:
        losses = self._gradient(*columns)
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate
        self.optimizer.step()
        self._target_actor.flat.lerp_(self._actor.flat, self.alpha_target)
        self._target_critic.flat.lerp_(self._critic.flat, self.alpha_target)
        self._average.flat.lerp_(self._actor.flat, self.average_rate)
        self.updates += 1
        return losses

    def _gradient(
        self, s: Tensor, a: Tensor, r: Tensor, s_next: Tensor, discount: Tensor, *lesson: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Writes both gradients, at the same parameters; returns the two losses of DDPG."""
        n = len(s)
        a_next = forward(self._target_actor, s_next)[0].tanh_()
        q_next = forward(self._target_critic, torch.cat([s_next, a_next], 1))[0]
        u = torch.addcmul(r, discount, q_next)
        actions, actor_records = forward(self._actor, torch.cat([s, lesson[0]]) if lesson else s)
        action = actions.tanh_()[:n]
        # One critic pass gives both losses: q(S, A) in the first n rows, q(S, pi(S)) below.
        both = torch.cat([torch.cat([s, a], 1), torch.cat([s, action], 1)])
        q, critic_records = forward(self._critic, both)
        error = q[:n] - u
        d = torch.cat([error * (2 / n), torch.full_like(error, -1 / n)])
        d = backward(self._critic, self._gradients[0], critic_records, d, n)
        d_action = d[n:] @ self._critic.hidden[0][0][:, s.shape[1] :]
        if self.lessons is not None:
            miss = actions[n:] - lesson[1]
            d_action = torch.cat([d_action, miss * (2 * self.lessons.weight / len(miss))])
        d = d_action * (1 - actions * actions)  # The factor is the derivative of tanh.
        backward(self._actor, self._gradients[1], actor_records, d, len(d))
        return error.square().mean(), -q[n:].mean()

    def state_dict(self) -> dict[str, Any]:
        """Returns copies of networks, targets, average, optimiser and the number of updates."""
        vectors = {name: layers.flat.clone() for name, layers in self._vectors.items()}
        optimizer = copy.deepcopy(self.optimizer.state_dict())
        return {**vectors, "optimizer": optimizer, "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state that `state_dict` returned."""
        for name, layers in self._vectors.items():
            layers.flat.copy_(state[name])
        self.optimizer.load_state_dict(state["optimizer"])
        self.updates = state["updates"]

    @property
    def _vectors(self) -> dict[str, Layers]:
        return {
            "actor": self._actor,
            "critic": self._critic,
            "target_actor": self._target_actor,
            "target_critic": self._target_critic,
            "averaged": self._average,
        }


# `LearnConfig.learner` names one of these.
LEARNERS: dict[str, type[BaseLearner]] = {"lean": LeanLearner, "torchrl": Learner}
