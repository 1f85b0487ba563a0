"""Chooses where in a goal's ball the guidance law stops.

A segment takes a whole number of slots. The time that these leave over is used to stop nearer to
where the tour goes on.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.straight_line import time_to_rest
from mjcollect.geometry.compiled import Array, compiled
from mjcollect.geometry.vectors import dot, lerp, norm, unit
from mjcollect.guidance.way import Way

SPARE_SHARE = 20  # One part in so many of a slot is not counted on of the time left over.
# A stop that is moved by RIM_REACHED of the way, or more, stays RIM_SHARE of the radius inside.
RIM_SHARE = 0.1
RIM_REACHED = 0.25
ASTRIDE = 0.2  # Nearer to the centre than this share of the radius, a stop is not moved outwards.
SLOW = 0.02  # A body slower than this share of v_max may turn to any stop.
STRETCH = 1e-6  # A time may exceed whole slots by this share of a slot.


@compiled
def chord(goal: Array, radius: float, q: Array, towards: Array) -> tuple[float, float]:
    """Returns metres from q along `towards` to the middle of the chord of a ball, and half of it.

    The half is negative where the line misses the ball.
    """
    middle, square = 0.0, 0.0
    for k in range(3):
        middle += (goal[k] - q[k]) * towards[k]
        square += (goal[k] - q[k]) ** 2
    left = radius**2 - (square - middle**2)
    return middle, math.sqrt(left) if left >= 0.0 else -1.0


@compiled
def along(
    goal: Array, best: Array, radius: float, q: Array, v: Array, a_max: float, top: float,
    slot: float, towards: Array,
) -> float:  # fmt: skip
    """Returns the metres to a stop in the ball along the velocity: near it no turn is begun."""
    speed = unit(v, towards)
    braking = speed**2 / (2 * a_max)
    middle, half = chord(goal, radius, q, towards)
    if half < 0.0 or middle + half <= 0.0:  # a miss: straight to the ball
        for k in range(3):
            towards[k] = goal[k] - q[k]
        return max(unit(towards, towards) - radius, 0.0)
    near, last = max(middle - half, 0.0), 0.0
    for k in range(3):
        last += (best[k] - q[k]) * towards[k]
    last = min(max(last, near), middle + half)
    if braking >= near:
        slots = math.ceil(speed / a_max / slot - STRETCH)
        return max(braking, min(last, speed * slots * slot / 2))  # even braking over whole slots
    spare = slot / SPARE_SHARE
    slots = math.ceil((time_to_rest(near, speed, 0.0, a_max, top) + spare) / slot - STRETCH)
    low, high = near, last
    for _ in range(12):
        tried = (low + high) / 2
        if time_to_rest(tried, speed, 0.0, a_max, top) <= slots * slot - spare:
            low = tried
        else:
            high = tried
    return low


@compiled
def rim(way: Way, goal: Array, radius: float, inwards: Array, share: float, point: Array) -> None:
    """Writes to `point` a point of the goal's ball, from where `inwards` enters it to `Way.stop`.

    It is near the sphere, where at first it takes hardly any way to move towards the stop; not on
    it, or a turn that is not exact to the millimetre would miss the ball.
    """
    square = 0.0
    for k in range(3):
        aside = way.stop[k] - goal[k]
        point[k] = lerp(-radius * inwards[k], aside, share)
        square += aside**2
    reach = lerp(radius, math.sqrt(square), share)
    reach *= 1.0 - RIM_SHARE * min(share / RIM_REACHED, 1.0)
    size = norm(point)
    for k in range(3):
        point[k] = goal[k] + point[k] * (reach / size if size > ASTRIDE * radius else 1.0)


@compiled
def stop_row(
    way: Way, goal: Array, q: Array, v: Array, a_max: float, top: float, slot: float,
    towards: Array,
) -> float:  # fmt: skip
    """Returns the metres to a stop in the goal's ball along `towards`, which is written; -1: none.

    The stop is as near to `Way.stop`, where the tour goes on, as takes no more slots than the
    shortest way into the ball. With -1 the aim is flown to.
    """
    radius = way.stop[3]
    if radius <= 0.0:
        return -1.0
    for k in range(3):
        towards[k] = goal[k] - q[k]
    far, speed = unit(towards, towards), norm(v)
    if speed > SLOW * top and speed**2 / a_max + 2 * speed * slot >= far - radius:
        return along(goal, way.stop, radius, q, v, a_max, top, slot, towards)
    if far <= radius:
        return 0.0
    inwards, step = towards.copy(), np.empty(3)
    least = time_to_rest(far - radius, dot(v, towards), 0.0, a_max, top)
    spare = slot / SPARE_SHARE
    slots = math.ceil((least + spare) / slot)
    low, high = 0.0, 1.0
    for trial in range(9):
        share = 1.0 if trial == 0 else (low + high) / 2
        rim(way, goal, radius, inwards, share, step)
        for k in range(3):
            step[k] -= q[k]
        length = unit(step, towards)
        if time_to_rest(length, dot(v, towards), 0.0, a_max, top) <= slots * slot - spare:
            low = share
            if trial == 0:
                return length
        else:
            high = share
    rim(way, goal, radius, inwards, low, step)
    for k in range(3):
        step[k] -= q[k]
    return unit(step, towards)
