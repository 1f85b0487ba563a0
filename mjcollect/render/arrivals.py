"""Finds which node a recorded flight heads for, and when it got there, for every picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjcollect.scene.order import DEPOT, node_name
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

REST_SPEED = 1e-6  # A UAV at this speed (m/s) or below has stopped.


@dataclass(frozen=True)
class Progress:
    """Holds a flight, its nodes in order and the rows at which they were reached.

    Attributes:
        scene: where it was flown.
        trajectory: what was flown.
        order: item indices in the mission's order of visit.
        segment: number of the tour segment that was flown; None if it was the whole mission.
        nodes: the node that the flight leaves from, then its targets in order; the depot is -1.
        rows: trajectory row of each arrival; fewer than there are targets if it ended early.
    """

    scene: Scene
    trajectory: Trajectory
    order: tuple[int, ...]
    segment: int | None
    nodes: tuple[int, ...]
    rows: tuple[int, ...]

    @property
    def targets(self) -> tuple[int, ...]:
        """Returns the nodes to reach, in order."""
        return self.nodes[1:]

    @property
    def complete(self) -> bool:
        """Returns whether every target was reached."""
        return len(self.rows) == len(self.targets)

    def collected(self, reached: int) -> tuple[int, ...]:
        """Returns the items that are collected once `reached` targets were reached."""
        return self.order[: (self.segment or 0) + reached]

    def state(self, node: int, reached: int) -> str:
        """Returns what a node is once `reached` targets were reached, for its colour.

        That is 'target' (flown to), 'collected', 'depot' or 'item' (not collected yet).
        """
        if self.targets[reached : reached + 1] == (node,):
            return "target"
        if node <= DEPOT:
            return "depot"
        return "collected" if node in self.collected(reached) else "item"

    def goal(self, reached: int) -> int:
        """Returns the node flown to after `reached` arrivals; the last one if all were reached."""
        return self.targets[min(reached, len(self.targets) - 1)]

    def segment_title(self, reached: int) -> str:
        """Returns the segment flown after `reached` arrivals: 'segment 2: item 0 → item 2'."""
        index = min(reached, len(self.targets) - 1)
        start, end = (node_name(node) for node in self.nodes[index : index + 2])
        return f"segment {(self.segment or 0) + index}: {start} → {end}"


def progress(
    scene: Scene, trajectory: Trajectory, order: Sequence[int], segment: int | None = None,
    rest_speed: float = REST_SPEED,
) -> Progress:  # fmt: skip
    """Finds the arrivals of a mission, or of one of its segments.

    An arrival is the first row at rest within a target's tolerance (eq. (4)-(5)).

    Args:
        scene: where it was flown.
        trajectory: the flight.
        order: item indices in order of visit.
        segment: 0..K, counted along the tour; None for the whole mission.
        rest_speed: a UAV at this speed (m/s) or below has stopped; it is higher in disturbed air.

    Raises:
        ValueError: `order` is not a permutation of the items, or there is no such segment.
    """
    order = tuple(int(node) for node in order)
    if sorted(order) != list(range(len(scene.items))):
        raise ValueError(f"order: {list(order)}: must name each of 0..{len(scene.items) - 1} once")
    if segment is not None and not 0 <= segment <= len(order):
        raise ValueError(f"segment: {segment}: must lie in 0..{len(order)}")
    nodes = (DEPOT, *order, DEPOT)
    if segment is not None:
        nodes = nodes[segment : segment + 2]
    resting = np.flatnonzero(np.linalg.norm(trajectory.v, axis=1) <= rest_speed)
    rows: list[int] = []
    earliest = scene.substeps  # a segment takes at least one slot
    for node in nodes[1:]:
        near = np.linalg.norm(trajectory.x[resting] - scene.point(node), axis=1)
        hits = resting[(near <= scene.tolerance(node) + 1e-9) & (resting >= earliest)]
        if len(hits) == 0:
            break
        rows.append(int(hits[0]))
        earliest = rows[-1] + scene.substeps
    return Progress(scene, trajectory, order, segment, nodes, tuple(rows))
