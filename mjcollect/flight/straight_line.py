"""Motion on straight lines: what a slot flies, where a body rests, and the least time to go."""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, compiled, plain

TIME_CAP = 60.0  # seconds; the time to go in the potential saturates here


def resting_point(world: World, q: Array, v: Array) -> Array:
    """Where the body (N, 3) rests after one slot of a = -v / slot in n semi-implicit steps."""
    n = world.substeps
    return q + v * (world.slot * (n - 1) / (2 * n))


def slot_path(world: World, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Positions (N, n + 1, 3), the first is q, and last velocities (N, 3) of a slot.

    MuJoCo's semi-implicit Euler, eq. (2)-(3), for a body that touches nothing.

    Args:
        q, v, a: (N, 3) position, velocity and the acceleration held.
    """
    speeds = v[:, None] + a[:, None] * world.step * np.arange(1, world.substeps + 1)[:, None]
    path = q[:, None] + np.cumsum(speeds * world.step, axis=1)
    return np.concatenate([q[:, None], path], axis=1), speeds[:, -1]


@compiled
def time_to_rest(distance: float, closing: float, slack: float, a_max: float, top: float) -> float:
    """See `reward.time_to_go`; without its cap."""
    away = min(closing, 0.0)  # first brake the receding motion
    left = distance + away**2 / (2 * a_max)
    speed = min(max(closing, 0.0), top)
    braking = speed**2 / (2 * a_max)
    near, far = max(left - slack, 0.0), left + slack
    if braking >= near:
        # If too fast to stop before the far end: brake, then come back.
        time = speed / a_max + 2 * math.sqrt(max(braking - far, 0.0) / a_max)
    else:
        peak = math.sqrt(a_max * near + speed**2 / 2)
        cruise = max(near - (2 * top**2 - speed**2) / (2 * a_max), 0.0) / top
        time = (2 * min(peak, top) - speed) / a_max + cruise
    return time - away / a_max


@compiled
def time_to_go_rows(
    world: World, distance: Array, closing: Array, slack: Array, cap: float, time: Array
) -> None:
    """See `reward.time_to_go`."""
    for i in range(len(time)):
        w = scene_of(world, i)
        a_max, top = world.a_max[w, 0], world.v_max[w, 0]
        time[i] = min(time_to_rest(distance[i], closing[i], slack[i], a_max, top), cap)


def time_to_go(world: World, distance: Array, closing: Array, slack: Array | float = 0.0) -> Array:
    """Least time in s to come to rest along a line, under both limits.

    Args:
        distance: (N,) >= 0, to the point to rest at. closing: (N,) speed along the line in m/s,
            negative when receding. slack: (N,) metres before and after the point that do as well.

    Returns:
        (N,) seconds, capped at 60.
    """
    time = np.empty(len(distance))
    slack = plain(slack if isinstance(slack, np.ndarray) else np.full(len(time), slack))
    time_to_go_rows(world, plain(distance), plain(closing), slack, TIME_CAP, time)
    return time


def roll_out(world: World, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Positions and velocities, each (M, n + 1, 3), of the physics steps in M slots.

    Semi-implicit Euler as in MuJoCo, eq. (2)-(3): first the velocity, then the position.

    Args:
        q, v: (3,) where it begins. a: (M, 3) commands.
    """
    n = world.substeps
    change = np.repeat(a, n, axis=0) * world.step
    speeds = np.concatenate([v[None], v + np.cumsum(change, axis=0)])
    path = np.concatenate([q[None], q + np.cumsum(speeds[1:] * world.step, axis=0)])
    index = np.arange(len(a))[:, None] * n + np.arange(n + 1)
    return path[index], speeds[index]
