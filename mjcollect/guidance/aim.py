"""Chooses the point of a goal's ball to fly to, and measures the clearance of a body."""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.among_boxes import gap_to_boxes
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene

# Clearance wanted between the body at an aim and boxes or bounds, in units of the scene.
AIM_ROOM = 2.0
AIM_SHARE = 0.7  # An aim lies at most this share of the tolerance from its goal.
TURN_SHARE = 0.6  # An aim moves by up to this share of the tolerance to the inside of a turn.


def choose_aim(
    scene: Scene, goal: Array, tolerance: float, start: Array, next_goal: Array | None
) -> Array:
    """Returns the aim, the point (3,) of a goal's ball to fly to.

    On a tour it lies towards the inside of the tour's turn, where the way there and the way on are
    shortest together, if there is clearance; else it is the `feasible_aim`.
    """
    if next_goal is not None:
        before, after = goal - start, next_goal - goal
        far = np.linalg.norm(before), np.linalg.norm(after)
        if min(far) > 2 * tolerance:
            turn = after / far[1] - before / far[0]
            size = float(np.linalg.norm(turn))
            aim = goal + turn / max(size, 1e-9) * TURN_SHARE * tolerance * min(size, 1.0)
            if room_at(scene, aim[None])[0] >= AIM_ROOM * scene.unit:
                return np.asarray(aim)
    return feasible_aim(scene, goal, tolerance)


def place(scene: Scene, node: int) -> Array:
    """Returns where (3,) a body can be for a node: at it, or in its ball if a box is too close."""
    point = scene.point(node)
    if room_to_boxes(scene, point[None])[0] >= 0.0:
        return point
    return feasible_aim(scene, point, scene.tolerance(node))


def room_at(scene: Scene, points: Array, most: float = np.inf) -> Array:
    """Returns the metres (P,) from the body at points (P, 3) to the nearest box or bound.

    If it is more than `most`, any number beyond that may stand for it.
    """
    low, high = scene.bounds
    walls = np.minimum(points - low, high - points).min(axis=1)
    return np.minimum(walls, room_to_boxes(scene, points, most))


def room_to_boxes(scene: Scene, points: Array, most: float = np.inf) -> Array:
    """Returns the metres (P,) from the body at points (P, 3) to the nearest box; see `room_at`."""
    beyond = 1.0  # metres, so that rounding does not matter
    return gap_to_boxes(points, scene.tree, scene.reach + most + beyond) - scene.reach


def feasible_aim(scene: Scene, goal: Array, tolerance: float) -> Array:
    """Returns the goal, or the point (3,) of its ball to fly to where the goal lacks clearance.

    It is nearest to the goal among those with most clearance, up to AIM_ROOM, from boxes
    (beyond the body's radius) and bounds: else an approach would have to be exact to a millimetre
    where a wall is behind the goal, as at a depot in the corner of the cube.
    """
    steps = np.linspace(-AIM_SHARE, AIM_SHARE, 25) * tolerance
    ball = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    far = np.linalg.norm(ball, axis=1)
    near_first = np.argsort(far, kind="stable")
    near_first = near_first[far[near_first] <= AIM_SHARE * tolerance * (1 + 1e-9)]
    points = goal + ball[near_first]
    wanted = AIM_ROOM * scene.unit
    clearance = np.minimum(room_at(scene, points, wanted), wanted)
    best = float(clearance.max())
    return np.asarray(points[int(np.argmax(clearance >= best - 1e-9))])
