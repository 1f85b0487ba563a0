"""Following a racing line: the states of a planned flight, one per slot, see `racing_line`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mjcollect.compiled import Array, compiled
from mjcollect.kernels.law import steer
from mjcollect.kernels.vectors import between, dot, norm, unit

if TYPE_CHECKING:
    from mjcollect.flight import World

SPEED_WEIGHT = 2.0  # metres that a difference of 1 m/s counts for in finding the place on a line
BEHIND = 6.0  # metres that it may be behind or ahead of its place, along the line
FASTER = 1.0  # m/s above the line's speed at which it is still followed
IDLE_SHARE = 0.4  # of the room beside a line, within which nothing is corrected
GAIN = 0.5  # share of what is beyond that which a slot corrects
BACK_SHARE = 0.2  # of the line's speed: greatest speed back towards it
BRAKE_SHARE = 0.5  # of a_max that is counted on to end a motion across the line


@compiled
def place_on(line: Array, q: Array, v: Array) -> float:
    """Place on a line (L, 7), in slots from its start, nearest to a state."""
    best, place = np.inf, 0.0
    for i in range(len(line) - 1):
        along, square, far = 0.0, 1e-12, 0.0
        for k in range(3):
            step, change = line[i + 1, k] - line[i, k], line[i + 1, 3 + k] - line[i, 3 + k]
            along += (q[k] - line[i, k]) * step
            along += SPEED_WEIGHT**2 * (v[k] - line[i, 3 + k]) * change
            square += step**2 + (SPEED_WEIGHT * change) ** 2
        share = min(max(along / square, 0.0), 1.0)
        for k in range(3):
            far += (between(line[i, k], line[i + 1, k], share) - q[k]) ** 2
            gap = between(line[i, 3 + k], line[i + 1, 3 + k], share) - v[k]
            far += (SPEED_WEIGHT * gap) ** 2
        if far < best:
            best, place = far, i + share
    return place


@compiled
def read_line(line: Array, place: float, at: Array) -> None:
    """The line's state and room, `at` (7,), at a place between two of its slots."""
    i = min(int(place), len(line) - 2)
    for k in range(6):
        at[k] = between(line[i, k], line[i + 1, k], place - i)
    at[6] = min(line[i, 6], line[i + 1, 6])


@compiled
def across(vector: Array, heading: Array, out: Array) -> None:
    """What of a vector is at right angles to a direction."""
    along = dot(vector, heading)
    for k in range(3):
        out[k] = vector[k] - along * heading[k]


@compiled
def follow_row(world: World, w: int, line: Array, q: Array, v: Array, action: Array) -> bool:
    """Action along a line (L, 7); False where it ends or cannot be followed from here.

    It is followed near its place, where the room suffices for the offset from it, now and once the
    motion across it has been ended, and at its speed at most.
    """
    place = place_on(line, q, v)
    if place + 1 > len(line) - 1:
        return False
    a_max, slot = world.a_max[w, 0], world.slot
    here, there, heading, now = np.empty(7), np.empty(7), np.empty(3), np.empty(3)
    read_line(line, place, here)
    read_line(line, place + 1, there)
    speed = unit(there[3:6], heading)
    fastest = max(speed, unit(here[3:6], now))
    if dot(v, heading) > fastest + FASTER:
        return False
    room = min(here[6], there[6])
    gap, offset, drift, wanted = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        gap[k] = q[k] - here[k]
    if abs(dot(gap, heading)) > BEHIND:
        return False
    across(gap, heading, offset)
    across(v, now, drift)
    seconds = norm(drift) / (2 * BRAKE_SHARE * a_max)
    for k in range(3):
        drift[k] = offset[k] + drift[k] * seconds
        gap[k] = q[k] + (v[k] + there[3 + k]) * slot / 2 - there[k]
    if norm(offset) > room or norm(drift) > room:
        return False
    across(gap, heading, offset)
    far = max(norm(offset), 1e-9)
    back = GAIN * max(far - IDLE_SHARE * room, 0.0) / slot
    back = min(back, BACK_SHARE * speed) / far
    # Before the line's start there is no speed to keep to.
    more = a_max * slot if place <= 0.0 else 0.0
    for k in range(3):
        wanted[k] = there[3 + k] + more * heading[k] - back * offset[k]
    steer(world, w, v, heading, wanted, action)
    for k in range(3):
        action[k] /= a_max
    return True
