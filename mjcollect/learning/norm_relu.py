"""Computes the backward pass of a hidden layer's LayerNorm and ReLU in one loop over the rows.

The loop is compiled for the CPU, where torch would make six passes over memory; other devices use
torch. The forward pass stays torch's own: where an activation lies within rounding of zero, another
order of summation would switch its ReLU, and gradients would no longer be DDPGLoss's to 1e-6.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mjcollect.geometry.compiled import compiled

Floats = NDArray[np.floating]
Out = tuple[Tensor, Tensor, Tensor]


def norm_relu_backward(
    d: Tensor, h: Tensor, z: Tensor, mean: Tensor, rstd: Tensor, scale: Tensor, rows: int, out: Out
) -> Tensor:
    """Returns the gradient by z (n, w) of h = ReLU(scale * (z - mean) * rstd + shift).

    Args:
        d: (n, w) gradient by h, which may be overwritten. h, z: (n, w). scale: (w,).
        mean, rstd: (n, 1) mean and 1 / standard deviation of the rows of z.
        rows: number of leading rows that count for `out`.
        out: three vectors (w,), to which the gradients by a bias added to z, by scale and by shift
            are written.
    """
    if d.device.type != "cpu":
        return torch_backward(d, h, z, mean, rstd, scale, rows, out)
    _backward(rows, *(tensor.numpy() for tensor in (d, h, z, mean, rstd, scale, *out)))
    return d


def torch_backward(
    d: Tensor, h: Tensor, z: Tensor, mean: Tensor, rstd: Tensor, scale: Tensor, rows: int, out: Out
) -> Tensor:
    """Computes `norm_relu_backward` in torch, with the same arguments."""
    to_bias, to_scale, to_shift = out
    d = d * (h > 0)
    normed = (z - mean) * rstd
    torch.sum(d[:rows], 0, out=to_shift)
    torch.sum(d[:rows] * normed[:rows], 0, out=to_scale)
    d = d * scale
    along = (d * normed).mean(1, keepdim=True)
    d = (d - d.mean(1, keepdim=True) - normed * along) * rstd
    torch.sum(d[:rows], 0, out=to_bias)
    return d


# Sums over a row may be regrouped, because else they cannot use vector instructions. The regrouping
# is fixed at compile time, so the same machine gives the same bits.
@functools.partial(compiled, fastmath={"reassoc", "contract", "nsz"})
def _backward(
    rows: int,
    d: Floats,
    h: Floats,
    z: Floats,
    mean: Floats,
    rstd: Floats,
    scale: Floats,
    to_bias: Floats,
    to_scale: Floats,
    to_shift: Floats,
) -> None:
    zero = d.dtype.type(0)  # A plain 0.0 would turn every sum into a double.
    n, width = d.shape
    to_bias[:], to_scale[:], to_shift[:] = zero, zero, zero
    for i in range(n):
        m, r = mean[i, 0], rstd[i, 0]
        total, along = zero, zero
        for j in range(width):
            if h[i, j] <= zero:
                d[i, j] = zero
            total += d[i, j] * scale[j]
            along += d[i, j] * scale[j] * (z[i, j] - m)
        total /= d.dtype.type(width)
        along *= r * r / d.dtype.type(width)
        for j in range(width):
            after, off = d[i, j], z[i, j] - m
            d[i, j] = (after * scale[j] - total - off * along) * r
            if i < rows:
                to_bias[j] += d[i, j]
                to_scale[j] += after * off * r
                to_shift[j] += after
