"""Estimates in flight what disturbs it, and where the body is, vectorised over N simulations.

The acceleration of a slot is explained as shares of its command and of the command before it, and a
steady push. Both shares together say how strong the actuators are, the share of the older command
how late they are. What the model leaves over is taken for a gust, which dies away within a second;
what it failed to foretell is the spread. Positions are measured with noise, velocities without, so
a filter carries the position on by the velocity and corrects it a little by every measurement.

All that was observed so far is an array of numbers per simulation, which is zero at an episode's
start.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array, Indices

KEPT = 0.95  # A slot weighs this share of what the slot after it weighs.
DOUBT = 0.5  # So many slots at a_max speak for full strength and no delay: few slots say little.
MOST = 0.5  # No greater gain is believed, up or down.
HELD = 0.3  # This share of a push is held back from a_max to counter it.
LEAST = 0.3  # This share of a_max is counted on in any case.
GUST_SECONDS = 1.0  # What the model left over in a slot is believed to die away in this time.
BRAKED = 1.5  # Braking is counted on less by so many times the spread.
SPREAD_KEPT = 0.9  # A slot's error of foresight weighs this share of that of the slot after it.
TRUST = 0.04  # A measured position corrects the filter by this share of its error, at least.

WIDTHS = {
    "slots": 1,  # These are weighted sums: slots,
    "command": 3,  # commands, those before them, and accelerations, in units of a_max,
    "before": 3,
    "acceleration": 3,
    "products": 5,  # and products: command², before², command before, and both by acceleration.
    "left": 3,  # This is what the model left over of the last slot, in units of a_max.
    "errors": 2,  # These are weighted sums too: slots, and squares of errors of foresight.
    "position": 3,  # The filter holds these: its position (m),
    "measured": 2,  # and the number of measurements and the sum of their squared errors (m²).
    "last": 3,  # This is the last command that was sent, in units of a_max.
}
ENDS = np.cumsum([*WIDTHS.values()]).tolist()
_COLUMNS: Any = namedtuple("Columns", tuple(WIDTHS))  # type: ignore[misc]
AT: Any = _COLUMNS(
    *[slice(end - width, end) for width, end in zip(WIDTHS.values(), ENDS, strict=True)]
)
SUMS = sum(WIDTHS.values())


class Estimate(NamedTuple):
    """Holds what N simulations know of their disturbances; all zero is calm air.

    Attributes:
        gain: (N, 1) share by which accelerations exceed commands. push: (N, 3) acceleration that
            comes on top now (m/s²). late: (N, 1) s by which commands come late.
        spread: (N, 1) standard deviation, along an axis, of a slot's acceleration round what is
            foretold (m/s²). blur: (N, 1) that of the position (m).
    """

    gain: Array
    push: Array
    late: Array
    spread: Array
    blur: Array

    @classmethod
    def calm(cls, count: int) -> Estimate:
        """Returns that nothing disturbs `count` simulations."""
        one = np.zeros((count, 1))
        return cls(one, np.zeros((count, 3)), one.copy(), one.copy(), one.copy())

    def usable(self, a_max: Array) -> Array:
        """Returns the acceleration (N, 1) in m/s² to count on, of a_max (N, 1) or (1, 1)."""
        held = HELD * np.linalg.norm(self.push, axis=1, keepdims=True)
        return np.asarray(np.maximum((1.0 + self.gain) * a_max - held, LEAST * a_max))

    def braking(self, a_max: Array, v: Array) -> Array:
        """Returns the deceleration (N, 1) in m/s² that is left against velocities v (N, 3)."""
        ahead = -v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
        along = np.sum(self.push * ahead, axis=1, keepdims=True)
        aside = np.sum(self.push**2, axis=1, keepdims=True) - along**2
        strength = ((1.0 + self.gain) * a_max) ** 2 - aside
        left = np.minimum(along + np.sqrt(np.maximum(strength, 0.0)), self.usable(a_max))
        return np.asarray(np.maximum(left - BRAKED * self.spread, LEAST * a_max))

    def counter(self, a: Array, a_max: Array) -> Array:
        """Returns commands (N, 3) that fly as accelerations a (N, 3), as far as a_max allows."""
        command = (a - self.push) / (1.0 + self.gain)
        size = np.linalg.norm(command, axis=1, keepdims=True)
        return np.asarray(command * np.minimum(1.0, a_max / np.maximum(size, 1e-12)))

    def flown(self, command: Array) -> Array:
        """Returns the accelerations (N, 3) as which commands (N, 3) fly, without delay."""
        return np.asarray((1.0 + self.gain) * command + self.push)


def begin(sums: Array, which: Indices, measured: Array) -> None:
    """Forgets all about the episodes `which` (n,), which begin at measured positions (n, 3)."""
    sums[which] = 0.0
    sums[which, AT.position] = measured
    sums[which, AT.measured.start] = 1.0


def gather(
    world: World, sums: Array, v: Array, after: Array, command: Array, measured: Array
) -> None:
    """Adds a slot to the sums (N, SUMS).

    Args:
        v, after: (N, 3) velocities at the slot's start and end (m/s). command: (N, 3) sent (m/s²).
        measured: (N, 3) position measured at its end (m).
    """
    a_max, slot = world.a_max, world.slot
    now, flown, last = command / a_max, (after - v) / slot / a_max, sums[:, AT.last].copy()
    known = estimate(world, sums)
    missed = flown - _model(_shares(sums), now, last) - known.push / a_max
    _carry(world, sums, known, v, flown * a_max, command, measured)
    sums[:, AT.errors] *= SPREAD_KEPT
    sums[:, AT.errors] += np.stack([np.ones(len(v)), np.mean(missed**2, axis=1)], axis=1)
    old = slice(AT.slots.start, AT.products.stop)
    sums[:, old] *= KEPT
    sums[:, AT.slots] += 1.0
    pairs = ((now, now), (last, last), (now, last), (now, flown), (last, flown))
    sums[:, AT.products] += np.stack([np.sum(a * b, axis=1) for a, b in pairs], axis=1)
    for name, value in (("command", now), ("before", last), ("acceleration", flown)):
        sums[:, getattr(AT, name)] += value
    shares = _shares(sums)
    sums[:, AT.left] = flown - _model(shares, now, last) - _steady(sums, shares)
    sums[:, AT.last] = now


def estimate(world: World, sums: Array) -> Estimate:
    """Returns what the sums say; nothing disturbs before the first slot."""
    shares = _shares(sums)
    whole = np.sum(shares, axis=1, keepdims=True)
    gain = np.clip(whole - 1.0, -MOST, MOST)
    late = np.clip(shares[:, 1:] / np.maximum(whole, 1e-3), 0.0, 1.0) * world.slot
    fading = math.exp(-world.slot / GUST_SECONDS)
    push = (_steady(sums, shares) + fading * sums[:, AT.left]) * world.a_max
    slots, squares = sums[:, AT.errors].T[:, :, None]
    spread = np.sqrt(squares / np.maximum(slots, 1.0)) * world.a_max
    count, errors = sums[:, AT.measured].T[:, :, None]
    noise = errors / np.maximum(count - 1.0, 1.0)
    return Estimate(gain, push, late, spread, np.sqrt(noise * _trust(count)))


def foretell(world: World, sums: Array, known: Estimate, q: Array, v: Array) -> tuple[Array, Array]:
    """Returns where (N, 3) and how fast (N, 3) the body is once the next command takes effect."""
    a = known.flown(sums[:, AT.last] * world.a_max)
    late = known.late
    return q + v * late + a * late**2 / 2, v + a * late


def _shares(sums: Array) -> Array:
    """Returns the shares (N, 2) of command and command before that explain accelerations best."""
    count = np.maximum(sums[:, AT.slots.start], 1.0)
    means = [sums[:, getattr(AT, name)] for name in ("command", "before", "acceleration")]
    now, last, flown = means
    pairs = ((now, now), (last, last), (now, last), (now, flown), (last, flown))
    moments = [
        products - np.sum(a * b, axis=1) / count
        for products, (a, b) in zip(sums[:, AT.products].T, pairs, strict=True)
    ]
    cc, pp, cp, ca, pa = moments
    one, two = cc + DOUBT, pp + DOUBT
    first, second = ca - cc, pa - cp  # The doubt speaks for a share of 1 and a share of 0.
    whole = one * two - cp**2
    return np.stack(
        [1.0 + (two * first - cp * second) / whole, (one * second - cp * first) / whole], axis=1
    )


def _model(shares: Array, now: Array, last: Array) -> Array:
    """Returns what the shares (N, 2) make of a command (N, 3) and the one before it."""
    return np.asarray(shares[:, :1] * now + shares[:, 1:] * last)


def _steady(sums: Array, shares: Array) -> Array:
    """Returns the steady push (N, 3) in units of a_max."""
    mean = _model(shares, sums[:, AT.command], sums[:, AT.before])
    return np.asarray((sums[:, AT.acceleration] - mean) / np.maximum(sums[:, AT.slots], 1.0))


def _trust(count: Array) -> Array:
    return np.maximum(1.0 / np.maximum(count, 1.0), TRUST)


def _carry(
    world: World, sums: Array, known: Estimate, v: Array, flown: Array, command: Array,
    measured: Array,
) -> None:  # fmt: skip
    """Carries the filter's position through a slot of mean acceleration `flown` (N, 3)."""
    slot, late = world.slot, known.late
    old, new = (1.0 + known.gain) * sums[:, AT.last] * world.a_max, (1.0 + known.gain) * command
    rest = flown - (late * old + (slot - late) * new) / slot
    moved = v * slot + old * (late * slot - late**2 / 2) + new * (slot - late) ** 2 / 2
    moved = moved + rest * slot**2 / 2 + flown * slot * world.step / 2  # semi-implicit steps
    foretold = sums[:, AT.position] + moved
    error = measured - foretold
    sums[:, AT.measured.start] += 1.0
    trust = _trust(sums[:, AT.measured.start :][:, :1])
    sums[:, AT.position] = foretold + trust * error
    sums[:, AT.measured.start + 1] += (1.0 - trust[:, 0]) * np.mean(error**2, axis=1)
