"""Judges a slot by contact with boxes and by leaving the bounds, eq. (6)-(8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.boxes import segment_gap
from mjcollect.geometry.compiled import Array, Bools, compiled, plain
from mjcollect.geometry.tree import first_member, next_leaf
from mjcollect.geometry.turns import is_near
from mjcollect.geometry.vectors import hull, norm

BOUNDS_TOLERANCE = 1e-6  # metres beyond the bounds that still count as inside
FORETOLD = 1e-3  # metres by which a slot's path may differ from what is foretold of it, far more
# than rounding; MuJoCo looks for contacts where a body may come that near a box.
# Disturbed flights may be so many metres beyond the bounds, since a corner may hold the depot.
MARGIN = 5.0


@dataclass(frozen=True)
class Slot:
    """Says what happened in one slot, each (N,).

    Attributes:
        contact, outside: whether the body touched a box; whether its centre left the bounds.
        arrived: whether it came to rest at its target without either.
        first_event: index of the first physics step with either, or n if there was none.
    """

    contact: Bools
    outside: Bools
    arrived: Bools
    first_event: NDArray[np.int64]

    @property
    def crashed(self) -> Bools:
        """Returns whether the body touched a box or left the bounds."""
        return self.contact | self.outside


@compiled
def sweep(world: World, w: int, path: Array, touch: Bools) -> None:
    """Adds to `touch` (n,) the pieces of a path (n + 1, 3) that come within the radius of a box."""
    radius, tree = world.radius[w, 0], tree_of(world, w)
    low, high = np.empty(3), np.empty(3)
    hull(path, len(path), low, high)
    leaf = next_leaf(tree, -1, low, high, radius)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            box = tree.boxes[tree.members[m]]
            if is_near(low, high, radius, box):
                for s in range(len(touch)):
                    touch[s] = touch[s] or segment_gap(path[s], path[s + 1], box) < radius
        leaf = next_leaf(tree, leaf, low, high, radius)


@compiled
def may_touch_rows(
    world: World, uavs: int, q: Array, v: Array, controls: Array, near: Bools
) -> None:
    """Writes to `near` (N,) whether a body may come near a box in a slot: if not, it surely cannot.

    Args:
        uavs: number of UAVs in a fleet, whose bodies may also come near each other.
        q, v: (N, 3) m and m/s. controls: (N, n, 3) m/s^2, acceleration in each physics step.
    """
    step, low, high, at, speed = world.step, np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(q)):
        w = scene_of(world, i)
        at[:], speed[:], low[:], high[:] = q[i], v[i], q[i], q[i]
        for s in range(controls.shape[1]):
            for k in range(3):
                speed[k] += controls[i, s, k] * step
                at[k] += speed[k] * step
                low[k], high[k] = min(low[k], at[k]), max(high[k], at[k])
        tree, reach, near[i] = tree_of(world, w), world.radius[w, 0] + FORETOLD, False
        leaf = next_leaf(tree, -1, low, high, reach)
        while leaf >= 0 and not near[i]:
            for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
                if is_near(low, high, reach, tree.boxes[tree.members[m]]):
                    near[i] = True
                    break
            leaf = next_leaf(tree, leaf, low, high, reach)
        for j in range(i - i % uavs, i):
            for k in range(3):
                at[k] = q[j, k] - q[i, k]
            met = (norm(v[i]) + norm(v[j]) + 2 * world.a_max[w, 0] * world.slot) * world.slot
            near[i] = near[i] or norm(at) < met + 2 * reach


@compiled
def is_outside(bounds: Array, point: Array, tolerance: float) -> bool:
    """Returns whether a point lies outside the bounds (2, 3) by more than `tolerance` metres."""
    for k in range(3):
        if point[k] < bounds[0, k] - tolerance or point[k] > bounds[1, k] + tolerance:
            return True
    return False


@compiled
def event_rows(world: World, path: Array, tolerance: float, touch: Bools, outside: Bools) -> None:
    """Compiled loop of `contacts` and `leaves_bounds` over N paths (n + 1, 3).

    `touch` (N, n) comes in as what was sensed; `outside` (N, n) is written.
    """
    for i in range(len(path)):
        w = scene_of(world, i)
        sweep(world, w, path[i], touch[i])
        for s in range(touch.shape[1]):
            outside[i, s] = is_outside(world.bounds[w], path[i, s + 1], tolerance)


def contacts(world: World, path: Array, sensed: Bools) -> Bools:
    """Returns which physics steps touch an obstacle: sensed by MuJoCo, or swept by the body.

    The sensor tells of the state before a step and can miss a graze between two states. The sweep
    is the exact distance between the straight piece from state to state and every box.

    Args:
        path: (N, n + 1, 3), positions at the slot's start and after each physics step.
        sensed: (N, n), MuJoCo's contact sensor after each step.

    Returns:
        (N, n) booleans.
    """
    return _events(world, path, sensed)[0]


def leaves_bounds(world: World, path: Array) -> Bools:
    """Returns which positions (N, n, 3) lie outside the bounds by more than 1e-6 m, (N, n)."""
    whole = np.concatenate([path[:, :1], path], axis=1)
    return _events(world, whole, np.zeros(path.shape[:2], dtype=bool))[1]


def _events(
    world: World, path: Array, sensed: Bools, margin: float = BOUNDS_TOLERANCE
) -> tuple[Bools, Bools]:
    """Returns `contacts`, and `leaves_bounds` by more than `margin` m, of paths (N, n + 1, 3)."""
    touch, outside = sensed.copy(), np.empty(sensed.shape, dtype=bool)
    event_rows(world, plain(path), margin, touch, outside)
    return touch, outside


def judge(
    world: World, start: Array, path: Array, sensed: Bools, stop: Bools,
    margin: float = BOUNDS_TOLERANCE,
) -> Slot:  # fmt: skip
    """Judges a slot from its physics steps.

    Args:
        start: (N, 3), positions at the slot's start. path: (N, n, 3), after each step.
        sensed: (N, n), contact sensor after each step. stop: (N,), whether it flew the stop.
        margin: metres beyond the bounds that are still inside.
    """
    whole = np.concatenate([start[:, None], path], axis=1)
    touch, out = _events(world, whole, sensed, margin)
    event = touch | out
    first = np.where(event.any(axis=1), event.argmax(axis=1), path.shape[1])
    contact, outside = np.any(touch, axis=1), np.any(out, axis=1)
    return Slot(contact, outside, stop & ~contact & ~outside, first)
