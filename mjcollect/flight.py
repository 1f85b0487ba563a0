"""The rules of flight, written once and vectorised over a leading batch axis of N simulations.

The single dm-control task (N = 1) and the batched environment call the same functions, so that
both fly by the same rules bit for bit. Accelerations are commands held for one slot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry import EMPTY_BOX, Array, segment_box_distance
from mjcollect.scene import Scene

Bools = NDArray[np.bool_]

BOUNDS_TOLERANCE = 1e-6  # metres; the body's centre may lie on the bounds


@dataclass(frozen=True)
class World:
    """Scene constants stacked over simulations. The leading axis is N, or 1 where all share one.

    Attributes:
        bounds: (N, 2, 3) m. boxes: (N, M, 2, 3) m, padded with boxes infinitely far away.
        v_max, a_max, radius: (N, 1) in m/s, m/s^2, m.
        slot, step: seconds of a slot and of a physics step, the same for all simulations.
        substeps: physics steps in a slot, n.
    """

    bounds: Array
    boxes: Array
    v_max: Array
    a_max: Array
    radius: Array
    slot: float
    step: float
    substeps: int

    @classmethod
    def stack(cls, scenes: Sequence[Scene]) -> World:
        """Stack one scene per simulation, or a single one shared by all.

        Raises:
            ValueError: scenes disagree on `slot` or `physics_step`.
        """
        first = scenes[0]
        for scene in scenes:
            if (scene.slot, scene.physics_step) != (first.slot, first.physics_step):
                raise ValueError(
                    f"scenes {first.name!r}, {scene.name!r}: slot {first.slot} and {scene.slot}, "
                    f"physics_step {first.physics_step} and {scene.physics_step}: simulations that "
                    "run side by side need the same slot and physics step"
                )
        most = max(len(scene.obstacles) for scene in scenes)
        boxes = np.broadcast_to(EMPTY_BOX, (len(scenes), max(most, 1), 2, 3)).copy()
        for index, scene in enumerate(scenes):
            boxes[index, : len(scene.obstacles)] = scene.obstacles

        def column(field: str) -> Array:
            return np.array([[getattr(scene, field)] for scene in scenes])

        return cls(
            bounds=np.stack([scene.bounds for scene in scenes]),
            boxes=boxes,
            v_max=column("v_max"),
            a_max=column("a_max"),
            radius=column("uav_radius"),
            slot=first.slot,
            step=first.physics_step,
            substeps=first.substeps,
        )


def project(world: World, v: Array, action: Array) -> Array:
    """Feasible acceleration nearest in spirit to a raw action, eq. (2)-(3).

    The action is scaled into the a_max ball, then v + a slot into the v_max ball. Because
    |v| <= v_max, the second step only shortens the change of velocity: both limits hold.

    Args:
        v: (N, 3) m/s, |v| <= v_max. action: (N, 3), 1 = a_max along an axis; not finite counts 0.

    Returns:
        (N, 3) accelerations in m/s^2.
    """
    action = np.nan_to_num(np.asarray(action, dtype=np.float64), posinf=0.0, neginf=0.0)
    action = np.clip(action, -1e100, 1e100)  # its square must not overflow
    a = _into_ball(action * world.a_max, world.a_max)
    return (_into_ball(v + a * world.slot, world.v_max) - v) / world.slot


def _into_ball(vector: Array, radius: Array) -> Array:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.where(norm > radius, radius / np.maximum(norm, 1e-300), 1.0)


def resting_point(world: World, q: Array, v: Array) -> Array:
    """Where the body (N, 3) rests after one slot of a = -v / slot in n semi-implicit steps."""
    n = world.substeps
    return q + v * (world.slot * (n - 1) / (2 * n))


def arrests(world: World, q: Array, v: Array, goal: Array, tolerance: Array) -> Bools:
    """Collection rule, eq. (5): whether this slot is flown as a = -v / slot to stop at the goal.

    True where one slot can stop the body and the stop lies within `tolerance` of the goal.

    Args:
        q, v, goal: (N, 3). tolerance: (N,) m.

    Returns:
        (N,) booleans.
    """
    slow = np.linalg.norm(v, axis=-1) <= world.a_max[..., 0] * world.slot
    miss = np.linalg.norm(resting_point(world, q, v) - goal, axis=-1)
    return np.asarray(slow & (miss <= tolerance))


def command(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array
) -> tuple[Array, Bools]:
    """Acceleration (N, 3) for the next slot, and where (N,) it is the stop that collects."""
    stop = arrests(world, q, v, goal, tolerance)
    return np.where(stop[:, None], -v / world.slot, project(world, v, action)), stop


def contacts(world: World, path: Array, sensed: Bools) -> Bools:
    """Which physics steps touch an obstacle: sensed by MuJoCo, or swept over by the body.

    The sensor describes the state before a step and can miss a graze between two states; the
    sweep is the exact distance of the straight piece between two states to every box.

    Args:
        path: (N, n + 1, 3), positions at the slot's start and after each physics step.
        sensed: (N, n), the contact sensor after each step.

    Returns:
        (N, n) booleans.
    """
    touch = sensed.copy()
    radius = world.radius[:, None]  # (N or 1, 1, 1)
    low = path.min(axis=1)[:, None, :] - radius
    high = path.max(axis=1)[:, None, :] + radius
    near = np.all((world.boxes[:, :, 0] <= high) & (world.boxes[:, :, 1] >= low), axis=-1)
    sims, boxes = np.nonzero(near)
    if len(sims):
        shared = len(world.boxes) == 1
        box = world.boxes[np.zeros_like(sims) if shared else sims, boxes][:, None]
        distance = segment_box_distance(path[sims, :-1], path[sims, 1:], box)
        limit = np.broadcast_to(world.radius, (len(path), 1))[sims]
        np.logical_or.at(touch, sims, distance < limit)
    return touch


def leaves_bounds(world: World, path: Array) -> Bools:
    """Which positions (N, n, 3) lie outside the bounds, inclusive with 1e-6 m. Shape (N, n)."""
    low = world.bounds[:, None, 0] - BOUNDS_TOLERANCE
    high = world.bounds[:, None, 1] + BOUNDS_TOLERANCE
    return np.asarray(np.any((path < low) | (path > high), axis=-1))


@dataclass(frozen=True)
class Slot:
    """What happened in one slot, each (N,); `first_event` is n where nothing ended the flight.

    Attributes:
        contact, outside: the body touched a box; its centre left the bounds.
        arrived: it came to rest at its target without either.
        first_event: index of the first physics step with a contact or out of bounds.
    """

    contact: Bools
    outside: Bools
    arrived: Bools
    first_event: NDArray[np.int64]

    @property
    def crashed(self) -> Bools:
        """Contact or out of bounds."""
        return self.contact | self.outside


def judge(world: World, start: Array, path: Array, sensed: Bools, stop: Bools) -> Slot:
    """Judge a slot from its physics steps.

    Args:
        start: (N, 3) position at the slot's start. path: (N, n, 3) positions after each step.
        sensed: (N, n) contact sensor after each step. stop: (N,) whether it flew the stop.
    """
    touch = contacts(world, np.concatenate([start[:, None], path], axis=1), sensed)
    out = leaves_bounds(world, path)
    event = touch | out
    first = np.where(event.any(axis=1), event.argmax(axis=1), path.shape[1])
    contact, outside = np.any(touch, axis=1), np.any(out, axis=1)
    return Slot(contact, outside, stop & ~contact & ~outside, first)
