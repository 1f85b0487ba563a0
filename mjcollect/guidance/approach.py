"""Describes how each simulation stands towards its target."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mjcollect.flight.straight_line import TIME_CAP, time_to_go
from mjcollect.flight.world import World, scene_of
from mjcollect.geometry.compiled import Array, Bools, Indices, compiled
from mjcollect.geometry.vectors import dot, norm, unit
from mjcollect.guidance.stopping import chord
from mjcollect.guidance.way import Way, query_row

# From one point of `Approach.ahead` to the next, in units of the scene.
LOOK_AHEAD = np.array([30.0, 40.0, 60.0])


class Approach(NamedTuple):
    """Says how each of N simulations stands towards its target.

    Attributes:
        offset: (N, 3) m, body to target. distance: (N,) m along the shortest free path.
        direction: (N, 3), unit vectors of that path. speed: (N,) m/s. closing: (N,) m/s,
            the part of the velocity along `heading`.
        returning: (N,), whether the target is the depot.
        ahead: (N, A, 3) m, from the body to points farther along the path.
        near, far: (N,) metres along the path to where it enters the goal's ball and leaves it.
        heading: (N, 3), unit vectors along which near, far and closing are measured: `direction`,
            or that of the velocity where it leads straight into the ball.
        next_direction: (N, 3), unit vectors from the target to the tour's next; zero where the tour
            ends.
        frame: (N, 3, 3), axes of the path: along `heading`, level to its left, and upwards.
        next_excess: (N,) metres by which the tour's next target is farther from the body than from
            the current target; 0 where the tour ends.
    """

    offset: Array
    distance: Array
    direction: Array
    closing: Array
    speed: Array
    returning: Bools
    ahead: Array
    near: Array
    far: Array
    heading: Array
    next_direction: Array
    frame: Array
    next_excess: Array

    @classmethod
    def empty(cls, count: int) -> Approach:
        """Returns unset rows for `count` simulations; what is about the next target is zero."""
        return cls(
            offset=np.empty((count, 3)),
            distance=np.empty(count),
            direction=np.empty((count, 3)),
            closing=np.empty(count),
            speed=np.empty(count),
            returning=np.empty(count, dtype=bool),
            ahead=np.empty((count, len(LOOK_AHEAD), 3)),
            near=np.empty(count),
            far=np.empty(count),
            heading=np.empty((count, 3)),
            next_direction=np.zeros((count, 3)),
            frame=np.empty((count, 3, 3)),
            next_excess=np.zeros(count),
        )

    def rows(self, which: Indices) -> Approach:
        """Returns the rows of the simulations `which` (n,) only."""
        return Approach._make(values[which] for values in self)

    def time_to_go(self, world: World) -> Array:
        """Returns the least time (N,) in s to rest in the goal's ball, on a line along the path."""
        middle, half = (self.near + self.far) / 2, (self.far - self.near) / 2
        along = time_to_go(world, middle, self.closing, half)
        return np.maximum(along, np.minimum(self.speed / world.a_max[..., 0], TIME_CAP))


TURN = 0.1  # rad; a smaller turn costs hardly any time, so the heading of the path is kept
STEEP = 0.05  # A path with a level share below this takes its frame from the x axis.


@compiled
def stretch_row(way: Way, goal: Array, radius: float, left: float) -> tuple[float, float]:
    """Returns the metres along the path to where its last piece enters the ball and leaves it."""
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
    """Bends `heading` towards where the velocity leads into the goal's ball, or passes it.

    Far away it stays as it is; close by, where no turn is worth its while, it becomes the
    velocity's direction. It is continuous in q and v, so that the time to go is.

    Args:
        goal: (3,), in sight. radius: of its ball, in m. change: m/s in a slot. braking: m to rest.
        heading: (3,), unit vector of the path.

    Returns:
        The metres to where the new heading enters the ball and to where it leaves it.
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
def frame_row(direction: Array, frame: Array) -> None:
    """Writes the axes of a path to `frame` (3, 3): along it, level to its left, and upwards."""
    x, y = direction[0], direction[1]
    level = math.sqrt(x * x + y * y)
    if level < STEEP:
        x, y, level = 1.0, 0.0, 1.0
    frame[0] = direction
    # `left` loses its part along the path: a steep path has no level direction of its own.
    left = np.array([-y / level, x / level, 0.0])
    along = dot(left, direction)
    for k in range(3):
        left[k] -= along * direction[k]
    unit(left, frame[1])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        frame[2, k] = direction[i] * frame[1, j] - direction[j] * frame[1, i]


@compiled
def approach_rows(
    world: World, way: Way, which: Indices, goal: Array, radius: float, strides: Array, q: Array,
    v: Array, approach: Approach,
) -> None:  # fmt: skip
    """Writes the rows `which` of an approach to a goal (3,) with a ball of `radius` m.

    Left out are the speed, and all about the depot and the tour's next target. The points `ahead`,
    `strides` units of the scene from one to the next, show bends before they are reached.
    """
    point, towards = np.empty(3), np.empty(3)
    for i in which:
        w = scene_of(world, i)
        direction, heading = approach.direction[i], approach.heading[i]
        left, chosen = query_row(way, q[i], direction)
        approach.distance[i] = left
        heading[:] = direction
        if chosen == len(way.points) - 1:
            change, speed = world.a_max[w, 0] * world.slot, norm(v[i])
            braking = speed**2 / (2 * world.a_max[w, 0])
            near, far = aim_row(goal, radius, change, braking, q[i], v[i], heading)
        else:
            near, far = stretch_row(way, goal, radius, left)
        approach.near[i], approach.far[i] = near, far
        approach.closing[i] = dot(v[i], heading)
        for k in range(3):
            approach.offset[i, k] = goal[k] - q[i, k]
            point[k], towards[k] = q[i, k], direction[k]
        for a in range(len(strides)):
            if a > 0:
                left, _ = query_row(way, point, towards)
            for k in range(3):
                point[k] += towards[k] * min(strides[a] * world.unit[w, 0], left)
                approach.ahead[i, a, k] = point[k] - q[i, k]
        frame_row(heading, approach.frame[i])
