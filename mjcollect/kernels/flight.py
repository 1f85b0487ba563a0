"""The rules of flight, see `mjcollect.flight`; and where episodes start."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mjcollect.compiled import Array, Bools, Indices, compiled
from mjcollect.kernels.boxes import segment_gap
from mjcollect.kernels.vectors import dot, from_ball, into_ball, norm

if TYPE_CHECKING:
    from mjcollect.flight import World


@compiled
def scene_of(world: World, i: int) -> int:
    """Index of simulation i's scene in the world."""
    return i if len(world.bounds) > 1 else 0


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
def project(world: World, v: Array, action: Array, a: Array) -> None:
    """See `flight.project`."""
    for i in range(len(v)):
        project_row(world, scene_of(world, i), v[i], action[i], a[i])


@compiled
def arrests_row(world: World, w: int, q: Array, v: Array, goal: Array, tolerance: float) -> bool:
    """See `flight.arrests`."""
    coasted = world.slot * (world.substeps - 1) / (2 * world.substeps)
    square = 0.0
    for k in range(3):
        square += (q[k] + v[k] * coasted - goal[k]) ** 2
    return bool(norm(v) <= world.a_max[w, 0] * world.slot and math.sqrt(square) <= tolerance)


@compiled
def command(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array,
    a: Array, stop: Bools,
) -> None:  # fmt: skip
    """See `flight.command`."""
    for i in range(len(v)):
        w = scene_of(world, i)
        stop[i] = arrests_row(world, w, q[i], v[i], goal[i], tolerance[i])
        if stop[i]:
            for k in range(3):
                a[i, k] = -v[i, k] / world.slot
        else:
            project_row(world, w, v[i], action[i], a[i])


@compiled
def sweep(world: World, w: int, path: Array, touch: Bools) -> None:
    """Add to `touch` (n,) the pieces of a path (n + 1, 3) that come within the radius of a box."""
    radius, boxes = world.radius[w, 0], world.boxes[w]
    low, high = path[0].copy(), path[0].copy()
    for s in range(1, len(path)):
        for k in range(3):
            low[k], high[k] = min(low[k], path[s, k]), max(high[k], path[s, k])
    for b in range(len(boxes)):  # by index: iteration forgets that boxes are contiguous
        near = True
        for k in range(3):
            near = near and low[k] - radius <= boxes[b, 1, k] and boxes[b, 0, k] <= high[k] + radius
        if near:
            for s in range(len(touch)):
                touch[s] = touch[s] or segment_gap(path[s], path[s + 1], boxes[b]) < radius


@compiled
def is_outside(bounds: Array, point: Array, tolerance: float) -> bool:
    """Whether a point lies outside the bounds (2, 3) by more than `tolerance`."""
    for k in range(3):
        if point[k] < bounds[0, k] - tolerance or point[k] > bounds[1, k] + tolerance:
            return True
    return False


@compiled
def events(world: World, path: Array, tolerance: float, touch: Bools, outside: Bools) -> None:
    """Contact and leaving the bounds, each (N, n), on paths (N, n + 1, 3) from the slot's start.

    `touch` comes in as what was sensed. See `flight.contacts`, `flight.leaves_bounds`.
    """
    for i in range(len(path)):
        w = scene_of(world, i)
        sweep(world, w, path[i], touch[i])
        for s in range(touch.shape[1]):
            outside[i, s] = is_outside(world.bounds[w], path[i, s + 1], tolerance)


@compiled
def room_to_brake(
    bounds: Array, boxes: Array, a_max: float, slot: float, radius: float, q: Array, v: Array
) -> bool:
    """Whether a body is in bounds and clear of boxes, and stays so while it brakes."""
    ahead, speed = np.empty(3), norm(v)
    # Braking in whole slots takes up to an eighth of a_max slot^2 more.
    reach = speed / (2 * a_max) + a_max * slot**2 / 8 / max(speed, 1e-9)
    for k in range(3):
        ahead[k] = q[k] + v[k] * reach
    if is_outside(bounds, q, 0.0) or is_outside(bounds, ahead, 0.0):
        return False
    free = True
    for b in range(len(boxes)):  # by index: iteration forgets that boxes are contiguous
        free = free and segment_gap(q, ahead, boxes[b]) >= radius
    return free


@compiled
def try_starts(
    bounds: Array, boxes: Array, a_max: float, slot: float, radius: float, middle: Array,
    along: Array, half: Array, top: Array, kind: Indices, where: Array, where_share: Array,
    speed: Array, speed_share: Array, way_q: Array, way_v: Array, todo: Indices, q: Array,
    v: Array, wanting: Bools,
) -> None:  # fmt: skip
    """Starts of each `kind` (N,) in the episodes `todo`, which go on `wanting` if one does not fit.

    A kind's positions fill the ellipsoid round `middle` (kinds, 3) with axis `along` (3,) and half
    widths `half` (kinds, 2) along and across it; its velocities the ball of radius `top` (kinds,).
    Beyond the last kind a start is as given, `way_q`, `way_v` (n, 3).
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
        wanting[i] = not room_to_brake(bounds, boxes, a_max, slot, radius, q[i], v[i])
