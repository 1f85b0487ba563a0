"""What is seen of a state: how it stands towards its goal, and the observation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mjcollect.compiled import Array, Indices, compiled
from mjcollect.kernels.boxes import box_offset
from mjcollect.kernels.flight import scene_of
from mjcollect.kernels.stop import chord
from mjcollect.kernels.vectors import dot, norm, unit
from mjcollect.kernels.way import query_row

if TYPE_CHECKING:
    from mjcollect.flight import World
    from mjcollect.guidance import Way

TURN = 0.1  # radians by which a heading is still turned at hardly any loss of time
STEEP = 0.05  # share of a path that is level, below which its frame keeps to the x axis


@compiled
def stretch_row(way: Way, goal: Array, radius: float, left: float) -> tuple[float, float]:
    """Metres along the path to where its last piece enters the goal's ball, and leaves it."""
    last, towards = len(way.points) - 1, np.empty(3)
    if last == 0:
        return max(left - radius, 0.0), left + radius
    for k in range(3):
        towards[k] = way.points[last, k] - way.points[last - 1, k]
    whole = unit(towards, towards)
    middle, half = chord(goal, radius, way.points[last - 1], towards)
    half = max(half, 0.0)
    return max(left - whole + middle - half, 0.0), max(left - whole + middle + half, 0.0)


@compiled
def aim_row(
    goal: Array, radius: float, change: float, braking: float, q: Array, v: Array, heading: Array
) -> tuple[float, float]:
    """Bend `heading` towards where the velocity leads into the goal's ball, or passes it.

    Far away that is the heading; close by, where no turn is worth its while, the velocity's own
    direction. Continuous in q and v, so that the time to go is. Metres to where the heading enters
    the ball and to where it leaves it.

    Args:
        goal: (3,), in sight. radius: of its ball, in m. change: m/s in a slot. heading: (3,) unit
            vector of the path.
    """
    offset, mine, aside = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        offset[k] = goal[k] - q[k]
    speed = unit(v, mine)
    ahead, along = max(dot(offset, mine), braking), max(dot(offset, heading), 0.0)
    for k in range(3):  # from where the path passes the goal to where the velocity does, or ends
        aside[k] = mine[k] * ahead - heading[k] * along
    apart = norm(aside)
    share = max(apart - TURN * ahead, 0.0) / max(apart, 1e-9) * min(speed / change, 1.0)
    square = 0.0
    for k in range(3):
        aside[k] = aside[k] * share + heading[k] * along - offset[k]  # from the goal
        square += aside[k] ** 2
    inside = min(radius / max(math.sqrt(square), 1e-9), 1.0)
    for k in range(3):
        aside[k] = offset[k] + aside[k] * inside
    if norm(aside) > 1e-6:
        unit(aside, heading)
    middle, half = chord(goal, radius, q, heading)
    half = max(half, 0.0)
    return max(middle - half, 0.0), max(middle + half, 0.0)


@compiled
def look(
    world: World, way: Way, which: Indices, goal: Array, radius: float,
    strides: Array, q: Array, v: Array, offset: Array, distance: Array, direction: Array,
    closing: Array, near: Array, far: Array, ahead: Array, heading: Array,
) -> None:  # fmt: skip
    """How the simulations `which` stand towards a goal (3,) with a ball, see `reward.Approach`.

    The points `ahead`, `strides` metres from one to the next, show bends before they are reached.
    """
    point, towards = np.empty(3), np.empty(3)
    for i in which:
        w = scene_of(world, i)
        left, chosen = query_row(way, q[i], direction[i])
        distance[i] = left
        heading[i] = direction[i]
        if chosen == len(way.points) - 1:
            change, speed = world.a_max[w, 0] * world.slot, norm(v[i])
            braking = speed**2 / (2 * world.a_max[w, 0])
            near[i], far[i] = aim_row(goal, radius, change, braking, q[i], v[i], heading[i])
        else:
            near[i], far[i] = stretch_row(way, goal, radius, left)
        closing[i] = dot(v[i], heading[i])
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
def frame_row(direction: Array, frame: Array) -> None:
    """Axes (3, 3) of a path: along it, level to its left, and upwards from both."""
    x, y = direction[0], direction[1]
    level = math.sqrt(x * x + y * y)
    if level < STEEP:
        x, y, level = 1.0, 0.0, 1.0
    frame[0] = direction
    # Where the path is steep, x is not along it: what of `left` is along the path goes.
    left = np.array([-y / level, x / level, 0.0])
    along = dot(left, direction)
    for k in range(3):
        left[k] -= along * direction[k]
    unit(left, frame[1])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        frame[2, k] = direction[i] * frame[1, j] - direction[j] * frame[1, i]


@compiled
def frames(direction: Array, frame: Array) -> None:
    """`frame_row` of each (N, 3)."""
    for i in range(len(direction)):
        frame_row(direction[i], frame[i])


@compiled
def seen_from(frame: Array, vector: Array, scale: float, to: Array) -> None:
    """A vector over a scale, in a frame."""
    for k in range(3):
        to[k] = dot(frame[k], vector) / scale


@compiled
def squash(vector: Array) -> None:
    """tanh of each component."""
    for k in range(len(vector)):
        vector[k] = math.tanh(vector[k])


@compiled
def guided(
    world: World, q: Array, v: Array, goal_offset: Array, direction: Array, closing: Array,
    near: Array, far: Array, ahead: Array, after: Array, frame: Array,
    nearest: int, reach: float, beyond: float, out: Array,
) -> None:  # fmt: skip
    """See `observation.guided`; the parts one after another, in the order of `GUIDED`."""
    gaps, offset, boxes, rest = np.empty(nearest), np.empty(3), np.empty(3 * nearest), np.empty(3)
    for i in range(len(q)):
        w, row, at, axes = scene_of(world, i), out[i], 0, frame[i]
        a_max, v_max, bounds = world.a_max[w, 0], world.v_max[w, 0], world.bounds[w]
        stopping, change = v_max**2 / (2 * a_max), a_max * world.slot
        seen_from(axes, v[i], v_max, row[0:3])
        seen_from(axes, v[i], 2 * change, row[3:6])
        squash(row[3:6])
        for k in range(3):
            row[6 + k] = direction[i, k]
        at = 9
        for a in range(1, ahead.shape[1]):
            seen_from(axes, ahead[i, a], 1.6 * stopping, row[at : at + 3])
            at += 3
        row[at] = near[i] / (5 * stopping)
        row[at + 1] = math.tanh(near[i] / stopping)
        row[at + 2] = math.tanh(5 * near[i] / stopping)
        at += 3
        seen_from(axes, goal_offset[i], 5 * stopping, row[at : at + 3])
        seen_from(axes, goal_offset[i], stopping, row[at + 3 : at + 6])
        seen_from(axes, goal_offset[i], stopping / 5, row[at + 6 : at + 9])
        squash(row[at + 3 : at + 9])
        at += 9
        # How much faster than one can still stop; share of a_max that a stop takes at the near
        # and the far end of what will do; slots until it must begin, for either; and slots to
        # rest: only whole ones are flown.
        speed = max(closing[i], 0.0)
        braking = speed**2 / (2 * a_max)
        first, last = near[i], far[i]
        fastest = min(math.sqrt(2 * a_max * first), v_max)
        stride, turn = max(speed, change) * world.slot, 2 * math.pi * speed / change
        row[at] = math.tanh((closing[i] - fastest) / (2.5 * change))
        row[at + 1] = min(braking / max(first, 0.1), 2.0)
        row[at + 2] = min(braking / max(last, 0.1), 2.0)
        row[at + 3] = math.tanh((first - braking) / (4 * stride))
        row[at + 4] = math.tanh((first - braking) / stride)
        row[at + 5] = math.tanh((last - braking) / stride)
        row[at + 6] = math.sin(turn)
        row[at + 7] = math.cos(turn)
        at += 8
        nearest_boxes(world.boxes[w], q[i], reach, beyond, gaps, offset, boxes)
        for b in range(nearest):
            seen_from(axes, boxes[3 * b : 3 * b + 3], 1.0, row[at : at + 3])
            at += 3
        for k in range(3):
            row[at + k] = math.tanh((q[i, k] - bounds[0, k]) / reach)
            row[at + 3 + k] = math.tanh((bounds[1, k] - q[i, k]) / reach)
        at += 6
        # Where full braking from now on would end, as seen from the goal; where the tour goes on.
        size = norm(v[i])
        for k in range(3):
            rest[k] = v[i, k] * (size / (2 * a_max)) - goal_offset[i, k]
        seen_from(axes, rest, 20.0, row[at : at + 3])
        seen_from(axes, rest, 4.0, row[at + 3 : at + 6])
        squash(row[at : at + 6])
        seen_from(axes, after[i], 1.0, row[at + 6 : at + 9])
