"""Where in a goal's ball the guidance law stops.

A leg takes a whole number of slots. What they leave to spare is used to stop nearer to where the
tour goes on.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.straight_line import time_to_rest
from mjcollect.geometry.compiled import Array, compiled
from mjcollect.geometry.vectors import dot, lerp, norm, unit
from mjcollect.guidance.way import Way

SPARE = 0.01  # seconds of what is to spare that are not counted on
RIM_SHARE = 0.1  # of the radius that a stop moved by RIM_REACHED of the way, or more, keeps inside
RIM_REACHED = 0.25
ASTRIDE = 0.2  # of the radius: nearer to the centre the way to the stop leads through the ball
STRETCH = 1e-6  # share of a slot by which a time may exceed whole slots


@compiled
def chord(goal: Array, radius: float, q: Array, towards: Array) -> tuple[float, float]:
    """Metres from q along `towards` to the middle of the chord through a ball, and half of it.

    The half is negative where the ball is missed.
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
    """Metres to a stop in the ball along the velocity: near the end the heading is kept."""
    speed = unit(v, towards)
    braking = speed**2 / (2 * a_max)
    middle, half = chord(goal, radius, q, towards)
    if half < 0.0 or middle + half <= 0.0:  # missed: straight to the ball
        for k in range(3):
            towards[k] = goal[k] - q[k]
        return max(unit(towards, towards) - radius, 0.0)
    near, last = max(middle - half, 0.0), 0.0
    for k in range(3):
        last += (best[k] - q[k]) * towards[k]
    last = min(max(last, near), middle + half)
    if braking >= near:
        slots = math.ceil(speed / a_max / slot - STRETCH)
        return max(braking, min(last, speed * slots * slot / 2))  # even braking in whole slots
    slots = math.ceil((time_to_rest(near, speed, 0.0, a_max, top) + SPARE) / slot - STRETCH)
    low, high = near, last
    for _ in range(12):
        tried = (low + high) / 2
        if time_to_rest(tried, speed, 0.0, a_max, top) <= slots * slot - SPARE:
            low = tried
        else:
            high = tried
    return low


@compiled
def rim(way: Way, goal: Array, radius: float, inwards: Array, share: float, point: Array) -> None:
    """A point of the goal's ball between where `inwards` enters it and `Way.stop`.

    Near the sphere, where at first it takes hardly any way to move towards the stop; not on it,
    or a turn that is not exact to the millimetre would miss the ball.
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
    """Metres to fly along `towards`, which is set, to a stop in the goal's ball; -1: to the aim.

    As near to `Way.stop`, where the tour goes on, as takes no more slots than the shortest way
    into the ball.
    """
    radius = way.stop[3]
    if radius <= 0.0:
        return -1.0
    for k in range(3):
        towards[k] = goal[k] - q[k]
    far, speed = unit(towards, towards), norm(v)
    if speed > 1.0 and speed**2 / a_max + 2 * speed * slot >= far - radius:
        return along(goal, way.stop, radius, q, v, a_max, top, slot, towards)
    if far <= radius:
        return 0.0
    inwards, step = towards.copy(), np.empty(3)
    least = time_to_rest(far - radius, dot(v, towards), 0.0, a_max, top)
    slots = math.ceil((least + SPARE) / slot)
    low, high = 0.0, 1.0
    for trial in range(9):
        share = 1.0 if trial == 0 else (low + high) / 2
        rim(way, goal, radius, inwards, share, step)
        for k in range(3):
            step[k] -= q[k]
        room = unit(step, towards)
        if time_to_rest(room, dot(v, towards), 0.0, a_max, top) <= slots * slot - SPARE:
            low = share
            if trial == 0:
                return room
        else:
            high = share
    rim(way, goal, radius, inwards, low, step)
    for k in range(3):
        step[k] -= q[k]
    return unit(step, towards)
