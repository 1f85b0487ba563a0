"""Trained policies: saved to and loaded from policy.pt."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import safetensors.torch
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
        """Write policy.pt, or policy.safetensors: tensors and names, loaded without unpickling."""
        weights = {
            name: value.cpu().contiguous() for name, value in self.actor.state_dict().items()
        }
        if path.suffix == ".safetensors":
            path.write_bytes(safetensors.torch.save(weights, {"observation": self.observation}))
            return
        # Through memory: on a full disk torch.save itself raises no OSError.
        buffer = io.BytesIO()
        torch.save({"actor": weights, "observation": self.observation}, buffer)
        path.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainedPolicy:
        """Read what `save` wrote."""
        if path.suffix == ".safetensors":
            with safetensors.safe_open(path, "pt") as file:
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                observation = file.metadata()["observation"]
        else:
            saved = torch.load(path, weights_only=True, map_location="cpu")
            weights, observation = saved["actor"], saved["observation"]
        first = next(value for name, value in weights.items() if name.endswith("0.weight"))
        scale = [value for name, value in weights.items() if name.endswith("scale")]
        residual = float(scale[0]) if scale else 0.0
        actor = make_actor(first.shape[1], first.shape[0], residual)
        actor.load_state_dict(weights)
        return cls(actor, observation)
