"""Finds the way to the nearest place off another UAV's path, on a lattice, and flies it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.world import World, tree_of
from mjcollect.geometry.boxes import segment_gap
from mjcollect.geometry.compiled import Array, compiled
from mjcollect.geometry.tree import Tree, first_member, next_leaf
from mjcollect.geometry.vectors import norm, unit
from mjcollect.guidance.law import law_row
from mjcollect.guidance.way import Way, query_row

ROOM = 1.1  # The one that makes room keeps so many times what UAVs keep apart from a path.
CELLS = 81  # Places are looked for on a lattice of so many points along each axis,
SPACINGS = (0.35, 0.7, 1.4)  # with such shares of the distance that UAVs keep apart between them.


@compiled
def path_ahead(way: Way, q: Array, goal: Array, stride: float, path: Array) -> int:
    """Writes points along the guidance from q to a goal (3,) to `path` (..., 3); returns how many.

    They are `stride` m from each other.
    """
    direction, count = np.empty(3), 1
    path[0] = q
    while count < len(path):
        left, _ = query_row(way, path[count - 1], direction)
        if not left > stride:
            path[count] = goal
            return count + 1
        for k in range(3):
            path[count, k] = path[count - 1, k] + stride * direction[k]
        count += 1
    return count


@compiled
def gap_to_path(point: Array, path: Array, count: int) -> float:
    """Returns the distance (m) of a point (3,) from `count` points of a polyline (..., 3)."""
    least = np.inf
    for p in range(max(count - 1, 1)):
        end, along, square, gap = min(p + 1, count - 1), 0.0, 0.0, 0.0
        for k in range(3):
            along += (point[k] - path[p, k]) * (path[end, k] - path[p, k])
            square += (path[end, k] - path[p, k]) ** 2
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        for k in range(3):
            gap += (point[k] - path[p, k] - share * (path[end, k] - path[p, k])) ** 2
        least = min(least, gap)
    return float(np.sqrt(least))


@compiled
def is_clear(tree: Tree, reach: float, start: Array, end: Array) -> bool:
    """Returns whether a piece from `start` to `end` (3,) keeps `reach` m from every box."""
    low, high = np.empty(3), np.empty(3)
    for k in range(3):
        low[k], high[k] = min(start[k], end[k]), max(start[k], end[k])
    leaf = next_leaf(tree, -1, low, high, reach)
    while leaf >= 0:
        for m in range(first_member(tree, leaf), first_member(tree, leaf + 1)):
            if segment_gap(start, end, tree.boxes[tree.members[m]]) < reach:
                return False
        leaf = next_leaf(tree, leaf, low, high, reach)
    return True


@compiled
def is_open(world: World, w: int, start: Array, end: Array, others: Array, apart: float) -> bool:
    """Returns whether one may fly straight from `start` to `end` (3,), a short way.

    It must lead neither out of bounds, nor too near to a box, nor nearer than `apart` m to others
    (B, 3) that do not move, unless away from them.
    """
    for k in range(3):
        if not world.bounds[w, 0, k] <= end[k] <= world.bounds[w, 1, k]:
            return False
    for b in range(len(others)):
        before = after = 0.0
        for k in range(3):
            before += (start[k] - others[b, k]) ** 2
            after += (end[k] - others[b, k]) ** 2
        if after < apart**2 and after < before:
            return False
    return is_clear(tree_of(world, w), world.radius[w, 0], start, end)


@compiled
def way_to_room(
    world: World, w: int, start: Array, path: Array, count: int, others: Array, spacing: float,
    came: NDArray[np.int32], queue: NDArray[np.int32], route: Array,
) -> int:  # fmt: skip
    """Writes the way from `start` (3,) to the nearest place off a path to `route` (..., 3).

    Nearest is meant along a lattice of `spacing` m round the start, searched breadth first.

    Args:
        path: (..., 3), `count` points of a polyline (m). others: (B, 3) m, to keep apart from.
        came, queue: (CELLS^3,) scratch.

    Returns:
        The number of points of the way after the start, 0 if there is no such place.
    """
    apart, half = world.apart[w, 0], CELLS // 2
    room = ROOM * apart
    stride = (CELLS * CELLS, CELLS, 1)
    came[:] = -1
    first = half * (stride[0] + stride[1] + stride[2])
    came[first], queue[0] = first, first
    head, tail, here, there = 0, 1, np.empty(3), np.empty(3)
    while head < tail:
        cell = queue[head]
        head += 1
        for k in range(3):
            here[k] = start[k] + (cell // stride[k] % CELLS - half) * spacing
        free = gap_to_path(here, path, count) >= room
        for b in range(len(others)):
            gap = 0.0
            for k in range(3):
                gap += (here[k] - others[b, k]) ** 2
            free = free and gap >= room**2
        if free:
            length, at = 0, cell
            while at != first:
                length, at = length + 1, came[at]
            if length > len(route):
                return 0
            at = cell
            for p in range(length - 1, -1, -1):
                for k in range(3):
                    route[p, k] = start[k] + (at // stride[k] % CELLS - half) * spacing
                at = came[at]
            return length
        for k in range(3):
            index = cell // stride[k] % CELLS
            for step in (-1, 1):
                if not 0 <= index + step < CELLS:
                    continue
                other = cell + step * stride[k]
                if came[other] >= 0:
                    continue
                there[:] = here
                there[k] += step * spacing
                if is_open(world, w, here, there, others, apart):
                    came[other], queue[tail] = cell, other
                    tail += 1
    return 0


@compiled
def straightened(tree: Tree, reach: float, start: Array, route: Array, count: int) -> int:
    """Leaves out of `route` (..., 3) the points that a straight way may pass by; returns the rest.

    Args:
        start: (3,) from where the way leads over `count` points.
    """
    kept, at, p = 0, start.copy(), 0
    while p < count:
        last = p
        for far in range(count - 1, p, -1):
            if is_clear(tree, reach, at, route[far]):
                last = far
                break
        at[:] = route[last]
        route[kept] = at
        kept, p = kept + 1, last + 1
    return kept


@compiled
def follow_row(
    world: World, w: int, q: Array, v: Array, route: Array, at: int, count: int, action: Array
) -> int:
    """Writes the action (3,), in units of a_max, along a route; returns the corner it heads for.

    It stops at every corner.
    """
    heading, close = np.empty(3), world.apart[w, 0] * 0.05
    left = 0.0
    while True:
        for k in range(3):
            heading[k] = route[at, k] - q[k]
        left = norm(heading)
        if left > close or norm(v) > world.a_max[w, 0] * world.slot or at + 1 >= count:
            break
        at += 1
    unit(heading, heading)
    law_row(world, w, q, v, left, heading, np.inf, action)
    return at


class Rooms:
    """Searches ways to room, with the memory that this takes."""

    def __init__(self) -> None:
        """Prepares the memory."""
        self._way = np.empty((CELLS**2, 3))
        self._came = np.empty(CELLS**3, dtype=np.int32)
        self._queue = np.empty(CELLS**3, dtype=np.int32)

    def route(self, world: World, w: int, start: Array, path: Array, keep_off: Array) -> Array:
        """Returns the corners (n, 3) of the way from `start` (3,) to the nearest place off a path.

        There are none if there is no such place, or if the start is one.

        Args:
            world: its scene `w` counts. path: (P, 3) m. keep_off: (B, 3) m, others that rest.
        """
        tree, reach = tree_of(world, w), float(world.radius[w, 0])
        for spacing in SPACINGS:
            count = way_to_room(
                world, w, start, path, len(path), keep_off,
                spacing * float(world.apart[w, 0]), self._came, self._queue, self._way,
            )  # fmt: skip
            if count > 0:
                break
        return self._way[: straightened(tree, reach, start, self._way, count)].copy()
