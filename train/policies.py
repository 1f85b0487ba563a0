"""Trained policies: saved to and loaded from policy.pt."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from train.ddpg import make_actor
from train.plain_actor import PlainActor


@dataclass(frozen=True)
class TrainedPolicy:
    """An actor that acts without noise.

    A single decision is made in plain NumPy, with the weights as they are at the first one: where
    the actor goes on learning, make a new policy.

    Attributes:
        actor: TorchRL module, observation -> action. observation: name of the observation.
    """

    actor: TensorDictSequential
    observation: str

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (N, 3) for observations (N, D) float32."""
        if len(observation) == 1:
            return self.plain(observation[0])[None]
        device = next(self.actor.parameters()).device
        step = TensorDict({"observation": torch.from_numpy(observation)}, len(observation))
        with torch.no_grad():
            return np.asarray(self.actor(step.to(device))["action"].cpu().numpy())

    @cached_property
    def plain(self) -> PlainActor:
        """The actor for single observations."""
        return PlainActor(self.actor)

    def save(self, path: Path) -> None:
        """Write policy.pt: plain tensors and names, loaded without unpickling objects."""
        # Through memory: on a full disk torch.save itself raises no OSError.
        buffer = io.BytesIO()
        torch.save({"actor": self.actor.state_dict(), "observation": self.observation}, buffer)
        path.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainedPolicy:
        """Read policy.pt."""
        saved = torch.load(path, weights_only=True, map_location="cpu")
        first = next(value for name, value in saved["actor"].items() if name.endswith("0.weight"))
        scale = [value for name, value in saved["actor"].items() if name.endswith("scale")]
        residual = float(scale[0]) if scale else 0.0
        actor = make_actor(first.shape[1], first.shape[0], residual)
        actor.load_state_dict(saved["actor"])
        return cls(actor, saved["observation"])
