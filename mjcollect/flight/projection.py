"""Projects raw actions to accelerations within both limits, eq. (2)-(3)."""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, compiled, plain
from mjcollect.geometry.vectors import into_ball


@compiled
def project_row(world: World, w: int, v: Array, action: Array, a: Array) -> None:
    """Writes to `a` (3,) the `project` of one action, in scene `w` of the world."""
    a_max, v_max = world.a_max[w, 0], world.v_max[w, 0]
    for k in range(3):
        raw = action[k] if math.isfinite(action[k]) else 0.0
        a[k] = min(max(raw, -1e100), 1e100) * a_max  # so that its square cannot overflow
    into_ball(a, a_max)
    for k in range(3):
        a[k] = v[k] + a[k] * world.slot
    into_ball(a, v_max)
    for k in range(3):
        a[k] = (a[k] - v[k]) / world.slot


@compiled
def project_rows(world: World, v: Array, action: Array, a: Array) -> None:
    """Compiled loop of `project` over N simulations, which writes to `a` (N, 3)."""
    for i in range(len(v)):
        project_row(world, scene_of(world, i), v[i], action[i], a[i])


def project(world: World, v: Array, action: Array) -> Array:
    """Returns the feasible accelerations that raw actions stand for, eq. (2)-(3).

    The action is shortened into the a_max ball, then v + a slot into the v_max ball. Because
    |v| <= v_max, the second step only shortens the change of velocity, so both limits hold.

    Args:
        v: (N, 3) m/s, |v| <= v_max. action: (N, 3), in units of a_max; what is not finite counts 0.

    Returns:
        (N, 3) accelerations in m/s^2.
    """
    a = np.empty(v.shape)
    project_rows(world, plain(v), plain(action), a)
    return a
