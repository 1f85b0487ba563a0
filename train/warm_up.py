"""Compiles everything that numba compiles, so that neither flight nor learning has to wait for it.

    python -m train.warm_up

See `mjcollect.warm_up`.
"""

from __future__ import annotations

import torch

from mjcollect import warm_up
from train.norm_relu import norm_relu_backward


def main() -> None:
    """Fly a small scene, and one backward pass."""
    warm_up.main()
    d, h, z = (torch.ones(2, 4) for _ in range(3))
    mean, rstd, scale = torch.zeros(2, 1), torch.ones(2, 1), torch.ones(4)
    out = torch.empty(4), torch.empty(4), torch.empty(4)
    norm_relu_backward(d, h, z, mean, rstd, scale, 2, out)


if __name__ == "__main__":
    main()
