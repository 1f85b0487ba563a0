"""Computes motion in slots: what they fly, where a body rests, and the least time to rest."""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, compiled, plain

TIME_CAP = 60.0  # seconds; the time to go, a part of the reward's potential, grows no further


def resting_point(world: World, q: Array, v: Array) -> Array:
    """Returns where bodies (N, 3) rest after a slot of a = -v / slot in n semi-implicit steps."""
    n = world.substeps
    return q + v * (world.slot * (n - 1) / (2 * n))


def slot_path(world: World, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Returns positions (N, n + 1, 3), the first being q, and last velocities (N, 3) of a slot.

    It integrates as MuJoCo, by semi-implicit Euler, eq. (2)-(3), a body that touches nothing.

    Args:
        q, v, a: (N, 3), position, velocity and the acceleration held.
    """
    speeds = v[:, None] + a[:, None] * world.step * np.arange(1, world.substeps + 1)[:, None]
    path = q[:, None] + np.cumsum(speeds * world.step, axis=1)
    return np.concatenate([q[:, None], path], axis=1), speeds[:, -1]


@compiled
def time_to_rest(distance: float, closing: float, margin: float, a_max: float, top: float) -> float:
    """Returns the `time_to_go` of one body, without its cap; `top` is v_max."""
    away = min(closing, 0.0)  # the receding motion is braked first
    left = distance + away**2 / (2 * a_max)
    speed = min(max(closing, 0.0), top)
    braking = speed**2 / (2 * a_max)
    near, far = max(left - margin, 0.0), left + margin
    if braking >= near:
        # Too fast to stop before the far end, the body brakes, then comes back.
        time = speed / a_max + 2 * math.sqrt(max(braking - far, 0.0) / a_max)
    else:
        peak = math.sqrt(a_max * near + speed**2 / 2)
        cruise = max(near - (2 * top**2 - speed**2) / (2 * a_max), 0.0) / top
        time = (2 * min(peak, top) - speed) / a_max + cruise
    return time - away / a_max


@compiled
def time_to_go_rows(
    world: World, distance: Array, closing: Array, margin: Array, cap: float, time: Array
) -> None:
    """Compiled loop of `time_to_go` over N simulations, which writes to `time` (N,)."""
    for i in range(len(time)):
        w = scene_of(world, i)
        a_max, top = world.a_max[w, 0], world.v_max[w, 0]
        time[i] = min(time_to_rest(distance[i], closing[i], margin[i], a_max, top), cap)


def time_to_go(world: World, distance: Array, closing: Array, margin: Array | float = 0.0) -> Array:
    """Returns the least time in s to come to rest along a line, under both limits.

    Args:
        distance: (N,) >= 0, to the point to rest at. closing: (N,) speed along the line in m/s,
            negative when receding. margin: (N,) metres before and after the point that do as well.

    Returns:
        (N,) seconds, capped at 60.
    """
    time = np.empty(len(distance))
    margin = plain(margin if isinstance(margin, np.ndarray) else np.full(len(time), margin))
    time_to_go_rows(world, plain(distance), plain(closing), margin, TIME_CAP, time)
    return time


def roll_out(world: World, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Returns positions and velocities, each (M, n + 1, 3), of the physics steps in M slots.

    Semi-implicit Euler as in MuJoCo, eq. (2)-(3), steps first the velocity, then the position.

    Args:
        q, v: (3,), where it begins. a: (M, 3), commands in m/s^2.
    """
    n = world.substeps
    change = np.repeat(a, n, axis=0) * world.step
    speeds = np.concatenate([v[None], v + np.cumsum(change, axis=0)])
    path = np.concatenate([q[None], q + np.cumsum(speeds[1:] * world.step, axis=0)])
    index = np.arange(len(a))[:, None] * n + np.arange(n + 1)
    return path[index], speeds[index]
