"""Deflects commands along what they would lead into.

Whoever flies at an angle towards a wall can brake across it and keep on along it. A command is
deflected at the obstacle that its backup would come to first: its part towards the obstacle is cut
to what braking in a straight line still ends before it, and what is left of a_max goes along it.
The shield tries this before it bends a command towards braking, and checks it like every other.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.projection import project_row
from mjcollect.flight.world import World, tree_of
from mjcollect.geometry.boxes import FAR, box_offset, segment_gap
from mjcollect.geometry.compiled import Array, compiled
from mjcollect.geometry.tree import first_member, next_leaf
from mjcollect.geometry.vectors import dot, hull, into_ball, norm, unit

SURE = 0.8  # The part towards an obstacle is cut to this share of what braking would allow.
TIMES = 2  # A command is deflected at so many obstacles, one after the other.


@compiled
def first_hit(path: Array, reach: Array, count: int, box: Array) -> int:
    """Returns the first of `count` points (..., 3) whose piece comes within `reach` (...) of a box.

    Returns `count` if none does.
    """
    for p in range(1, count):
        if segment_gap(path[p - 1], path[p], box) < reach[p]:
            return p
    return count


@compiled
def first_outside(path: Array, reach: Array, count: int, bounds: Array, away: Array) -> int:
    """Returns the first point nearer to a bound (2, 3) than `reach` and no point before it.

    Writes the axis that leads out there to `away` (3,).
    """
    for p in range(1, count):
        for k in range(3):
            low, high = path[p, k] - bounds[0, k], bounds[1, k] - path[p, k]
            if min(low, high) < reach[p] and path[p, k] != path[0, k]:
                away[:] = 0.0
                away[k] = 1.0 if path[p, k] > path[0, k] else -1.0
                return p
    return count


@compiled
def deflect_row(
    world: World, w: int, v: Array, braking: float, away: Array, gap: float, a: Array
) -> bool:
    """Deflects the command `a` (3,) from an obstacle `gap` m off in the direction `away` (3,).

    Args:
        v: velocity (3,) as the obstacle sees it (m/s). braking: deceleration to count on (m/s²).

    Returns:
        Whether the command led towards it.
    """
    a_max, slot, ahead = world.a_max[w, 0], world.slot, np.empty(3)
    for k in range(3):
        ahead[k] = v[k] + a[k] * slot
    # Braking from u leads |u| u / 2b: its part towards the obstacle must end before it.
    towards, speed = dot(ahead, away), max(norm(ahead), 1e-6)
    left = gap - (dot(v, away) + max(towards, 0.0)) / 2 * slot
    allowed = SURE * 2 * braking * max(left, 0.0) / speed
    if towards <= allowed:
        return False
    across, wanted = dot(a, away), (allowed - dot(v, away)) / slot
    wanted = max(wanted, -a_max)
    for k in range(3):
        a[k] -= across * away[k]
    into_ball(a, math.sqrt(max(a_max**2 - wanted**2, 0.0)))
    for k in range(3):
        a[k] += wanted * away[k]
    return True


@compiled
def towards_box(point: Array, box: Array, away: Array) -> float:
    """Returns the distance (m) of a point to a box; writes the direction there to `away` (3,)."""
    box_offset(point, box, away)
    return unit(away, away)


@compiled
def nearest_ahead(
    world: World, w: int, path: Array, times: Array, reach: Array, count: int, moving: Array,
    drift: Array, away: Array, flow: Array,
) -> float:  # fmt: skip
    """Returns the gap (m) between the start of a path and what the path comes to first.

    It is infinite if the path comes to nothing. Writes the direction to that obstacle to `away`
    (3,) and its velocity to `flow` (3,).

    Args:
        path, times, reach: (..., 3), (...), (...): `count` points (m), when they are reached (s),
            and what is kept clear there (m). moving, drift: (B, 2, 3), (B, 3) moving boxes (m) and
            their velocities (m/s).
    """
    tree, bounds, here = tree_of(world, w), world.bounds[w], path[0]
    inner = reach - world.radius[w, 0]
    first, gap = first_outside(path, inner, count, bounds, away), np.inf
    flow[:] = 0.0
    if first < count:
        gap = -inner[first]
        for k in range(3):
            gap += max(away[k] * (bounds[1, k] - here[k]), away[k] * (bounds[0, k] - here[k]))
    low, high, most = np.empty(3), np.empty(3), reach[:count].max()
    hull(path, count, low, high)
    leaf = next_leaf(tree, -1, low, high, most)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            box = tree.boxes[tree.members[m]]
            hit = first_hit(path, reach, first, box)
            if hit < first:
                first, gap = hit, towards_box(here, box, away) - reach[hit]
        leaf = next_leaf(tree, leaf, low, high, most)
    for b in range(len(moving)):
        if moving[b, 0, 0] > FAR / 2:
            continue
        seen = path[:count].copy()  # as the box sees it
        for p in range(count):
            for k in range(3):
                seen[p, k] -= drift[b, k] * times[p]
        hit = first_hit(seen, reach, first, moving[b])
        if hit < first:
            first, gap = hit, towards_box(here, moving[b], away) - reach[hit]
            flow[:] = drift[b]
    return gap


@compiled
def deflected(
    world: World, w: int, v: Array, braking: float, path: Array, times: Array, reach: Array,
    count: int, moving: Array, drift: Array, a: Array,
) -> bool:  # fmt: skip
    """Deflects `a` (3,) from what its backup, a `path` as in `nearest_ahead`, comes to first.

    Returns whether there was anything to deflect it from.
    """
    away, flow, seen = np.zeros(3), np.empty(3), np.empty(3)
    gap = nearest_ahead(world, w, path, times, reach, count, moving, drift, away, flow)
    if not np.isfinite(gap):
        return False
    for k in range(3):
        seen[k] = v[k] - flow[k]
    if not deflect_row(world, w, seen, braking, away, gap, a):
        return False
    for k in range(3):
        away[k] = a[k] / world.a_max[w, 0]
    project_row(world, w, v, away, a)
    return True
