"""The projection: raw actions become accelerations within both limits, eq. (2)-(3)."""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, compiled, plain
from mjcollect.geometry.vectors import into_ball


@compiled
def project_row(world: World, w: int, v: Array, action: Array, a: Array) -> None:
    """See `flight.project`."""
    a_max, v_max = world.a_max[w, 0], world.v_max[w, 0]
    for k in range(3):
        raw = action[k] if math.isfinite(action[k]) else 0.0
        a[k] = min(max(raw, -1e100), 1e100) * a_max  # its square must not overflow
    into_ball(a, a_max)
    for k in range(3):
        a[k] = v[k] + a[k] * world.slot
    into_ball(a, v_max)
    for k in range(3):
        a[k] = (a[k] - v[k]) / world.slot


@compiled
def project_rows(world: World, v: Array, action: Array, a: Array) -> None:
    """See `flight.project`."""
    for i in range(len(v)):
        project_row(world, scene_of(world, i), v[i], action[i], a[i])


def project(world: World, v: Array, action: Array) -> Array:
    """Feasible acceleration nearest in spirit to a raw action, eq. (2)-(3).

    The action is scaled into the a_max ball, then v + a slot into the v_max ball. Because
    |v| <= v_max, the second step only shortens the change of velocity: both limits hold.

    Args:
        v: (N, 3) m/s, |v| <= v_max. action: (N, 3), 1 = a_max along an axis; not finite counts 0.

    Returns:
        (N, 3) accelerations in m/s^2.
    """
    a = np.empty(v.shape)
    project_rows(world, plain(v), plain(action), a)
    return a
