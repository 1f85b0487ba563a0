"""The guidance law, which learns nothing: along the way as fast as it can still be flown.

The yardstick of what is learned, its prior, and the source of demonstrations.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mjcollect.compiled import Array, compiled
from mjcollect.kernels.boxes import box_offset, free_way
from mjcollect.kernels.flight import project_row
from mjcollect.kernels.vectors import dot, into_ball, norm, unit

if TYPE_CHECKING:
    from mjcollect.flight import World
    from mjcollect.guidance import Way

ONE_TURN = 30.0  # metres within which corners count as one turn
CORNER_BRAKE = 0.9  # share of a_max that the guidance law counts on before corners
WALL_SHARE = 0.2  # the same towards a bound, at least
FREE_ROOM = 0.1  # metres beyond the body's radius that the law's straight way keeps from boxes
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
        while end < len(way.points) - 2 and way.rest[p] - way.rest[end + 1] < ONE_TURN:
            end += 1
            cut = min(cut, way.cut[end])
        for k in range(3):
            bend[k] = way.onward[end, k] - before[k]
            before[k] = way.onward[p, k]
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
        ahead += way.rest[p] - way.rest[p + 1]
    return limit


@compiled
def stopping(brake: float, room: float, speed: float, slot: float) -> float:
    """Speed at the slot's end from which `brake` m/s^2 still stops within `room` metres.

    Solves w^2 = 2 brake (room - (speed + w) slot / 2) for w: what the slot itself takes is gone.
    """
    half = brake * slot / 2
    return math.sqrt(max(half**2 + 2 * brake * room - 2 * half * speed, 0.0)) - half


@compiled
def hold_back(world: World, w: int, q: Array, v: Array, wanted: Array) -> None:
    """Take from a wanted velocity what leads into the nearest box or out of bounds."""
    boxes, radius, a_max = world.boxes[w], world.radius[w, 0], world.a_max[w, 0]
    offset, nearest, gap = np.empty(3), np.zeros(3), np.inf
    for b in range(len(boxes)):
        this = box_offset(q, boxes[b], offset)
        if this < gap:
            gap = this
            for k in range(3):
                nearest[k] = offset[k] / max(this, 1e-9)
    excess = dot(wanted, nearest) - max(gap - radius - BOX_ROOM, 0.0) / world.slot
    if excess > 0.0:
        for k in range(3):
            wanted[k] -= excess * nearest[k]
    speed = max(norm(v), 1e-9)
    for k in range(3):
        # Braking against the velocity, each axis gets its share of a_max.
        brake = a_max * max(abs(v[k]) / speed, WALL_SHARE)
        low, high = q[k] - world.bounds[w, 0, k], world.bounds[w, 1, k] - q[k]
        slowest = -stopping(brake, max(low, 0.0), -v[k], world.slot)
        fastest = stopping(brake, max(high, 0.0), v[k], world.slot)
        wanted[k] = min(max(wanted[k], slowest), fastest)


@compiled
def law_row(
    world: World, w: int, q: Array, v: Array, room: float, heading: Array, corner: float,
    action: Array,
) -> None:  # fmt: skip
    """Action of the law where `room` metres are left to fly.

    Along `heading` at the greatest speed from which full braking still ends in time, at the aim,
    at corners and before boxes.
    """
    a_max, slot = world.a_max[w, 0], world.slot
    closing = dot(v, heading)
    speed = min(stopping(a_max, room, closing, slot), world.v_max[w, 0], corner)
    free = free_way(world.boxes[w], world.radius[w, 0] + FREE_ROOM, q, heading)
    speed = min(speed, stopping(a_max, free, closing, slot))
    wanted = np.empty(3)
    for k in range(3):
        wanted[k] = heading[k] * speed
    hold_back(world, w, q, v, wanted)
    # Across the path first: a body that keeps to it may brake late, not the other way round.
    for k in range(3):
        wanted[k] = (wanted[k] - v[k]) / slot
    along = dot(wanted, heading)
    for k in range(3):
        wanted[k] -= along * heading[k]
    into_ball(wanted, a_max)
    left = math.sqrt(max(a_max**2 - dot(wanted, wanted), 0.0))
    along = min(max(along, -left), left)
    for k in range(3):
        wanted[k] = (wanted[k] + along * heading[k]) / a_max
    project_row(world, w, v, wanted, action)
    for k in range(3):
        action[k] /= a_max
