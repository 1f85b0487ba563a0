"""What is seen of a state: how it stands towards its goal, and the observation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mjcollect.compiled import Array, Indices, compiled
from mjcollect.kernels.boxes import box_offset
from mjcollect.kernels.flight import scene_of
from mjcollect.kernels.vectors import dot
from mjcollect.kernels.way import query_row

if TYPE_CHECKING:
    from mjcollect.flight import World
    from mjcollect.guidance import Way


@compiled
def look(
    way: Way, which: Indices, goal: Array, strides: Array, q: Array, v: Array,
    offset: Array, distance: Array, direction: Array, closing: Array, ahead: Array,
) -> None:  # fmt: skip
    """How the simulations `which` stand towards a goal (3,), see `reward.Approach`.

    The points `ahead`, `strides` metres from one to the next, show bends before they are reached.
    """
    point, towards = np.empty(3), np.empty(3)
    for i in which:
        left, _ = query_row(way, q[i], direction[i])
        distance[i] = left
        closing[i] = dot(v[i], direction[i])
        for k in range(3):
            offset[i, k] = goal[k] - q[i, k]
            point[k], towards[k] = q[i, k], direction[i, k]
        for a in range(len(strides)):
            if a > 0:
                left, _ = query_row(way, point, towards)
            for k in range(3):
                point[k] += towards[k] * min(strides[a], left)
                ahead[i, a, k] = point[k] - q[i, k]


@compiled
def nearest_boxes(
    boxes: Array, q: Array, reach: float, far: float, gaps: Array, offset: Array, out: Array
) -> None:
    """Direction times closeness to the nearest boxes, nearest first: `out` (3 * len(gaps),).

    One metre away reads close to 1, `reach` away 1/2, far away 0; padding exactly 0, so that an
    observation does not depend on how many boxes other simulations have.
    """
    count = len(gaps)
    gaps[:], out[:] = far, 0.0
    for b in range(len(boxes)):
        gap = box_offset(q, boxes[b], offset)
        if gap >= gaps[count - 1] or gap >= far / 2:
            continue
        slot = count - 1
        while slot > 0 and gaps[slot - 1] > gap:
            gaps[slot] = gaps[slot - 1]
            for k in range(3):
                out[3 * slot + k] = out[3 * slot - 3 + k]
            slot -= 1
        gaps[slot] = gap
        for k in range(3):
            out[3 * slot + k] = offset[k] / max(gap, 1e-9) / (1.0 + gap / reach)


@compiled
def guided(
    world: World, q: Array, v: Array, goal_offset: Array, distance: Array, direction: Array,
    closing: Array, ahead: Array, slack: Array,
    nearest: int, reach: float, far: float, out: Array,
) -> None:  # fmt: skip
    """See `observation.guided`; the parts one after another, in the order of `GUIDED`."""
    gaps, offset = np.empty(nearest), np.empty(3)
    for i in range(len(q)):
        w, row, at = scene_of(world, i), out[i], 0
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        for k in range(3):
            row[at + k] = v[i, k] / v_max
            row[at + 3 + k] = direction[i, k]
        at += 6
        for a in range(1, ahead.shape[1]):
            for k in range(3):
                row[at + k] = ahead[i, a, k] / 100
            at += 3
        row[at] = distance[i] / 300
        row[at + 1] = math.tanh(distance[i] / 60)
        row[at + 2] = math.tanh(distance[i] / 12)
        at += 3
        for k in range(3):
            row[at + k] = goal_offset[i, k] / 300
            row[at + 3 + k] = math.tanh(goal_offset[i, k] / 60)
            row[at + 6 + k] = math.tanh(goal_offset[i, k] / 12)
        at += 9
        # Along the path, across it, and how much faster than one can still stop.
        fastest = min(math.sqrt(2 * a_max * distance[i]), v_max)
        row[at] = closing[i] / v_max
        row[at + 1] = math.sqrt(max(dot(v[i], v[i]) - closing[i] ** 2, 0.0)) / v_max
        row[at + 2] = math.tanh((closing[i] - fastest) / 10)
        at += 3
        # Share of a_max that a stop takes at the near and the far end of what will do; and by how
        # many metres full braking overshoots the near end, begun now or a slot later.
        braking = max(closing[i], 0.0) ** 2 / (2 * a_max)
        first, last = max(distance[i] - slack[i], 0.0), distance[i] + slack[i]
        row[at] = min(braking / max(first, 0.1), 2.0)
        row[at + 1] = min(braking / max(last, 0.1), 2.0)
        row[at + 2] = math.tanh((braking - first) / 5)
        row[at + 3] = math.tanh((braking + max(closing[i], 0.0) * world.slot - first) / 5)
        at += 4
        nearest_boxes(world.boxes[w], q[i], reach, far, gaps, offset, row[at : at + 3 * nearest])
        at += 3 * nearest
        for k in range(3):
            row[at + k] = math.tanh((q[i, k] - bounds[0, k]) / reach)
            row[at + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / reach)
