"""Implements DDPG, Algorithm 1 of the paper, with TorchRL's parts: read it from top to bottom.

Names follow the paper: learning rates alpha_critic (alpha^(w)) and alpha_actor (alpha^(theta)),
discount gamma, alpha_target, experience replay buffer D, U_1 environment operations, then U_2
updates. `algorithm_1` is the loop alone; `trainer.Trainer` is the same loop with demonstrations,
evaluation, checkpoints and an early stop, and `fast_ddpg` makes the same update in less time.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import MLP, TanhModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from mjcollect.learning.lessons import Lessons

# A transition {S, A, R, S', D'} is stored under these keys.
KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def make_actor(observation_size: int, width: int) -> TensorDictSequential:
    """Returns the policy pi(S; theta), from observations (..., D) to actions (..., 3) in [-1, 1].

    Actions are in units of a_max.
    """
    net = TensorDictModule(
        _network(observation_size, 3, width), in_keys=["observation"], out_keys=["param"]
    )
    return TensorDictSequential(net, TanhModule(in_keys=["param"], out_keys=["action"]))


def make_critic(observation_size: int, width: int) -> ValueOperator:
    """Returns the value q(S, A; w), from observations (..., D) and actions (..., 3) to (..., 1)."""
    net = _network(observation_size + 3, 1, width)
    return ValueOperator(net, in_keys=["observation", "action"])


def _network(inputs: int, outputs: int, width: int) -> MLP:
    net = MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=[width, width],
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm,
        norm_kwargs=[{"normalized_shape": width}] * 2,
    )
    shrink_last(net)
    return net


def shrink_last(net: nn.Sequential) -> None:
    """Shrinks the last layer: actions and values start near zero (Lillicrap et al., sec. 7)."""
    last = [layer for layer in net if isinstance(layer, nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()


def make_buffer(capacity: int, batch: int, seed: int) -> TensorDictReplayBuffer:
    """Returns an experience replay buffer D, sampled uniformly by a random stream of its own.

    Args:
        capacity: most transitions that it holds. batch: transitions in a sample.
    """
    generator = torch.Generator().manual_seed(seed)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity), batch_size=batch, generator=generator
    )


def sample(buffer: TensorDictReplayBuffer, count: int) -> TensorDict:
    """Returns `count` batches (count * batch,) at once, the same that `count` calls would draw."""
    # This avoids buffer.sample(n), which warns of any size but the buffer's own.
    index, _ = buffer.sampler.sample(buffer.storage, count * buffer.batch_size)
    return buffer.storage.get(index)


def transitions(step: TensorDictBase) -> TensorDict:
    """Returns the part of environment steps that is stored, flat over the batch."""
    return step.select(*KEYS).reshape(-1)


def perturbed(
    action: torch.Tensor, noise: float | torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    """Returns actions (N, 3) with Gaussian noise of a standard deviation or several, in [-1, 1]."""
    return (action + torch.randn(action.shape, generator=generator) * noise).clamp(-1.0, 1.0)


def make_optimizer(kind: str, parameters: Any) -> torch.optim.Optimizer:
    """Returns Adam, or for `sgd` the plain gradient steps of Algorithm 1.

    The rate is set at every update. The critic's loss is the mean square error, whose gradient is
    twice that in Algorithm 1.
    """
    optimizer = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[kind]
    return optimizer(parameters, lr=1e-3, fused=True)


class BaseLearner:
    """Holds networks, learning rates and the U_2 loop; subclasses compute the update.

    Attributes:
        actor, critic: the networks. averaged: Polyak average of the actors, for evaluation.
        gamma, alpha_target, average_rate: as given. kind: of the optimiser.
        updates: number of updates made so far. lessons: those of a teacher, if there is one.
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
        """Builds everything on `device`; `LearnConfig` explains the settings.

        Args:
            observation_size: D. total_updates: updates after which the learning rates have fallen
                to their `final_rate`. weights: state of an actor of this size to start from.
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
        self.lessons: Lessons | None = None

    @property
    def rates(self) -> tuple[float, float]:
        """Returns the learning rates of critic and actor at the next update."""
        share = min(self.updates / max(self._total, 1), 1.0)
        factor = 1.0 + (self._final_rate - 1.0) * share
        return self._rates[0] * factor, self._rates[1] * factor * (self.updates >= self._delay)

    def update(
        self, batch: TensorDictBase, lesson: Sequence[torch.Tensor] = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Updates critic, actor and targets on a batch; returns the critic's and actor's loss.

        A lesson of a teacher, if there is one, is observations (n, D) and its actions (n, 3).
        """
        raise NotImplementedError

    def learn(self, buffer: TensorDictReplayBuffer, count: int) -> torch.Tensor:
        """Makes `count` updates; returns the losses (count, 2) of critic and actor.

        The batches are those that `count` calls of `buffer.sample()` would draw.
        """
        batch = sample(buffer, count).to(self.device)
        parts = batch.split(len(batch) // count)
        lessons = [()] * count if self.lessons is None else self.lessons.batches(count)
        losses = [self.update(*pair) for pair in zip(parts, lessons, strict=True)]
        return torch.stack([torch.stack(pair) for pair in losses])

    def state_dict(self) -> dict[str, Any]:
        """Returns copies of networks, targets, average, optimisers and the number of updates."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state that `state_dict` returned."""
        raise NotImplementedError


class Learner(BaseLearner):
    """Computes the update from TorchRL's parts: DDPGLoss, SoftUpdate, autograd."""

    def __init__(self, observation_size: int, **settings: Any) -> None:
        """Takes the keyword arguments of `BaseLearner`."""
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

    def update(
        self, batch: TensorDictBase, lesson: Sequence[torch.Tensor] = ()
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Makes the update that `BaseLearner.update` describes."""
        losses = self.loss(batch)
        optimizers = (self.critic_optimizer, self.actor_optimizer)
        for optimizer, rate in zip(optimizers, self.rates, strict=True):
            optimizer.param_groups[0]["lr"] = rate
            optimizer.zero_grad(set_to_none=True)
        # Both gradients come before either step: the actor's goes back through the critic, and
        # autograd does not notice that a step changed the critic's weights under the detached copy.
        losses["loss_value"].backward()
        losses["loss_actor"].backward()
        if self.lessons is not None:  # This adds to the actor's gradient.
            miss = self.actor(observation=lesson[0])[-1] - lesson[1]
            (self.lessons.weight * miss.square().sum(dim=1).mean()).backward()
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
        """Returns copies of networks, targets, average, optimisers and the number of updates."""
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
        """Goes back to a state that `state_dict` returned."""
        self.loss.load_state_dict(state["networks"])
        self.averaged.load_state_dict(state["averaged"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.updates = state["updates"]


def algorithm_1(
    env: EnvBase,
    learner: BaseLearner,
    buffer: TensorDictReplayBuffer,
    *,
    updates: int,
    u1: int,
    u2: int,
    noise: float,
    generator: torch.Generator,
) -> None:
    """Runs Algorithm 1 of the paper, and nothing else.

    Args:
        env: N simulations. updates: number of updates in all.
        u1: U_1, environment operations in a round. u2: U_2, updates in a round.
        noise: standard deviation of the Gaussian perturbation of each action, as a share of a_max.
        generator: source of this noise.
    """
    now = env.reset()
    while len(buffer) < (buffer.batch_size or 1):
        now = _operate(env, learner, buffer, now, noise, generator)
    while learner.updates < updates:
        for _ in range(u1):
            now = _operate(env, learner, buffer, now, noise, generator)
        learner.learn(buffer, u2)


@torch.no_grad()
def _operate(
    env: EnvBase, learner: BaseLearner, buffer: TensorDictReplayBuffer, now: TensorDictBase,
    noise: float, generator: torch.Generator,
) -> TensorDictBase:  # fmt: skip
    """Flies A = pi(S; theta) + noise for a slot, puts {S, A, R, S', D'} into D, returns S'."""
    step = learner.actor(now)
    step["action"] = perturbed(step["action"], noise, generator)
    step, after = env.step_and_maybe_reset(step)
    buffer.extend(transitions(step))
    return after
