"""The experience replay buffer D of Algorithm 1."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

# What a transition {S, A, R, S', D'} is stored as.
KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def make_buffer(capacity: int, batch: int, seed: int) -> TensorDictReplayBuffer:
    """Experience replay buffer D of transitions, sampled uniformly by its own random stream."""
    generator = torch.Generator().manual_seed(seed)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity), batch_size=batch, generator=generator
    )


def sample(buffer: TensorDictReplayBuffer, count: int) -> TensorDict:
    """`count` batches in one call, (count * batch,): the same that `count` calls would draw."""
    # Not buffer.sample(n), which warns of any size but the buffer's own.
    index, _ = buffer.sampler.sample(buffer.storage, count * buffer.batch_size)
    return buffer.storage.get(index)


def transitions(step: TensorDictBase) -> TensorDict:
    """The stored part of environment steps, flat over the batch."""
    return step.select(*KEYS).reshape(-1)
