"""Which node a recorded flight heads for, and when it got there; what every picture needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

REST_SPEED = 1e-6  # m/s; at or below, the UAV has stopped


@dataclass(frozen=True)
class Progress:
    """The nodes of a flight in order and the rows at which they were reached.

    Attributes:
        first_segment: number of the tour segment that the flight starts with.
        start: node it leaves from; the depot is -1.
        targets: nodes to reach, in order.
        rows: trajectory row of each arrival; shorter than `targets` if the flight ended early.
        before: items collected before the flight began.
    """

    first_segment: int
    start: int
    targets: tuple[int, ...]
    rows: tuple[int, ...]
    before: tuple[int, ...]

    def reached(self, row: int) -> int:
        """How many targets were reached at or before trajectory row `row`."""
        return int(np.searchsorted(self.rows, row, side="right"))

    def collected(self, reached: int) -> tuple[int, ...]:
        """Items collected once `reached` targets were."""
        return self.before + tuple(node for node in self.targets[:reached] if node >= 0)


def progress(
    scene: Scene, trajectory: Trajectory, order: Sequence[int], segment: int | None = None
) -> Progress:
    """Arrivals of a mission, or of one segment of it: at rest within tolerance (eq. (4)-(5)).

    Args:
        scene: where it was flown.
        trajectory: the flight.
        order: item indices in visiting order.
        segment: 0..K, counted along the tour; None for the whole mission.

    Raises:
        ValueError: `order` is not a permutation of the items, or there is no such segment.
    """
    order = tuple(int(node) for node in order)
    if sorted(order) != list(range(len(scene.items))):
        raise ValueError(f"order: {list(order)}: must name each of 0..{len(scene.items) - 1} once")
    if segment is not None and not 0 <= segment <= len(order):
        raise ValueError(f"segment: {segment}: must lie in 0..{len(order)}")
    nodes = (-1, *order, -1)
    first = segment or 0
    targets = nodes[first + 1 :] if segment is None else (nodes[first + 1],)
    resting = np.flatnonzero(np.linalg.norm(trajectory.v, axis=1) <= REST_SPEED)
    rows: list[int] = []
    earliest = scene.substeps  # a segment takes at least one slot
    for node in targets:
        near = np.linalg.norm(trajectory.x[resting] - scene.point(node), axis=1)
        hits = resting[(near <= scene.tolerance(node) + 1e-9) & (resting >= earliest)]
        if len(hits) == 0:
            break
        rows.append(int(hits[0]))
        earliest = rows[-1] + scene.substeps
    return Progress(first, nodes[first], targets, tuple(rows), order[:first])
