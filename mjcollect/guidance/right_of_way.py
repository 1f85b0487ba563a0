"""Lets UAVs of a fleet that stand in each other's way go on: who comes later in it makes room.

The shield keeps UAVs apart, see `flight.separation`, and in the open it leads them past each other.
In a narrow passage it can but stop them. A UAV that the shield has held up for a while asks the one
ahead to make room, if that one comes after it in the fleet. That one flies to the nearest place
off the other's path, out of the passage if it must, waits there until the other has passed, and
goes on. While it makes room it has the other's right of way towards third ones. So the first UAV of
a fleet gets through, then the second, and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.boxes import segment_gap
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled
from mjcollect.geometry.tree import Tree, first_member, next_leaf
from mjcollect.geometry.vectors import norm, unit
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.law import law_row
from mjcollect.guidance.way import Way, query_row

HELD_UP = 1.0  # s; a UAV that has been slow for so long because of the shield asks for room.
SLOW = 2.0  # It is slow below the speed that so many slots of full braking stop.
NEAR = 3.0  # The UAV asked is not farther away than so many times what UAVs keep apart.
ROOM = 1.1  # The one that makes room keeps so many times that distance from the other's path.
SIGHT = 100  # The other's path is looked at for so many times the distance that UAVs keep apart.
CELLS = 81  # Places are looked for on a lattice of so many points along each axis,
SPACINGS = (0.35, 0.7, 1.4)  # with such shares of the distance that UAVs keep apart between them.
LONGEST = 60  # Of a way to a place so many corners are flown.
PATIENCE = 60.0  # s after which one that waits flies on in any case
COLUMNS = 8 + 3 * LONGEST  # of the state, see `RightOfWay`


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


class Seen(NamedTuple):
    """Holds what N / M fleets know of their N flights.

    Attributes:
        world: scene constants. guidance: to every target. target: (N,) index of the current one.
        q, v: (N, 3) m and m/s. shielded: (N,) whether the shield changed the last command.
        home: (N,) whether the UAV is home for good.
    """

    world: World
    guidance: Sequence[Guidance]
    target: Indices
    q: Array
    v: Array
    shielded: Bools
    home: Bools


class RightOfWay:
    """Knows which UAVs of N / M fleets make room for which, and where they wait.

    Attributes:
        state: (N, COLUMNS), all that it knows; the other attributes are views of it.
        held_up: (N,) slots for which each was slow because of the shield. asked_by: (N,) row of
            the one that it makes room for, -1 for none. waited: (N,) slots since it was asked.
        block: (N, 3) m, where it was then. at, count: (N,) corner of its route that it heads for,
            and number of corners. route: (N, LONGEST, 3) m.
    """

    def __init__(self, count: int, uavs: int) -> None:
        """Prepares for `count` flights in fleets of `uavs`."""
        self.uavs = uavs
        self.load(np.zeros((count, COLUMNS)))
        self.asked_by[:] = -1
        self._points, self._way = np.empty((SIGHT, 3)), np.empty((CELLS**2, 3))
        self._came = np.empty(CELLS**3, dtype=np.int32)
        self._queue = np.empty(CELLS**3, dtype=np.int32)

    def load(self, state: Array) -> None:
        """Goes on from a state."""
        self.state = state
        self.held_up, self.asked_by, self.waited = state[:, 0], state[:, 1], state[:, 2]
        self.at, self.count, self.block = state[:, 3], state[:, 4], state[:, 5:8]
        self.route = state[:, 8:].reshape(len(state), LONGEST, 3)

    def reset(self, which: Indices) -> None:
        """Forgets the flights `which` (n,), which begin anew."""
        self.state[which] = 0.0
        self.asked_by[which] = -1
        self.asked_by[np.isin(self.asked_by, which)] = -1

    def actions(self, seen: Seen, action: Array) -> Array:
        """Returns the actions (N, 3) in units of a_max, changed for UAVs that make room.

        Call it once in every slot.

        Args:
            action: (N, 3) in world axes, as the pilots have it.
        """
        world, crawl = seen.world, SLOW * seen.world.a_max[:, 0] * seen.world.slot
        slow = np.linalg.norm(seen.v, axis=1) < crawl
        # Going to and fro before each other, not every one of its commands is changed.
        self.held_up[:] = np.where(slow & ~seen.home, self.held_up + seen.shielded, 0)
        for row in np.flatnonzero(self.asked_by >= 0).tolist():
            self._release(seen, row)
        stuck = np.flatnonzero(self.held_up * world.slot >= HELD_UP - 1e-9).tolist()
        for row in sorted(stuck, key=self._rank):
            self._ask(seen, row)
        action = action.copy()
        for row in np.flatnonzero(self.asked_by >= 0).tolist():
            self.at[row] = follow_row(
                world, scene_of(world, row), seen.q[row], seen.v[row], self.route[row],
                int(self.at[row]), int(self.count[row]), action[row],
            )  # fmt: skip
        return action

    def _rank(self, row: int) -> tuple[int, int]:
        """Returns what says who makes room for whom: the row served, and how indirectly."""
        for depth in range(self.uavs):
            if self.asked_by[row] < 0:
                return int(row), depth
            row = int(self.asked_by[row])
        return int(row), self.uavs

    def _fleet(self, row: int) -> list[int]:
        """Returns the other rows of a row's fleet."""
        first = row - row % self.uavs
        return [i for i in range(first, first + self.uavs) if i != row]

    def _path(self, seen: Seen, row: int) -> Array:
        """Returns points (P, 3) of the path that a UAV means to fly next."""
        if self.asked_by[row] >= 0:
            rest = self.route[row, int(self.at[row]) : int(self.count[row])]
            return np.concatenate([seen.q[row : row + 1], rest])
        guide = seen.guidance[int(seen.target[row])]
        stride = float(seen.world.apart[scene_of(seen.world, row), 0])
        count = path_ahead(guide.way, seen.q[row], guide.goal, stride, self._points)
        return self._points[:count].copy()

    def _release(self, seen: Seen, row: int) -> None:
        """Ends the wait of a UAV once the other has passed."""
        self.waited[row] += 1
        other = int(self.asked_by[row])
        path = self._path(seen, other)
        apart = seen.world.apart[scene_of(seen.world, row), 0]
        passed = all(
            gap_to_path(point, path, len(path)) >= apart for point in (self.block[row], seen.q[row])
        )
        late = self.waited[row] * seen.world.slot > PATIENCE
        if passed or late or seen.home[other]:
            self.asked_by[row] = -1

    def _ask(self, seen: Seen, row: int) -> None:
        """Asks whoever is in the way of a UAV to make room."""
        self.held_up[row] = 0  # It asks anew after as long a time.
        world, path = seen.world, self._path(seen, row)
        apart = float(world.apart[scene_of(world, row), 0])
        others = self._fleet(row)
        gaps = np.linalg.norm(seen.q[others] - seen.q[row], axis=1).tolist()
        for gap, other in sorted(zip(gaps, others, strict=True)):
            in_way = gap_to_path(seen.q[other], path, len(path)) < ROOM * apart
            if gap > NEAR * apart or not in_way:
                continue
            if seen.home[other] or self._rank(other) < self._rank(row):
                continue
            if self.asked_by[other] == row or self._make_room(seen, other, row, path):
                return
            # A UAV that cannot get out of the way, as in a dead end, goes first.
            if self._make_room(seen, row, other, self._path(seen, other)):
                return

    def _make_room(self, seen: Seen, row: int, other: int, path: Array) -> bool:
        """Sends a UAV off the path (P, 3) of another one; returns whether there is such a place."""
        world, w = seen.world, scene_of(seen.world, row)
        fleet = self._fleet(row)
        rests = [i for i in fleet if seen.home[i] or i == other]
        waits = [self.route[i, int(self.count[i]) - 1] for i in fleet if self.asked_by[i] >= 0]
        keep_off = np.concatenate([seen.q[rests], np.reshape(waits, (-1, 3))])
        for spacing in SPACINGS:
            count = way_to_room(
                world, w, seen.q[row], path, len(path), keep_off,
                spacing * float(world.apart[w, 0]), self._came, self._queue, self._way,
            )  # fmt: skip
            if count > 0:
                tree, reach = tree_of(world, w), float(world.radius[w, 0])
                count = min(straightened(tree, reach, seen.q[row], self._way, count), LONGEST)
                self.route[row, :count], self.count[row] = self._way[:count], count
                self.at[row] = self.waited[row] = 0
                self.asked_by[row], self.block[row] = other, seen.q[row]
                if self.asked_by[other] == row:
                    self.asked_by[other] = -1
                return True
        return False
