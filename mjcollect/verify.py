"""Judges a recorded flight against the scene and the paper's rules, in continuous time.

On purpose it shares no code with the flight, the geometry or the physics: a mistake there must
not excuse itself here. It reads nothing but the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

Array = NDArray[np.float64]
TOLERANCE = 1e-6  # m, m/s, m/s^2 and s: what round-off may cost
REST = 1e-6  # m/s; slower is at rest, the paper's v = 0
_BISECTIONS = 60


@dataclass(frozen=True)
class Violation:
    """One broken rule; a contiguous stretch of rows that break it counts once.

    Attributes:
        kind: speed (m/s), acceleration (m/s^2), bounds (m outside), contact (m from the body's
            centre to a box), start (m, or m/s), stop and return (m from the target, m/s at it, or
            s where the segment is shorter than a slot), order (item index: value the one visited,
            limit the one that was due), timestep (error of a row in s, m/s or m; or a number that
            is not finite, whose value is None).
        t: s, where it begins.
        segment: 0..K, the segment flown at that time.
        value: the worst found.
        limit: what was allowed.
    """

    kind: str
    t: float
    segment: int
    value: float | None
    limit: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def verify(
    scene: Scene,
    trajectory: Trajectory,
    order: Sequence[int],
    *,
    segment: int | None = None,
    start: Array | None = None,
) -> list[Violation]:
    """Everything that a flight breaks, by time; empty if it is a success.

    Rules: limits (2)-(3), bounds, no touch of the body's sphere with a box at any instant, each
    item collected in order at rest within epsilon (5), the end at rest at the depot (4), no
    segment shorter than a slot, and rows that follow semi-implicit Euler at the physics step.

    Args:
        scene: the rules.
        trajectory: R rows.
        order: the K items in order of visit.
        segment: judge the flight of this segment (0..K) of the order alone; None for a mission.
        start: (3,) where the flight must begin; None for the depot or the segment's first node.

    Raises:
        ValueError: the order is no permutation of the items, or there is no such segment.
    """
    count = len(scene.items)
    if sorted(order) != list(range(count)):
        raise ValueError(f"order: {list(order)}: must name each of the {count} items once")
    if segment is not None and not 0 <= segment <= count:
        raise ValueError(f"segment: {segment}: must be from 0 to {count}")
    rows = np.column_stack([trajectory.t, trajectory.x, trajectory.v, trajectory.a])
    if not np.all(np.isfinite(rows)):
        row = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        return [Violation("timestep", row * scene.physics_step, segment or 0, None, TOLERANCE)]

    nodes = [-1, *order, -1]
    targets = nodes[1:] if segment is None else [nodes[segment + 1]]
    flight = _Flight(scene, trajectory, segment or 0)
    first = nodes[segment or 0]
    flight.check_start(_position(scene, first) if start is None else np.asarray(start))
    flight.check_stops(targets)
    flight.check_end(targets[-1])
    flight.check_rows()
    return sorted(flight.found, key=lambda violation: violation.t)


def _position(scene: Scene, node: int) -> Array:
    return scene.depot if node < 0 else scene.items[node]


def _reach(scene: Scene, node: int) -> float:
    return scene.return_tolerance if node < 0 else scene.epsilon


class _Flight:
    """A finite trajectory under judgement; the checks add to `found`."""

    def __init__(self, scene: Scene, trajectory: Trajectory, segment: int) -> None:
        self.scene, self.flown, self.segment = scene, trajectory, segment
        self.speed = np.linalg.norm(trajectory.v, axis=1)
        self.slot_rows = round(scene.slot / scene.physics_step)
        self.stops: list[int] = []  # rows at which an item is collected
        self.segments: list[int] = []  # and the segments that end there
        self.found: list[Violation] = []

    def add(self, kind: str, row: int, segment: int, value: float, limit: float) -> None:
        self.found.append(
            Violation(kind, float(self.flown.t[row]), segment, float(value), float(limit))
        )

    def check_start(self, start: Array) -> None:
        distance = float(np.linalg.norm(self.flown.x[0] - start))
        if distance > TOLERANCE:
            self.add("start", 0, self.segment, distance, TOLERANCE)
        if self.speed[0] > REST:
            self.add("start", 0, self.segment, self.speed[0], REST)

    def check_stops(self, targets: list[int]) -> None:
        """Find in order the row at which each item but the last target is collected.

        Taking the earliest row possible for each leaves most to the following ones, so if any
        choice of rows collects all in order, this one does. An item that is not found is
        reported, and the search goes on from the last one that is.
        """
        missing = []
        for leg, item in enumerate(targets[:-1]):
            begin = (self.stops[-1] if self.stops else 0) + self.slot_rows
            found = np.flatnonzero(self.at_rest_near(item)[begin:])
            if len(found):
                self.stops.append(begin + int(found[0]))
                self.segments.append(leg)
            else:
                missing.append((leg, item, min(begin, len(self.speed) - 1)))
        for leg, item, begin in missing:
            visits = np.flatnonzero(self.at_rest_near(item))
            due = targets[self.segment_at(int(visits[0]))] if len(visits) else item
            if due != item:
                self.add("order", int(visits[0]), leg, item, due)
            else:
                self.report_missed(leg, item, begin)

    def segment_at(self, row: int) -> int:
        """The segment being flown at a row; a stop's row still belongs to the one it ends."""
        done = int(np.searchsorted(self.stops, row))
        return self.segments[done - 1] + 1 if done else self.segment

    def at_rest_near(self, node: int) -> NDArray[np.bool_]:
        return (self.speed <= REST) & (self.distance(node) <= _reach(self.scene, node))

    def distance(self, node: int) -> Array:
        return np.asarray(np.linalg.norm(self.flown.x - _position(self.scene, node), axis=1))

    def report_missed(self, leg: int, item: int, begin: int) -> None:
        """How near, or how slow within reach, the flight came from row `begin` on."""
        distance = self.distance(item)[begin:]
        near = np.flatnonzero(distance <= self.scene.epsilon)
        if len(near):
            row = begin + int(near[np.argmin(self.speed[begin + near])])
            self.add("stop", row, leg, self.speed[row], REST)
        else:
            nearest = int(np.argmin(distance))
            self.add("stop", begin + nearest, leg, distance[nearest], self.scene.epsilon)

    def check_end(self, target: int) -> None:
        """At rest at the last target, for good, and not before a slot has passed."""
        row = len(self.flown) - 1
        kind, leg = ("stop", self.segment) if target >= 0 else ("return", len(self.scene.items))
        rows_flown = row - (self.stops[-1] if self.stops else 0)
        distance, reach = self.distance(target)[-1], _reach(self.scene, target)
        if distance > reach:
            self.add(kind, row, leg, distance, reach)
        if self.speed[-1] > REST:
            self.add(kind, row, leg, self.speed[-1], REST)
        if np.any(self.flown.a[-1] != 0.0):
            self.add(kind, row, leg, float(np.linalg.norm(self.flown.a[-1])), 0.0)
        if rows_flown < self.slot_rows:
            self.add(kind, row, leg, rows_flown * self.scene.physics_step, self.scene.slot)

    def check_rows(self) -> None:
        """Limits, bounds, contact and motion, row by row."""
        scene, flown = self.scene, self.flown
        push = np.asarray(np.linalg.norm(flown.a, axis=1))
        outside = np.maximum(scene.bounds[0] - flown.x, flown.x - scene.bounds[1]).max(axis=1)
        step = scene.physics_step
        error = np.abs(flown.t - np.arange(len(flown)) * step)
        # Speed and bounds hold between rows where they hold at both: convex sets.
        v_error = np.abs(np.diff(flown.v, axis=0) - flown.a[:-1] * step).max(axis=1)
        x_error = np.abs(np.diff(flown.x, axis=0) - flown.v[1:] * step).max(axis=1)
        error[1:] = np.maximum(error[1:], np.maximum(v_error, x_error))
        clearance = _clearance(flown.x, scene.obstacles, scene.uav_radius)
        for kind, value, limit in (
            ("speed", self.speed, scene.v_max),
            ("acceleration", push, scene.a_max),
            ("bounds", outside, 0.0),
            ("timestep", error, 0.0),
        ):
            for rows in _stretches(value > limit + TOLERANCE):
                self.add(kind, rows[0], self.segment_at(rows[0]), value[rows].max(), limit)
        for rows in _stretches(clearance < scene.uav_radius - TOLERANCE):
            worst = clearance[rows].min()
            self.add("contact", rows[0], self.segment_at(rows[0]), worst, scene.uav_radius)


def _stretches(broken: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Row indices of each contiguous run of True."""
    rows = np.flatnonzero(broken)
    return [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(run)]


def _clearance(x: Array, boxes: Array, radius: float) -> Array:
    """Least distance (R,) to a box on the piece from row k to k + 1; inf for some above `radius`.

    The last row's piece is the row itself.
    """
    start, end = x, np.concatenate([x[1:], x[-1:]])
    middle, half = (start + end) / 2, np.linalg.norm(end - start, axis=1) / 2
    least = np.full(len(x), np.inf)
    for low, high in boxes:
        gap = np.maximum(np.maximum(low - middle, middle - high), 0.0)
        near = np.flatnonzero(np.linalg.norm(gap, axis=1) - half < radius)
        if len(near):
            distance = _piece_to_box(start[near], end[near] - start[near], low, high)
            least[near] = np.minimum(least[near], distance)
    return least


def _piece_to_box(start: Array, step: Array, low: Array, high: Array) -> Array:
    """Distances (N,) from pieces start + s step, 0 <= s <= 1, to one box.

    The squared distance is convex in s: bisect on the sign of its derivative.
    """
    left, right = np.zeros(len(start)), np.ones(len(start))
    for _ in range(_BISECTIONS):
        middle = (left + right) / 2
        at = start + middle[:, None] * step
        outward = at - np.clip(at, low, high)
        falling = np.sum(outward * step, axis=1) < 0.0
        left, right = np.where(falling, middle, left), np.where(falling, right, middle)
    at = start + right[:, None] * step
    return np.asarray(np.linalg.norm(at - np.clip(at, low, high), axis=1))
