"""The actor's network in plain NumPy, for one decision of one UAV.

For a single observation TensorDict and torch cost some hundred microseconds around a few
microseconds of arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torchrl.modules import TanhModule

Float32 = NDArray[np.float32]


@dataclass
class _Hidden:
    """ReLU(LayerNorm(weight x + bias)), or without the norm."""

    weight: Float32  # (width, inputs)
    bias: Float32
    norm: tuple[Float32, Float32, np.float32] | None = None  # scale, shift, epsilon

    def __call__(self, x: Float32) -> Float32:
        x = self.weight @ x
        x += self.bias
        if self.norm is not None:  # the mean is zero: see `normalise`
            scale, shift, epsilon = self.norm
            x *= 1.0 / np.sqrt(x.dot(x) / np.float32(len(x)) + epsilon)
            x *= scale
            x += shift
        return np.maximum(x, 0.0, out=x)

    def normalise(self, norm: nn.LayerNorm) -> None:
        """Add the norm; its mean is taken off weight and bias once instead of in every call."""
        self.norm = _array(norm.weight), _array(norm.bias), np.float32(norm.eps)
        self.weight = np.ascontiguousarray(self.weight - self.weight.mean(axis=0))
        self.bias = self.bias - self.bias.mean()


class PlainActor:
    """What `ddpg.make_actor` made, as it was when this was built."""

    def __init__(self, actor: nn.Module) -> None:
        """Copy the weights of linear layers, each with LayerNorm and ReLU, and a last tanh.

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
        """Action (3,) for an observation (D,), both float32."""
        x = observation
        for layer in self._hidden:
            x = layer(x)
        return np.asarray(np.tanh(self._last.weight @ x + self._last.bias))


def _array(parameter: torch.Tensor) -> Float32:
    return np.array(parameter.detach().cpu().numpy(), dtype=np.float32)
