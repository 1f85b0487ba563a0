"""The guidance law, which learns nothing: along the way as fast as it can still be flown.

The yardstick of what is learned, its prior, and the source of demonstrations. After each of its
slots full braking leads to rest without touching anything, so a flight that begins at rest and
keeps to the law never does.
"""

from __future__ import annotations

import math

import numpy as np

from mjcollect.flight.projection import project_row
from mjcollect.flight.shield import OUTSIDE
from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.boxes import box_offset, free_way
from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.geometry.vectors import dot, into_ball, norm, unit
from mjcollect.guidance.stopping import stop_row
from mjcollect.guidance.way import Way, query_row

ONE_TURN = 30.0  # metres within which corners count as one turn
CORNER_BRAKE = 0.9  # share of a_max that the guidance law counts on before corners
WALL_SHARE = 0.9  # of the room to a bound that a stop may take
RETURN_SECONDS = 1.0  # in which a body that was blown over a bound comes back
FREE_ROOM = 0.1  # metres beyond the body's radius that the law keeps from boxes where it can
BOX_ROOM = 0.5  # metres beyond the body's radius from which it does not approach a box


@compiled
def heading_row(
    way: Way, slot: float, a_max: float, chosen: int, q: Array, v: Array, heading: Array
) -> float:
    """Turn `heading` in time for a corner; the speed in m/s at which those ahead can be flown.

    Turning from direction u into w with a_max takes v |u - w| / a_max seconds and cuts the corner
    by v^2 |u - w|^2 / (8 a_max) metres if it begins half that time before. See `Waypoints`.
    """
    if chosen < 0:
        return np.inf
    speed, limit, before = norm(v), np.inf, np.empty(3)
    gap, bend = np.empty(3), np.empty(3)
    for k in range(3):
        gap[k], before[k] = way.points[chosen, k] - q[k], heading[k]
    ahead = norm(gap)
    for p in range(chosen, len(way.points) - 1):
        end, cut = p, way.cut[p]
        while end < len(way.points) - 2 and way.remaining[p] - way.remaining[end + 1] < ONE_TURN:
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
                gap[k] = way.points[p + 1, k] - q[k]
            unit(gap, heading)
            limit = min(limit, corner)
        else:
            limit = min(limit, math.sqrt(corner**2 + 2 * CORNER_BRAKE * a_max * max(begin, 0.0)))
        ahead += way.remaining[p] - way.remaining[p + 1]
    return limit


@compiled
def stopping(brake: float, room: float, speed: float, slot: float) -> float:
    """Speed at the slot's end from which `brake` m/s^2 still stops within `room` metres.

    Solves w^2 = 2 brake (room - (speed + w) slot / 2) for w: what the slot itself takes is gone.
    """
    half = brake * slot / 2
    found = math.sqrt(max(half**2 + 2 * brake * room - 2 * half * speed, 0.0)) - half
    if found < 2 * half:  # then the stop takes a slot, however slow
        found = min(found, room / slot - speed / 2)
    return found


@compiled
def beside_boxes(world: World, w: int, q: Array, heading: Array) -> None:
    """Bend a heading along the nearest box where it leads into one close by."""
    boxes = world.boxes[w]
    offset, nearest, gap = np.empty(3), np.zeros(3), world.radius[w, 0] + BOX_ROOM
    for b in range(len(boxes)):
        this = box_offset(q, boxes[b], offset)
        if this < gap:
            gap = this
            unit(offset, nearest)
    into = dot(heading, nearest)
    if into > 0.0:
        for k in range(3):
            offset[k] = heading[k] - into * nearest[k]
        unit(offset, heading)


@compiled
def within_bounds(world: World, w: int, q: Array, wanted: Array) -> None:
    """Take from a wanted velocity what cannot be stopped within the bounds; outside, come back."""
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
    """Feasible acceleration `a` in m/s^2 towards a wanted velocity, which it overwrites."""
    a_max = world.a_max[w, 0]
    for k in range(3):
        wanted[k] = (wanted[k] - v[k]) / world.slot
    along = dot(wanted, heading)
    if along > 0.0:
        # Across the path first: speed can wait, as braking cannot.
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
    world: World, w: int, q: Array, v: Array, room: float, heading: Array, corner: float,
    action: Array,
) -> None:  # fmt: skip
    """Action of the law where `room` metres are left to fly; bends `heading` where it must.

    Along `heading` at the greatest speed from which full braking still ends in time, at the aim,
    at corners and before boxes; slower where it could not stop any more, at last full braking.
    """
    a_max, slot = world.a_max[w, 0], world.slot
    beside_boxes(world, w, q, heading)
    closing = dot(v, heading)
    free = free_way(world.boxes[w], world.radius[w, 0] + FREE_ROOM, q, heading)
    speed = min(stopping(a_max, min(room, free), closing, slot), world.v_max[w, 0], corner)
    wanted = np.empty(3)
    for k in range(3):
        wanted[k] = heading[k] * speed
    within_bounds(world, w, q, wanted)
    steer(world, w, v, heading, wanted, action)
    for k in range(3):
        action[k] /= a_max


@compiled
def law_rows(
    world: World, way: Way, slack: float, which: Indices, goal: Array, q: Array, v: Array,
    action: Array,
) -> None:  # fmt: skip
    """Actions (N, 3) of the simulations `which` towards a goal (3,)."""
    heading, aim = np.empty(3), np.empty(3)
    for i in which:
        w = scene_of(world, i)
        left, chosen = query_row(way, q[i], heading)
        a_max, top, slot = world.a_max[w, 0], world.v_max[w, 0], world.slot
        corner = heading_row(way, slot, a_max, chosen, q[i], v[i], heading)
        room = max(left - slack, 0.0)
        if chosen == len(way.points) - 1:
            found = stop_row(way, goal, q[i], v[i], a_max, top, slot, aim)
            if found >= 0.0:
                room = found
                heading[:] = aim
        law_row(world, w, q[i], v[i], room, heading, corner, action[i])
