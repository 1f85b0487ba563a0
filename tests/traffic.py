"""Fleets among boxes: where they start, commands that lead them together, how near they come."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
from crowds import RADIUS, gaps

from mjcollect.envs.course import Course
from mjcollect.scene.scene import Scene

ARENA = np.array([[0.0, 0.0, 0.0], [90.0, 20.0, 20.0]])


def arena(seed, boxes=8, **fields) -> Scene:
    """A narrow hall with boxes, in whose corners the depot and the item are hard to hit."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(ARENA[0], ARENA[1] - 3, (boxes, 3))
    high = np.minimum(low + rng.uniform(2, 12, (boxes, 3)), ARENA[1])
    obstacles = np.stack([low, high], axis=1)
    free = [gaps(ARENA, box[None]).min() > 3 for box in obstacles]
    tight = {"epsilon": 0.02, "return_tolerance": 0.02}
    return Scene("arena", seed, ARENA, ARENA[0], ARENA[1:], obstacles[free], **tight, **fields)


def among(course: Course, scene: Scene) -> Course:
    """A course as it is, but flown among the boxes of another scene, of which it knows nothing."""
    other = copy.copy(course)
    object.__setattr__(other, "scene", scene)
    return other


def blind_course(**fields) -> Course:
    """A course through an arena without boxes, for `among`."""
    return Course(dataclasses.replace(arena(0, **fields), obstacles=[]), (-1, 0))


def free_places(rng, scene, uavs, apart=None) -> np.ndarray:
    """Places (M, 3) clear of boxes that keep apart."""
    found: list[np.ndarray] = []
    while len(found) < uavs:
        place = rng.uniform(*scene.bounds)
        near = [np.linalg.norm(place - other) for other in found]
        if gaps(place[None], scene.obstacles)[0] > RADIUS + 0.01 and all(
            gap > (apart or scene.apart) + 0.01 for gap in near
        ):
            found.append(place)
    return np.array(found)


def chase(q, uavs) -> np.ndarray:
    """Raw actions (N, 3) of UAVs that fly at the nearest other one of their fleet."""
    fleets = q.reshape(-1, uavs, 3)
    offset = fleets[:, None] - fleets[:, :, None]
    far = np.linalg.norm(offset, axis=3) + 1e9 * np.eye(uavs)
    nearest = far.argmin(axis=2)
    towards = np.take_along_axis(offset, nearest[:, :, None, None], axis=2)[:, :, 0]
    towards = 3 * towards / np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    return towards.reshape(-1, 3)


def pair_gaps(one, other) -> np.ndarray:
    """Least distance (T - 1,) of two bodies that fly straight from row to row of (T, 3).

    The squared distance is a parabola in time, least at its vertex or at an end.
    """
    begin, end = (one - other)[:-1], (one - other)[1:]
    a = ((end - begin) ** 2).sum(axis=1)
    b = 2 * (begin * (end - begin)).sum(axis=1)
    c = (begin**2).sum(axis=1)
    vertex = np.divide(-b, 2 * a, out=np.zeros_like(a), where=a > 0)
    least = np.minimum(c, (end**2).sum(axis=1))
    inside = (vertex > 0) & (vertex < 1)
    at = ((begin + vertex[:, None] * (end - begin)) ** 2).sum(axis=1)
    return np.sqrt(np.where(inside, np.minimum(at, least), least))


def least_pair_gap(path, uavs) -> float:
    """Least distance between two UAVs of a fleet, anywhere on paths (N, T, 3)."""
    found = [
        pair_gaps(path[first + i], path[first + j]).min()
        for first in range(0, len(path), uavs)
        for i in range(uavs)
        for j in range(i)
    ]
    return float(min(found))
