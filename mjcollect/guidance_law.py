"""The law with no learning: fly along the shortest path at a speed from which one can still stop.

The yardstick that a learned policy must beat, and the source of demonstrations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjcollect.flight import World, project
from mjcollect.geometry import Array, nearest_point_offset

BRAKE_SHARE = 0.8  # share of a_max counted on for braking along the path
WALL_SHARE = 0.4  # the same, towards the bounds
LOOK_AHEAD = (25.0, 60.0, 110.0)  # metres along the path where bends are looked for
BEND_TIME = 0.8  # seconds of full acceleration granted to fly a bend
MARGIN = 1.0  # metres beyond the body's radius kept from boxes
Query = Callable[[Array], tuple[Array, Array]]


def guidance_law(
    world: World, q: Array, v: Array, distance: Array, direction: Array, query: Query
) -> Array:
    """Actions (N, 3) of the law, in the unit ball.

    Args:
        q, v: (N, 3). distance: (N,), direction: (N, 3) of the shortest path.
        query: distance and direction elsewhere, to see bends ahead.
    """
    a, top = world.a_max[..., 0], world.v_max[..., 0]
    closing = np.sum(v * direction, axis=-1)
    speed = np.minimum(_stopping(BRAKE_SHARE * a, distance, closing, world.slot), top)
    for ahead in LOOK_AHEAD:
        _, there = query(q + direction * np.minimum(ahead, distance)[:, None])
        bend = np.sqrt(np.clip((1.0 - np.sum(direction * there, axis=-1)) / 2, 0.0, 1.0))
        corner = a * BEND_TIME / (2 * np.maximum(bend, 1e-6))
        speed = np.minimum(speed, np.sqrt(corner**2 + 2 * BRAKE_SHARE * a * ahead))
    free = _free_way(world, q, direction)
    speed = np.minimum(speed, _stopping(BRAKE_SHARE * a, free, closing, world.slot))
    wanted = _held_back(world, q, v, direction * speed[:, None])
    # Across the path first: a body that keeps to it may brake late, not the other way round.
    change = (wanted - v) / world.slot
    along = np.sum(change * direction, axis=-1, keepdims=True) * direction
    across = change - along
    size = np.linalg.norm(across, axis=-1, keepdims=True)
    across = across * np.minimum(1.0, world.a_max / np.maximum(size, 1e-9))
    left = np.sqrt(np.maximum(world.a_max**2 - np.sum(across**2, -1, keepdims=True), 0.0))
    size = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along * np.minimum(1.0, left / np.maximum(size, 1e-9))
    return np.asarray(project(world, v, (across + along) / world.a_max) / world.a_max)


def _stopping(brake: Array, room: Array, speed: Array, slot: float) -> Array:
    """Speed at the slot's end from which `brake` m/s^2 still stops within `room` metres.

    Solves w^2 = 2 brake (room - (speed + w) slot / 2) for w: what the slot itself takes is gone.
    """
    half = brake * slot / 2
    return np.asarray(
        np.sqrt(np.maximum(half**2 + 2 * brake * room - 2 * half * speed, 0.0)) - half
    )


def _free_way(world: World, q: Array, direction: Array) -> Array:
    """Metres (N,) along `direction` before the first box, grown by the body and a margin."""
    step = np.where(np.abs(direction) < 1e-9, 1e-9, direction)[:, None]
    grow = (world.radius + MARGIN)[..., None]
    one = (world.boxes[:, :, 0] - grow - q[:, None]) / step
    two = (world.boxes[:, :, 1] + grow - q[:, None]) / step
    enter = np.minimum(one, two).max(axis=-1)
    leave = np.maximum(one, two).min(axis=-1)
    # From inside the margin the way is free: only leaving it is wanted, see `_held_back`.
    hit = (enter <= leave) & (enter >= 0.0)
    return np.asarray(np.where(hit, enter, 1e6).min(axis=1))


def _held_back(world: World, q: Array, v: Array, wanted: Array) -> Array:
    """The wanted velocity (N, 3) without what leads into a near box or out of bounds."""
    offset = nearest_point_offset(q[:, None], world.boxes)
    gap = np.linalg.norm(offset, axis=-1)
    nearest = np.arange(len(q)), gap.argmin(axis=1)
    normal = offset[nearest] / np.maximum(gap[nearest], 1e-9)[:, None]
    room = np.maximum(gap[nearest] - world.radius[..., 0] - MARGIN / 2, 0.0)
    excess = np.maximum(np.sum(wanted * normal, axis=-1) - room / world.slot, 0.0)
    wanted = wanted - excess[:, None] * normal
    brake = WALL_SHARE * world.a_max
    lowest = -_stopping(brake, np.maximum(q - world.bounds[:, 0], 0.0), -v, world.slot)
    highest = _stopping(brake, np.maximum(world.bounds[:, 1] - q, 0.0), v, world.slot)
    return np.clip(wanted, lowest, highest)
