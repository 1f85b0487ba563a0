"""Lets UAVs of a fleet that stand in each other's way go on: who comes later in it makes room.

The shield keeps UAVs apart, see `flight.separation`, and in the open it leads them past each other.
In a narrow passage it can but stop them. A UAV that the shield has held up for a while asks the one
ahead to make room, if that one comes after it in the fleet. That one flies to the nearest place
off the other's path, out of the passage if it must, waits there until the other has passed, and
goes on. While it makes room it has the other's right of way towards third ones. So the first UAV of
a fleet gets through, then the second, and so on.

One that is home makes no room any more. So who would shut another's way there waits outside until
that one has passed or is home, see `landing`, and comes after it meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjcollect.flight.world import World, scene_of, tree_of
from mjcollect.geometry.compiled import Array, Bools, Indices
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.landing import Landing, landings
from mjcollect.guidance.room import ROOM, Rooms, follow_row, gap_to_path, is_clear, path_ahead
from mjcollect.guidance.way import query_row

HELD_UP = 1.0  # s; a UAV that has been slow for so long because of the shield asks for room.
SLOW = 2.0  # It is slow below the speed that so many slots of full braking stop.
NEAR = 3.0  # The UAV asked is not farther away than so many times what UAVs keep apart.
SIGHT = 100  # The other's path is looked at for so many times the distance that UAVs keep apart.
LONGEST = 60  # Of a way to a place so many corners are flown.
BACK = 0.2  # One is back where it left its way within such a share of what UAVs keep apart.
PATIENCE = 60.0  # s after which one that makes room flies on in any case
COLUMNS = 9 + 3 * LONGEST  # of the state, see `RightOfWay`


class Seen(NamedTuple):
    """Holds what N / M fleets know of their N flights.

    Attributes:
        world: scene constants. target: (N,) index of the current target.
        q, v: (N, 3) m and m/s. shielded: (N,) whether the shield changed the last command.
        home: (N,) whether the UAV is home for good.
    """

    world: World
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
            and number of corners. lands_after: (N,) row of the one for which it waits outside, its
            own while it comes back from there, -1 for none. route: (N, LONGEST, 3) m.
        kept_out: (N,) whether it must not land yet.
    """

    def __init__(
        self, guidance: Sequence[Guidance], first: Indices, last: Indices, uavs: int
    ) -> None:
        """Prepares for N flights in fleets of `uavs`.

        Args:
            guidance: to every target. first, last: (N,) index of each flight's first and last one.
        """
        self.uavs, self._guidance, self._first, self._last = uavs, guidance, first, last
        self.load(np.zeros((len(first), COLUMNS)))
        self.asked_by[:] = self.lands_after[:] = -1
        self.kept_out = np.zeros(len(first), dtype=bool)
        self._points, self._rooms = np.empty((SIGHT, 3)), Rooms()
        known: dict[tuple[int, ...], list[Landing | None]] = {}
        self._landings: list[Landing | None] = []
        for fleet in range(0, len(first), uavs):
            rows = range(fleet, fleet + uavs)
            key = tuple(first[fleet : fleet + uavs].tolist())  # Many fleets have the same courses.
            if key not in known:
                known[key] = landings([guidance[first[i] : last[i] + 1] for i in rows])
            self._landings += known[key]

    def load(self, state: Array) -> None:
        """Goes on from a state."""
        self.state = state
        self.held_up, self.asked_by, self.waited = state[:, 0], state[:, 1], state[:, 2]
        self.at, self.count, self.block = state[:, 3], state[:, 4], state[:, 5:8]
        self.lands_after = state[:, 8]
        self.route = state[:, 9:].reshape(len(state), LONGEST, 3)

    @property
    def gives_way(self) -> Bools:
        """Returns which UAVs (N,) make room, or wait for others to pass before they land."""
        return np.asarray((self.asked_by >= 0) | (self.lands_after >= 0))

    def reset(self, which: Indices) -> None:
        """Forgets the flights `which` (n,), which begin anew."""
        self.state[which] = 0.0
        for whom in (self.asked_by, self.lands_after):
            whom[which] = -1
            whom[np.isin(whom, which)] = -1

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
        self.kept_out[:] = False
        self.lands_after[seen.home] = -1  # It may be home before it is back on its way.
        for row in np.flatnonzero((seen.target == self._last) & ~seen.home).tolist():
            self._wait_outside(seen, row)
        stuck = np.flatnonzero(self.held_up * world.slot >= HELD_UP - 1e-9).tolist()
        for row in sorted(stuck, key=self._rank):
            self._ask(seen, row)
        action = action.copy()
        for row in np.flatnonzero(self.gives_way).tolist():
            self.at[row] = follow_row(
                world, scene_of(world, row), seen.q[row], seen.v[row], self.route[row],
                int(self.at[row]), int(self.count[row]), action[row],
            )  # fmt: skip
        return action

    def _rank(self, row: int) -> tuple[int, int]:
        """Returns what says who makes room for whom: the row served, and how indirectly."""
        for depth in range(self.uavs):
            if self.asked_by[row] < 0:
                if self.lands_after[row] >= 0:
                    return int(self.lands_after[row]), depth + 1
                return int(row), depth
            row = int(self.asked_by[row])
        return int(row), self.uavs

    def _fleet(self, row: int) -> list[int]:
        """Returns the other rows of a row's fleet."""
        first = row - row % self.uavs
        return [i for i in range(first, first + self.uavs) if i != row]

    def _path(self, seen: Seen, row: int) -> Array:
        """Returns points (P, 3) of the path that a UAV means to fly next."""
        if self.gives_way[row]:
            rest = self.route[row, int(self.at[row]) : int(self.count[row])]
            return np.concatenate([seen.q[row : row + 1], rest])
        guide = self._guidance[int(seen.target[row])]
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

    def _wait_outside(self, seen: Seen, row: int) -> None:
        """Lets one that flies home wait where it does not shut the way of others, if it must."""
        landing, fleet = self._landings[row], row - row % self.uavs
        if landing is None:
            return
        whom = [
            i
            for i, last in enumerate(landing.last, fleet)
            if not seen.home[i] and seen.target[i] - self._first[i] <= last
        ]
        self.kept_out[row] = bool(whom)
        if self.asked_by[row] >= 0:
            return
        if whom and self.lands_after[row] < 0:
            world, w = seen.world, scene_of(seen.world, row)
            q, v = seen.q[row], seen.v[row]
            speed, a_max = float(np.linalg.norm(v)), float(world.a_max[w, 0])
            left, _ = query_row(self._guidance[int(seen.target[row])].way, q, np.empty(3))
            brakes = speed**2 / (2 * a_max) + speed * world.slot
            if left > landing.way_out + brakes + world.apart[w, 0]:
                return
            rest = q + v * (speed / (2 * a_max))  # where it stops if it brakes
            if not is_clear(tree_of(world, w), float(world.radius[w, 0]), q, rest):
                rest = q
            way = self._rooms.route(world, w, rest, landing.path, self._taken(seen, row))
            self._send(row, np.concatenate([rest[None], way]))
        if whom:
            self.lands_after[row] = min(whom)
        elif self.lands_after[row] >= 0:
            self._come_back(seen, row)

    def _come_back(self, seen: Seen, row: int) -> None:
        """Leads one that has waited outside back to where it left its way."""
        at, left = int(self.at[row]), self.lands_after[row] != row
        if left and at > 0:
            self._send(row, self.route[row, at::-1])
            self.lands_after[row] = row
        end = self.route[row, int(self.count[row]) - 1]
        near = BACK * seen.world.apart[scene_of(seen.world, row), 0]
        if (at == 0 and left) or np.linalg.norm(seen.q[row] - end) < near:
            self.lands_after[row] = -1

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
        taken = np.concatenate([self._taken(seen, row), seen.q[other : other + 1]])
        way = self._rooms.route(seen.world, scene_of(seen.world, row), seen.q[row], path, taken)
        if not len(way):
            return False
        self._send(row, way)
        self.waited[row], self.lands_after[row] = 0, -1
        self.asked_by[row], self.block[row] = other, seen.q[row]
        if self.asked_by[other] == row:
            self.asked_by[other] = -1
        return True

    def _taken(self, seen: Seen, row: int) -> Array:
        """Returns where (B, 3) others of a row's fleet rest, or will while they wait."""
        fleet = self._fleet(row)
        rests = seen.q[[i for i in fleet if seen.home[i]]]
        waits = [self.route[i, int(self.count[i]) - 1] for i in fleet if self.gives_way[i]]
        return np.concatenate([rests, np.reshape(waits, (-1, 3))])

    def _send(self, row: int, way: Array) -> None:
        """Lets a UAV fly along corners (n, 3), of which it knows the first LONGEST."""
        count = min(len(way), LONGEST)
        self.route[row, :count], self.count[row], self.at[row] = way[:count], count, 0
