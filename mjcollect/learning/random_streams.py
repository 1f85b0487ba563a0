"""Derives named, independent random streams from one seed."""

from __future__ import annotations

import numpy as np


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """Returns the named random stream of a seed; streams of different names are independent."""
    return np.random.SeedSequence([seed, *name.encode()])


def torch_seed(seed: int, name: str) -> int:
    """Returns a seed for a torch generator from the named stream."""
    return int(stream(seed, name).generate_state(1, np.uint64)[0] >> 1)
