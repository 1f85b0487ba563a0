"""Judges a recorded flight against the scene and the paper's rules, in continuous time.

Flights in disturbed air are judged by what they can keep to: no touch of a box, also of one that
moves, the bounds with a margin, every item collected nearly at rest. Accelerations are then what
rotors and air gave together, and neither they nor speeds are limited.

On purpose it shares no code with the flight, the geometry or the physics: a mistake there must
not excuse itself here. It reads nothing but the rows.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label
from scipy.spatial import KDTree

from mjcollect.scene.air import AIR_FILE, Air
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

Array = NDArray[np.float64]
TOLERANCE = 1e-6  # Round-off may cost as much as this in m, m/s, m/s^2 and s.
REST = 1e-6  # A body slower than this (m/s) is at rest, the paper's v = 0.
DISTURBED_REST = 2.0  # In disturbed air it is at rest below this (m/s),
DISTURBED_MARGIN = 5.0  # and inside up to so many metres beyond the bounds.
_BISECTIONS = 60  # After as many halvings the nearest point is exact to the last digit.


@dataclass(frozen=True)
class Violation:
    """Describes one broken rule; a contiguous stretch of rows that break it counts once.

    Attributes:
        kind: speed (m/s), acceleration (m/s^2), bounds (m outside), contact and clearance (m from
            the body's centre to a box), start (m, or m/s), stop and return (m from the target, m/s
            at it, or s where the segment is shorter than a slot), order (item index: value the one
            visited, limit the one that was due), timestep (error of a row in s, m/s or m; or a
            number that is not finite, whose value is None).
        t: time at which it begins (s).
        segment: number 0..K of the segment flown at that time.
        value: the worst value found.
        limit: what was allowed.
    """

    kind: str
    t: float
    segment: int
    value: float | None
    limit: float

    def to_dict(self) -> dict[str, object]:
        """Returns the violation as a JSON document."""
        return asdict(self)


def verify(
    scene: Scene, trajectory: Trajectory, order: Sequence[int], *, segment: int | None = None,
    disturbed: bool = False, moving: Sequence[MovingBox] | None = None,
) -> list[Violation]:  # fmt: skip
    """Returns everything that a flight breaks, by time; nothing if it is a success.

    The rules are the limits (2)-(3), the bounds, no touch of the body's sphere with a box at any
    instant, the scene's clearance, each item collected in order at rest within epsilon (5), the
    end at rest at the depot (4), no segment shorter than a slot, and rows that follow semi-implicit
    Euler at the physics step.

    Args:
        scene: the problem with its limits.
        trajectory: the flight.
        order: the K items in order of visit.
        segment: number 0..K of the one segment of the order that was flown; None for a mission.
        disturbed: whether the air was disturbed, or boxes moved.
        moving: boxes that moved, by default those of the scene.

    Raises:
        ValueError: the order is no permutation of the items, or there is no such segment.
    """
    count = len(scene.items)
    if sorted(order) != list(range(count)):
        raise ValueError(f"order: {list(order)}: must name each of the {count} items once")
    if segment is not None and not 0 <= segment <= count:
        raise ValueError(f"segment: {segment}: must be from 0 to {count}")
    rows = np.column_stack([trajectory.t, trajectory.x, trajectory.v, trajectory.a])
    broken = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(broken):
        begin = int(broken[0]) * scene.physics_step
        return [Violation("timestep", begin, segment or 0, None, TOLERANCE)]

    first = segment or 0
    nodes = [DEPOT, *order, DEPOT]
    targets = nodes[1:] if segment is None else [nodes[first + 1]]
    boxes = scene.moving if moving is None else moving
    flight = _Flight(scene, trajectory, first, disturbed, boxes)
    flight.check_start(nodes[first])
    flight.check_stops(targets)
    flight.check_end(targets[-1])
    flight.check_rows()
    return sorted(flight.found, key=lambda violation: violation.t)


def verify_run(folder: str | os.PathLike[str]) -> list[Violation]:
    """Returns everything that the flight in a run folder breaks, as `verify` does.

    What mission.json or segment.json says of a disturbance, and air.json of moving boxes, counts.

    Raises:
        OSError, SceneError, ValueError, KeyError: the folder does not hold a finished run.
    """
    folder = Path(folder)
    kind = "mission" if (folder / "mission.json").is_file() else "segment"
    result = json.loads((folder / f"{kind}.json").read_text(encoding="utf-8"))
    there = (folder / AIR_FILE).is_file()
    return verify(
        Scene.load(folder / "scene.json"),
        Trajectory.load(folder / "trajectory.csv"),
        result["order"],
        segment=result["segment"] if kind == "segment" else None,
        disturbed="disturbance" in result and there,
        moving=Air.load(folder / AIR_FILE).moving if there else None,
    )


class _Flight:
    """Judges a finite trajectory; the checks add to `found`."""

    def __init__(
        self, scene: Scene, trajectory: Trajectory, segment: int, disturbed: bool,
        moving: Sequence[MovingBox],
    ) -> None:  # fmt: skip
        self.disturbed, self.moving = disturbed, moving
        self.rest = DISTURBED_REST if disturbed else REST
        self.scene, self.flown, self.segment = scene, trajectory, segment
        self.speed = np.linalg.norm(trajectory.v, axis=1)
        self.slot_rows = round(scene.slot / scene.physics_step)
        self.stops: list[int] = []  # rows at which an item is collected
        self.segments: list[int] = []  # and the segments that end there
        self.found: list[Violation] = []

    def add(self, kind: str, row: int, segment: int, value: float, limit: float) -> None:
        time = float(self.flown.t[row])
        self.found.append(Violation(kind, time, segment, float(value), float(limit)))

    def check_start(self, node: int) -> None:
        for value, limit in ((self.distance(node)[0], TOLERANCE), (self.speed[0], REST)):
            if value > limit:
                self.add("start", 0, self.segment, value, limit)

    def check_stops(self, targets: list[int]) -> None:
        """Finds in order the row at which each item but the last target is collected.

        Taking the earliest row possible for each leaves most to the following ones, so if any
        choice of rows collects all in order, this one does. An item that is not found is
        reported, and the search goes on from the last one that is.
        """
        missing = []
        for segment, item in enumerate(targets[:-1]):
            begin = (self.stops[-1] if self.stops else 0) + self.slot_rows
            found = np.flatnonzero(self.at_rest_near(item)[begin:])
            if len(found):
                self.stops.append(begin + int(found[0]))
                self.segments.append(segment)
            else:
                missing.append((segment, item, min(begin, len(self.speed) - 1)))
        for segment, item, begin in missing:
            visits = np.flatnonzero(self.at_rest_near(item))
            due = targets[self.segment_at(int(visits[0]))] if len(visits) else item
            if due != item:
                self.add("order", int(visits[0]), segment, item, due)
            else:
                self.report_missed(segment, item, begin)

    def segment_at(self, row: int) -> int:
        """Returns the segment flown at a row; a stop's row still belongs to the one it ends."""
        done = int(np.searchsorted(self.stops, row))
        return self.segments[done - 1] + 1 if done else self.segment

    def at_rest_near(self, node: int) -> NDArray[np.bool_]:
        return (self.speed <= self.rest) & (self.distance(node) <= self.scene.tolerance(node))

    def distance(self, node: int) -> Array:
        return np.asarray(np.linalg.norm(self.flown.x - self.scene.point(node), axis=1))

    def report_missed(self, segment: int, item: int, begin: int) -> None:
        """Adds how near, or how slow within reach, the flight came from row `begin` on."""
        distance = self.distance(item)[begin:]
        near = np.flatnonzero(distance <= self.scene.epsilon)
        if len(near):
            row = begin + int(near[np.argmin(self.speed[begin + near])])
            self.add("stop", row, segment, self.speed[row], self.rest)
        else:
            nearest = int(np.argmin(distance))
            self.add("stop", begin + nearest, segment, distance[nearest], self.scene.epsilon)

    def check_end(self, target: int) -> None:
        """Checks that it rests at the last target for good, and not before a slot has passed."""
        kind, segment = "stop", self.segment
        if target == DEPOT:
            kind, segment = "return", len(self.scene.items)
        row, step = len(self.flown) - 1, self.scene.physics_step
        for value, limit in (
            (self.distance(target)[-1], self.scene.tolerance(target)),
            (self.speed[-1], self.rest),
            (float(np.linalg.norm(self.flown.a[-1])), 0.0),
        ):
            if value > limit:
                self.add(kind, row, segment, value, limit)
        rows_flown = row - (self.stops[-1] if self.stops else 0)
        if rows_flown < self.slot_rows:
            self.add(kind, row, segment, rows_flown * step, self.scene.slot)

    def check_rows(self) -> None:
        """Checks limits, bounds, contact and motion, row by row."""
        scene, flown, step = self.scene, self.flown, self.scene.physics_step
        push = np.linalg.norm(flown.a, axis=1)
        outside = np.maximum(scene.bounds[0] - flown.x, flown.x - scene.bounds[1]).max(axis=1)
        error = np.abs(flown.t - np.arange(len(flown)) * step)
        # Speed and bounds hold between rows where they hold at both: convex sets.
        v_error = np.abs(np.diff(flown.v, axis=0) - flown.a[:-1] * step).max(axis=1)
        x_error = np.abs(np.diff(flown.x, axis=0) - flown.v[1:] * step).max(axis=1)
        error[1:] = np.maximum(error[1:], np.maximum(v_error, x_error))
        clearance = _clearance(flown.x, scene.obstacles, scene.reach, scene.yaw)
        for box in self.moving:
            there = box.box_at(float(flown.t[0]))
            # Seen from the box, which like the body moves straight between rows.
            drift = box.centres(flown.t) - there.mean(axis=0)
            apart = _clearance(flown.x - drift, there[None], scene.reach)
            clearance = np.minimum(clearance, apart)
        margin = DISTURBED_MARGIN if self.disturbed else 0.0
        free = np.inf if self.disturbed else 1.0  # The air may push beyond the limits.
        for kind, sign, value, limit in (
            ("speed", 1, self.speed, scene.v_max * free),
            ("acceleration", 1, push, scene.a_max * free),
            ("bounds", 1, outside, margin),
            ("timestep", 1, error, 0.0),
            ("contact", -1, clearance, scene.uav_radius),  # must not be less
            *([("clearance", -1, clearance, scene.reach)] if scene.clearance else []),
        ):
            for (rows,) in find_objects(label(sign * value > sign * limit + TOLERANCE)[0]):
                worst = sign * np.max(sign * value[rows])
                self.add(kind, rows.start, self.segment_at(rows.start), worst, limit)


def _clearance(x: Array, boxes: Array, radius: float, yaws: Array | None = None) -> Array:
    """Returns the least distance (R,) to a box between rows k and k + 1.

    Above `radius` it may be inf instead. The last row stands for itself. A box that is turned by a
    yaw (degrees) about its centre is one that is not, if the flight is turned back about it.
    """
    least, yaws = np.full(len(x), np.inf), np.zeros(len(boxes)) if yaws is None else yaws
    ends = np.concatenate([x[1:], x[-1:]])
    longest = np.linalg.norm(ends - x, axis=1).max() / 2
    middles = KDTree((x + ends) / 2)
    for (low, high), yaw in zip(boxes, yaws, strict=True):
        centre, around = (low + high) / 2, np.linalg.norm(high - low) / 2
        near = np.array(middles.query_ball_point(centre, around + radius + longest), dtype=int)
        start, end = x[near], ends[near]
        if yaw != 0.0:
            start, end = (_turned_back(points, centre, float(yaw)) for points in (start, end))
        middle, half = (start + end) / 2, np.linalg.norm(end - start, axis=1) / 2
        gap = np.maximum(np.maximum(low - middle, middle - high), 0.0)
        close = np.linalg.norm(gap, axis=1) - half < radius
        if close.any():
            start, end, near = start[close], end[close], near[close]
            least[near] = np.minimum(least[near], _piece_to_box(start, end - start, low, high))
    return least


def _turned_back(x: Array, centre: Array, yaw: float) -> Array:
    """Returns points (R, 3) turned by minus a yaw (degrees) about the vertical through a point."""
    away, turn = x - centre, np.exp(-1j * np.radians(yaw))
    level = (away[:, 0] + 1j * away[:, 1]) * turn
    return centre + np.stack([level.real, level.imag, away[:, 2]], axis=1)


def _piece_to_box(start: Array, step: Array, low: Array, high: Array) -> Array:
    """Returns the distances (N,) from pieces start + s step, 0 <= s <= 1, to one box.

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
