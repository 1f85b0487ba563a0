"""What disturbs a flight, estimated from the slots flown so far.

By how much a slot's acceleration differed from its command is taken as a share of the command, the
`gain`, and a steady `push`: least squares over the slots of the episode, recent ones counting more.
Vectorised over N simulations; what was seen so far is an array of sums, zero at an episode's start.
"""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.compiled import Array

SUMS = 9  # slots, commands (3), drifts (3), squares of commands, products of both
KEPT = 0.95  # weight of a slot against that after it
DOUBT = 0.5  # slots at a_max that speak against any gain: it stays near 0 on little evidence
MOST = 0.5  # greatest gain believed, up and down
HELD = 0.3  # share of a push that is held back for it
LEAST = 0.3  # share of a_max that is counted on in any case


def gather(sums: Array, command: Array, drift: Array) -> Array:
    """Sums (N, 9) with one more slot.

    Args:
        command, drift: (N, 3) in units of a_max; what was flown is their sum.
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
    """Gain (N, 1) and push (N, 3) in units of a_max; zero where nothing was flown yet."""
    count = np.maximum(sums[:, :1], 1.0)
    command, drift = sums[:, 1:4], sums[:, 4:7]
    spread = sums[:, 7:8] - np.sum(command**2, axis=1, keepdims=True) / count
    together = sums[:, 8:9] - np.sum(command * drift, axis=1, keepdims=True) / count
    gain = np.clip(together / (spread + DOUBT), -MOST, MOST)
    return gain, (drift - gain * command) / count


def usable(gain: Array, push: Array) -> Array:
    """Share (N, 1) of a_max to count on: less where actuators are weak or something pushes."""
    held = HELD * np.linalg.norm(push, axis=1, keepdims=True)
    return np.asarray(np.maximum(1.0 + np.minimum(gain, 0.0) - held, LEAST))


def counter(action: Array, gain: Array, push: Array) -> Array:
    """Commands (N, 3) that should fly as `action` (N, 3), both in units of a_max."""
    return np.asarray((action - push) / (1.0 + gain))
