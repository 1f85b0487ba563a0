"""Estimates what disturbs a flight from the slots flown so far, vectorised over N simulations.

The drift, a slot's acceleration minus its command, is explained as a share of the command, the
`gain`, and a steady `push`. Least squares over the episode's slots fit both; recent slots count
more. What was observed so far is an array of sums, which is zero at an episode's start.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.compiled import Array

SUMS = 9  # columns: slots, commands (3), drifts (3), squares of commands, products of both
KEPT = 0.95  # A slot weighs this share of what the slot after it weighs.
DOUBT = 0.5  # So many slots at a_max speak against any gain: few slots leave it near 0.
MOST = 0.5  # No greater gain is believed, up or down.
HELD = 0.3  # This share of a push is held back from a_max to counter it.
LEAST = 0.3  # This share of a_max is counted on in any case.


def gather(sums: Array, command: Array, drift: Array) -> Array:
    """Returns the sums (N, 9) with one more slot.

    Args:
        command, drift: (N, 3) in units of a_max; the acceleration flown is their sum.
    """
    slot = np.concatenate(
        [
            np.ones((len(sums), 1)),
            command,
            drift,
            np.sum(command * command, axis=1, keepdims=True),
            np.sum(command * drift, axis=1, keepdims=True),
        ],
        axis=1,
    )
    return np.asarray(KEPT * sums + slot)


def estimate(sums: Array) -> tuple[Array, Array]:
    """Returns the gain (N, 1) and the push (N, 3) in units of a_max; zero before the first slot."""
    count = np.maximum(sums[:, :1], 1.0)
    command, drift = sums[:, 1:4], sums[:, 4:7]
    spread = sums[:, 7:8] - np.sum(command**2, axis=1, keepdims=True) / count
    together = sums[:, 8:9] - np.sum(command * drift, axis=1, keepdims=True) / count
    gain = np.clip(together / (spread + DOUBT), -MOST, MOST)
    return gain, (drift - gain * command) / count


def usable(gain: Array, push: Array) -> Array:
    """Returns the share (N, 1) of a_max to count on: weak actuators or a push lower it."""
    held = HELD * np.linalg.norm(push, axis=1, keepdims=True)
    return np.asarray(np.maximum(1.0 + np.minimum(gain, 0.0) - held, LEAST))


def counter(action: Array, gain: Array, push: Array) -> Array:
    """Returns commands (N, 3) that should fly as `action` (N, 3), both in units of a_max."""
    return np.asarray((action - push) / (1.0 + gain))
