"""Flies the guidance law, which learns nothing: along the path as fast as it can still be flown.

Policies are compared with it and learn from its demonstrations. After each of its slots full
braking leads to rest without touching anything, so a flight that begins at rest and keeps to the
law never touches anything.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.projection import project_row
from mjcollect.flight.shield import OUTSIDE
from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.among_boxes import free_way, nearest_box
from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.geometry.vectors import dot, into_ball, norm, unit
from mjcollect.guidance.stopping import stop_row
from mjcollect.guidance.way import Way, query_row

# Distances are in units of the scene, see `Scene.unit`.
ONE_TURN = 30.0  # Corners within this distance count as one turn.
CORNER_BRAKE = 0.9  # The law counts on this share of a_max to brake before corners.
WALL_SHARE = 0.9  # A stop may take this share of the distance to a bound.
RETURN_SECONDS = 1.0  # A body that was blown over a bound comes back in this time.
FREE_MARGIN = 0.1  # Clearance that the law keeps from boxes where it can.
BOX_MARGIN = 0.5  # Clearance below which the law approaches a box no further.


@compiled
def heading_row(
    way: Way, slot: float, a_max: float, chosen: int, q: Array, v: Array, heading: Array
) -> float:
    """Turns `heading` in time for a corner; returns the speed in m/s that corners ahead allow.

    Turning from direction u into w with a_max takes v |u - w| / a_max seconds and cuts the corner
    by v^2 |u - w|^2 / (8 a_max) metres if it begins half that time before, see `waypoints`.
    """
    if chosen < 0:
        return np.inf
    speed, limit, before, near = norm(v), np.inf, np.empty(3), ONE_TURN * way.unit[0]
    offset, bend = np.empty(3), np.empty(3)
    for k in range(3):
        offset[k], before[k] = way.points[chosen, k] - q[k], heading[k]
    ahead = norm(offset)
    for p in range(chosen, len(way.points) - 1):
        end, cut = p, way.cut[p]
        while end < len(way.points) - 2 and way.remaining[p] - way.remaining[end + 1] < near:
            end += 1
            cut = min(cut, way.cut[end])
        for k in range(3):
            bend[k] = way.next_direction[end, k] - before[k]
            before[k] = way.next_direction[p, k]
        turn = max(norm(bend), 1e-6)
        corner = math.sqrt(8 * cut * a_max) / turn
        begin = ahead - corner**2 * turn / a_max / 2 - speed * slot / 2
        soon = ahead <= speed * (speed * turn / a_max + slot) / 2
        if p == chosen and soon and speed <= 1.3 * corner:
            for k in range(3):
                offset[k] = way.points[p + 1, k] - q[k]
            unit(offset, heading)
            limit = min(limit, corner)
        else:
            limit = min(limit, math.sqrt(corner**2 + 2 * CORNER_BRAKE * a_max * max(begin, 0.0)))
        ahead += way.remaining[p] - way.remaining[p + 1]
    return limit


@compiled
def stopping(brake: float, distance: float, speed: float, slot: float) -> float:
    """Returns the speed at the slot's end from which `brake` m/s^2 still stops within `distance` m.

    It solves w^2 = 2 brake (distance - (speed + w) slot / 2) for w: the slot itself takes a part.
    """
    half = brake * slot / 2
    found = math.sqrt(max(half**2 + 2 * brake * distance - 2 * half * speed, 0.0)) - half
    if found < 2 * half:  # the stop then takes a whole slot, however slow
        found = min(found, distance / slot - speed / 2)
    return found


@compiled
def beside_boxes(world: World, w: int, q: Array, heading: Array) -> None:
    """Bends a heading along the nearest box where it leads into one close by."""
    offset, nearest = np.zeros(3), np.empty(3)
    nearest_box(tree_of(world, w), q, world.radius[w, 0] + BOX_MARGIN * world.unit[w, 0], offset)
    unit(offset, nearest)
    into = dot(heading, nearest)
    if into > 0.0:
        for k in range(3):
            offset[k] = heading[k] - into * nearest[k]
        unit(offset, heading)


@compiled
def within_bounds(world: World, w: int, q: Array, wanted: Array) -> None:
    """Takes from a velocity what cannot be stopped within bounds; leads back from outside."""
    bounds = world.bounds[w]
    # Braking against the velocity, wanted[k] lasts for this long and covers half of it.
    seconds = max(norm(wanted) / world.a_max[w, 0], 2 * world.slot)
    for k in range(3):
        slowest = -2 * WALL_SHARE / seconds * max(q[k] - bounds[0, k], 0.0)
        fastest = 2 * WALL_SHARE / seconds * max(bounds[1, k] - q[k], 0.0)
        if bounds[0, k] - q[k] > OUTSIDE:
            slowest += (bounds[0, k] - q[k]) / RETURN_SECONDS
        if q[k] - bounds[1, k] > OUTSIDE:
            fastest -= (q[k] - bounds[1, k]) / RETURN_SECONDS
        wanted[k] = min(max(wanted[k], slowest), fastest)


@compiled
def steer(world: World, w: int, v: Array, heading: Array, wanted: Array, a: Array) -> None:
    """Writes to `a` the feasible acceleration (m/s^2) towards `wanted` (m/s), overwriting that."""
    a_max = world.a_max[w, 0]
    for k in range(3):
        wanted[k] = (wanted[k] - v[k]) / world.slot
    along = dot(wanted, heading)
    if along > 0.0:
        # Motion across the path comes first: gaining speed can wait, braking cannot.
        for k in range(3):
            wanted[k] -= along * heading[k]
        into_ball(wanted, a_max)
        along = min(along, math.sqrt(max(a_max**2 - dot(wanted, wanted), 0.0)))
        for k in range(3):
            wanted[k] += along * heading[k]
    into_ball(wanted, a_max)
    for k in range(3):
        wanted[k] /= a_max
    project_row(world, w, v, wanted, a)


@compiled
def law_row(
    world: World, w: int, q: Array, v: Array, remaining: float, heading: Array, corner: float,
    action: Array,
) -> None:  # fmt: skip
    """Writes the law's action where `remaining` metres are left to fly; bends `heading` if it must.

    It flies along `heading` at the greatest speed from which full braking still ends in time: at
    the aim, at corners and before boxes; slower where it could not stop any more, at last braking.
    """
    a_max, slot = world.a_max[w, 0], world.slot
    beside_boxes(world, w, q, heading)
    closing = dot(v, heading)
    kept = world.radius[w, 0] + FREE_MARGIN * world.unit[w, 0]
    free = free_way(tree_of(world, w), kept, q, heading)
    speed = min(stopping(a_max, min(remaining, free), closing, slot), world.v_max[w, 0], corner)
    wanted = np.empty(3)
    for k in range(3):
        wanted[k] = heading[k] * speed
    within_bounds(world, w, q, wanted)
    steer(world, w, v, heading, wanted, action)
    for k in range(3):
        action[k] /= a_max


@compiled
def law_rows(
    world: World, way: Way, margin: float, which: Indices, goal: Array, q: Array, v: Array,
    action: Array,
) -> None:  # fmt: skip
    """Writes the actions (N, 3), in units of a_max, of the simulations `which` to a goal (3,).

    A stop may miss the aim by `margin` metres along the path.
    """
    heading, aim = np.empty(3), np.empty(3)
    for i in which:
        w = scene_of(world, i)
        left, chosen = query_row(way, q[i], heading)
        a_max, top, slot = world.a_max[w, 0], world.v_max[w, 0], world.slot
        corner = heading_row(way, slot, a_max, chosen, q[i], v[i], heading)
        remaining = max(left - margin, 0.0)
        if chosen == len(way.points) - 1:
            found = stop_row(way, goal, q[i], v[i], a_max, top, slot, aim)
            if found >= 0.0:
                remaining = found
                heading[:] = aim
        law_row(world, w, q[i], v[i], remaining, heading, corner, action[i])
