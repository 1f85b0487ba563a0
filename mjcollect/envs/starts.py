"""Tries out the starts of episodes until they are clear of everything."""

from __future__ import annotations

import numpy as np

from mjcollect.flight.contact import is_outside
from mjcollect.geometry.boxes import segment_gap
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled
from mjcollect.geometry.tree import Tree, first_member, next_leaf
from mjcollect.geometry.vectors import dot, from_ball, norm


@compiled
def room_to_brake(
    bounds: Array, tree: Tree, a_max: float, slot: float, radius: float, q: Array, v: Array
) -> bool:
    """Returns whether a body is in bounds and clear of boxes, and stays so while it brakes.

    Args:
        bounds: (2, 3) m. tree: of the boxes. a_max: m/s^2. slot: s. radius: the body's (m).
        q, v: (3,) position (m) and velocity (m/s).
    """
    ahead, low, high, speed = np.empty(3), np.empty(3), np.empty(3), norm(v)
    # Braking in whole slots needs up to a_max slot^2 / 8 more than v^2 / (2 a_max).
    reach = speed / (2 * a_max) + a_max * slot**2 / 8 / max(speed, 1e-9)
    for k in range(3):
        ahead[k] = q[k] + v[k] * reach
        low[k], high[k] = min(q[k], ahead[k]), max(q[k], ahead[k])
    if is_outside(bounds, q, 0.0) or is_outside(bounds, ahead, 0.0):
        return False
    leaf = next_leaf(tree, -1, low, high, radius)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            if segment_gap(q, ahead, tree.boxes[tree.members[m]]) < radius:
                return False
        leaf = next_leaf(tree, leaf, low, high, radius)
    return True


@compiled
def try_starts(
    bounds: Array, tree: Tree, a_max: float, slot: float, radius: float, middle: Array,
    along: Array, half: Array, top: Array, kind: Indices, where: Array, where_share: Array,
    speed: Array, speed_share: Array, way_q: Array, way_v: Array, todo: Indices, q: Array,
    v: Array, wanting: Bools,
) -> None:  # fmt: skip
    """Writes a start of each `kind` (N,) into q, v (N, 3) for the n episodes `todo`.

    Positions of a kind fill the ellipsoid round `middle` (kinds, 3) with axis `along` (3,) and half
    widths `half` (kinds, 2) along and across it (m); its velocities fill the ball of radius `top`
    (kinds,) in m/s. A kind beyond the last starts at `way_q`, `way_v` (n, 3). Afterwards `wanting`
    (N,) says which starts do not fit. The draws are normal (n, 3) and uniform (n, 1): `where`,
    `where_share` for positions, `speed`, `speed_share` for velocities.
    """
    unit = np.empty(3)
    for j in range(len(todo)):
        i = todo[j]
        if kind[i] < len(middle):
            from_ball(where[j], where_share[j, 0], unit)
            major, minor = half[kind[i], 0], half[kind[i], 1]
            share = dot(unit, along)
            for k in range(3):
                across = unit[k] - share * along[k]
                q[i, k] = middle[kind[i], k] + share * along[k] * major + across * minor
            from_ball(speed[j], speed_share[j, 0], v[i])
            for k in range(3):
                v[i, k] *= top[kind[i]]
        else:
            for k in range(3):
                q[i, k], v[i, k] = way_q[j, k], way_v[j, k]
        wanting[i] = not room_to_brake(bounds, tree, a_max, slot, radius, q[i], v[i])
