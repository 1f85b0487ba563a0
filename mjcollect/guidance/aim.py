"""Where in a goal's ball to fly to, and where a body has room."""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene

AIM_ROOM = 2.0  # metres wanted between an aim and boxes or bounds
AIM_SHARE = 0.7  # of the tolerance: how far an aim may lie from its goal
TURN_SHARE = 0.6  # of the tolerance: how far an aim is moved towards the inside of the tour's turn


def choose_aim(
    scene: Scene, goal: Array, tolerance: float, start: Array, next_goal: Array | None
) -> Array:
    """The point (3,) of a goal's ball to fly to.

    On a tour, towards the inside of its turn, where the way there and the way on are shortest
    together, if there is room; else `feasible_aim`.
    """
    if next_goal is not None:
        before, after = goal - start, next_goal - goal
        far = np.linalg.norm(before), np.linalg.norm(after)
        if min(far) > 2 * tolerance:
            turn = after / far[1] - before / far[0]
            size = float(np.linalg.norm(turn))
            aim = goal + turn / max(size, 1e-9) * TURN_SHARE * tolerance * min(size, 1.0)
            if room_at(scene, aim[None])[0] >= AIM_ROOM:
                return np.asarray(aim)
    return feasible_aim(scene, goal, tolerance)


def place(scene: Scene, node: int) -> Array:
    """Where a body (3,) can be for a node: there, or in its ball where a box is too close to it."""
    point = scene.point(node)
    if room_to_boxes(scene, point[None])[0] >= 0.0:
        return point
    return feasible_aim(scene, point, scene.tolerance(node))


def room_at(scene: Scene, points: Array) -> Array:
    """Metres (P,) between the body at points (P, 3) and the nearest box or bound."""
    low, high = scene.bounds
    walls = np.minimum(points - low, high - points).min(axis=1)
    return np.minimum(walls, room_to_boxes(scene, points))


def room_to_boxes(scene: Scene, points: Array) -> Array:
    """Metres (P,) between the body at points (P, 3) and the nearest box."""
    if not len(scene.obstacles):
        return np.full(len(points), np.inf)
    gap = point_box_distance(points[:, None], scene.obstacles).min(axis=1)
    return np.asarray(gap - scene.uav_radius)


def feasible_aim(scene: Scene, goal: Array, tolerance: float) -> Array:
    """The point (3,) of a goal's ball to fly to: the goal, or where there is room around it.

    Nearest to the goal among those with the most room, up to AIM_ROOM metres, to boxes (beyond
    the body's radius) and to the bounds: an approach must not have to be exact to a millimetre
    where a wall is behind the goal, as at a depot in the corner of the cube.
    """
    steps = np.linspace(-AIM_SHARE, AIM_SHARE, 25) * tolerance
    ball = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    far = np.linalg.norm(ball, axis=1)
    near_first = np.argsort(far, kind="stable")
    near_first = near_first[far[near_first] <= AIM_SHARE * tolerance * (1 + 1e-9)]
    points = goal + ball[near_first]
    room = np.minimum(room_at(scene, points), AIM_ROOM)
    best = float(room.max())
    return np.asarray(points[int(np.argmax(room >= best - 1e-9))])
