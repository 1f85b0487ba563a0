"""Defines trained policies: a TorchRL actor, a NumPy one for single decisions, and their files."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.modules import TanhModule

from mjcollect.envs.observation import OBSERVATIONS
from mjcollect.learning.ddpg import make_actor
from mjcollect.scene.assets import asset_path

SHIPPED = Path("shipped")  # This stands for the package's own policy, wherever it is installed,
DISTURBED = Path("disturbed")  # and this for its policy for disturbed air.
OWN = {SHIPPED: "generalist.safetensors", DISTURBED: "disturbed.safetensors"}
NO_POLICY = Path("none")  # This stands for learning from nothing.
SUMS = "SHA256SUMS"  # A file of this name beside a policy has its digest, as sha256sum writes it.
# Reading a file that is no policy ends in one of these.
_UNREADABLE = (
    OSError, EOFError, RuntimeError, ValueError, LookupError, AttributeError, TypeError,
    StopIteration, ArithmeticError, NotImplementedError, struct.error, zlib.error,
    pickle.UnpicklingError, safetensors.SafetensorError, zipfile.BadZipFile,
)  # fmt: skip


class PolicyError(ValueError):
    """Says that a file is no policy, or is damaged; the message names the file."""


@dataclass(frozen=True)
class TrainedPolicy:
    """Flies by an actor without noise.

    Single decisions are computed in NumPy, with the weights as they are at the first one: where the
    actor goes on learning, make a new policy.

    Attributes:
        actor: TorchRL module from observation to action.
        observation: name of the observation.
    """

    actor: TensorDictSequential
    observation: str

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions (N, 3) in units of a_max for observations (N, D) float32."""
        if len(observation) == 1:
            return self.plain(observation[0])[None]
        device = next(self.actor.parameters()).device
        step = TensorDict({"observation": torch.from_numpy(observation)}, len(observation))
        with torch.no_grad():
            return np.asarray(self.actor(step.to(device))["action"].cpu().numpy())

    @cached_property
    def plain(self) -> PlainActor:
        """Returns the actor for single observations."""
        return PlainActor(self.actor)

    @property
    def inputs(self) -> int:
        """Returns the size D of an observation."""
        return next(self.actor.parameters()).shape[1]

    @property
    def width(self) -> int:
        """Returns the width of the hidden layers."""
        return len(next(self.actor.parameters()))

    def widened(self, size: int) -> dict[str, torch.Tensor]:
        """Returns weights for an observation of `size` numbers, of which it knows the first ones.

        What it does not know has no influence at first.

        Raises:
            ValueError: the observation has fewer numbers than the policy takes.
        """
        if self.inputs > size:
            raise ValueError(f"policy: takes {self.inputs} numbers; the observation has {size}")
        weights = self.actor.state_dict()
        name = next(iter(weights))  # the first layer's weights
        unknown = torch.zeros(self.width, size - self.inputs)
        return {**weights, name: torch.cat([weights[name], unknown], dim=1)}

    def save(self, path: Path) -> None:
        """Writes a .pt file, or a .safetensors file, which is loaded without unpickling.

        Raises:
            OSError: the file cannot be written.
        """
        weights = {
            name: value.cpu().contiguous() for name, value in self.actor.state_dict().items()
        }
        if path.suffix == ".safetensors":
            digest = _digest(weights, self.observation)
            about = json.dumps({"observation": self.observation, "sha256": digest})
            path.write_bytes(safetensors.torch.save(weights, {"policy": about}))
            return
        # This goes through memory because torch.save raises no OSError on a full disk.
        buffer = io.BytesIO()
        content = {"actor": weights, "observation": self.observation}
        torch.save(content, buffer)
        path.write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainedPolicy:
        """Reads a file that `save` wrote; nothing in it is run.

        A damaged file is refused: .pt files have the checksums of a zip archive, .safetensors
        files a digest, except old ones, for which `SHA256SUMS` beside them can vouch.

        Raises:
            PolicyError: the file is no policy, or is damaged.
        """
        try:
            content = path.read_bytes()
            _check_sums(path, content)
            read = _read_safetensors if path.suffix == ".safetensors" else _read_pt
            weights, observation = read(content)
            first = next(value for name, value in weights.items() if name.endswith("0.weight"))
            if observation not in OBSERVATIONS:
                raise ValueError(f"observation: {observation}: unknown")
            actor = make_actor(first.shape[1], first.shape[0])
            actor.load_state_dict(weights)
        except _UNREADABLE as error:
            why = " ".join(str(error).split())[:200] or type(error).__name__
            raise PolicyError(f"{path}: holds no policy, or is damaged ({why})") from error
        return cls(actor, observation)


def _check_sums(path: Path, content: bytes) -> None:
    """Raises a ValueError if `SHA256SUMS` beside a file gives it another digest."""
    sums = path.with_name(SUMS)
    if sums.is_file():
        lines = sums.read_text(encoding="utf-8").splitlines()
        given = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
        if path.name in given and hashlib.sha256(content).hexdigest() != given[path.name]:
            raise ValueError(f"its digest is not that in {sums}")


def _read_safetensors(content: bytes) -> tuple[dict[str, torch.Tensor], str]:
    """Returns weights and observation of a .safetensors file."""
    weights = safetensors.torch.load(content)
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    about = json.loads(header["__metadata__"]["policy"])
    if "sha256" in about and about["sha256"] != _digest(weights, about["observation"]):
        raise ValueError("its content does not have the digest that it names")
    return weights, about["observation"]


def _read_pt(content: bytes) -> tuple[dict[str, torch.Tensor], str]:
    """Returns weights and observation of a .pt file; torch itself checks no checksum."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if damaged := archive.testzip():
            raise ValueError(f"{damaged} in it has another checksum")
    saved = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    return saved["actor"], saved["observation"]


def _digest(weights: Mapping[str, torch.Tensor], observation: str) -> str:
    """Returns a digest of weights with their names, types and shapes, and of an observation."""
    whole = hashlib.sha256(observation.encode())
    for name, value in sorted(weights.items()):
        whole.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        whole.update(value.contiguous().numpy().tobytes())
    return whole.hexdigest()


def weights_file(path: Path) -> Path:
    """Returns the file of a policy: one of the package's own for a name in `OWN`, else `path`."""
    return asset_path("policies", OWN[path]) if path in OWN else path


def policy_digest(path: Path) -> str:
    """Returns a hash of a policy's file, or of one in `OWN`, that does not depend on its path."""
    return hashlib.sha256(weights_file(path).read_bytes()).hexdigest()[:16]


Float32 = NDArray[np.float32]


@dataclass
class _Hidden:
    """Computes ReLU(LayerNorm(weight x + bias)), or the same without the norm."""

    weight: Float32  # (width, inputs)
    bias: Float32
    norm: tuple[Float32, Float32, np.float32] | None = None  # scale, shift, epsilon

    def __call__(self, x: Float32) -> Float32:
        x = self.weight @ x
        x += self.bias
        if self.norm is not None:  # The mean is zero since `normalise`.
            scale, shift, epsilon = self.norm
            x *= 1.0 / np.sqrt(x.dot(x) / np.float32(len(x)) + epsilon)
            x *= scale
            x += shift
        return np.maximum(x, 0.0, out=x)

    def normalise(self, norm: nn.LayerNorm) -> None:
        """Adds the norm; subtracts its mean from weight and bias once, not in every call."""
        self.norm = _array(norm.weight), _array(norm.bias), np.float32(norm.eps)
        self.weight = np.ascontiguousarray(self.weight - self.weight.mean(axis=0))
        self.bias = self.bias - self.bias.mean()


class PlainActor:
    """Computes in NumPy what an actor of `ddpg.make_actor` did when this was built."""

    def __init__(self, actor: nn.Module) -> None:
        """Copies the weights of linear layers, each with LayerNorm and ReLU, and a last tanh.

        Raises:
            ValueError: the actor has other parts.
        """
        layers: list[_Hidden] = []
        parts = [part for part in actor.modules() if not any(True for _ in part.children())]
        for part in parts:
            if isinstance(part, nn.Linear):
                layers.append(_Hidden(_array(part.weight), _array(part.bias)))
            elif isinstance(part, nn.LayerNorm) and layers:
                layers[-1].normalise(part)
            elif not isinstance(part, nn.ReLU | TanhModule):
                raise ValueError(f"actor: {type(part).__name__}: has no plain form here")
        if not layers or layers[-1].norm is not None or not isinstance(parts[-1], TanhModule):
            raise ValueError("actor: must end with a linear layer and tanh")
        self._hidden, self._last = layers[:-1], layers[-1]

    def __call__(self, observation: Float32) -> Float32:
        """Returns the action (3,) in units of a_max for an observation (D,), both float32."""
        x = observation
        for layer in self._hidden:
            x = layer(x)
        return np.asarray(np.tanh(self._last.weight @ x + self._last.bias))


def _array(parameter: torch.Tensor) -> Float32:
    return np.array(parameter.detach().cpu().numpy(), dtype=np.float32)
