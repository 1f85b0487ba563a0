"""Collects items, eq. (5): a slot is flown as the stop at the goal wherever that is possible."""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.projection import project_row
from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, Bools, compiled, plain
from mjcollect.geometry.vectors import norm


@compiled
def arrests_row(world: World, w: int, q: Array, v: Array, goal: Array, tolerance: float) -> bool:
    """Returns for one body, in scene `w` of the world, what `arrests` does."""
    coasted = world.slot * (world.substeps - 1) / (2 * world.substeps)
    square = 0.0
    for k in range(3):
        square += (q[k] + v[k] * coasted - goal[k]) ** 2
    return bool(norm(v) <= world.a_max[w, 0] * world.slot and math.sqrt(square) <= tolerance)


@compiled
def command_rows(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array,
    a: Array, stop: Bools,
) -> None:  # fmt: skip
    """Compiled loop of `command` over N simulations, which writes to `a` and `stop`."""
    for i in range(len(v)):
        w = scene_of(world, i)
        stop[i] = arrests_row(world, w, q[i], v[i], goal[i], tolerance[i])
        if stop[i]:
            for k in range(3):
                a[i, k] = -v[i, k] / world.slot
        else:
            project_row(world, w, v[i], action[i], a[i])


def arrests(world: World, q: Array, v: Array, goal: Array, tolerance: Array) -> Bools:
    """Returns whether this slot is flown as a = -v / slot to stop at the goal, eq. (5).

    It is where one slot can stop the body and the stop lies within `tolerance` of the goal.

    Args:
        q, v, goal: (N, 3). tolerance: (N,) m.

    Returns:
        (N,) booleans.
    """
    return command(world, q, v, np.zeros_like(v), goal, tolerance)[1]


def command(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array
) -> tuple[Array, Bools]:
    """Returns the acceleration (N, 3) in m/s^2 of the next slot, and whether (N,) it is the stop.

    Where it is not, it is the projected `action` (N, 3); the other arguments are as in `arrests`.
    """
    a, stop = np.empty(v.shape), np.empty(len(v), dtype=bool)
    command_rows(world, plain(q), plain(v), plain(action), plain(goal), plain(tolerance), a, stop)
    return a, stop
