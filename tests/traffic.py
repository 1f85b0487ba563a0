"""Fleets among boxes: where they start, commands that lead them together, how near they come."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
from crowds import RADIUS, box_gap, gaps

from mjcollect.envs.batch import Simulations
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


WIDTH = 24.0  # of a hall, which is as high


def hall(places, boxes, length=180.0, **fields) -> Scene:
    """A long hall with items where flights begin and end."""
    bounds = [[0.0, 0.0, 0.0], [length, WIDTH, WIDTH]]
    places = np.array(places, dtype=float)
    boxes = np.array(boxes, dtype=float).reshape(-1, 2, 3)
    return Scene("hall", 0, bounds, places[0], places, boxes, **fields)


def wall(begin, end, half) -> list:
    """Boxes that close the hall between two x (m) but for a hole of half a width round the axis."""
    low, high = WIDTH / 2 - half, WIDTH / 2 + half
    return [
        [[begin, 0, 0], [end, WIDTH, low]],
        [[begin, 0, high], [end, WIDTH, WIDTH]],
        [[begin, 0, low], [end, low, high]],
        [[begin, high, low], [end, WIDTH, high]],
    ]


def street(seed, uavs, count=12, gap=4.0, **fields) -> tuple[Scene, list[tuple[int, int]]]:
    """A hall crowded with boxes that keep `gap` metres apart, and flights in it both ways."""
    rng, size = np.random.default_rng(seed), np.array([150.0, 22.0, 22.0])
    ends: list[np.ndarray] = []
    while len(ends) < 2 * uavs:
        x = rng.uniform(3, 10) if len(ends) < uavs else rng.uniform(140, 147)
        place = np.array([x, *rng.uniform(2, 20, 2)])
        if all(np.linalg.norm(place - other) > 9 for other in ends):
            ends.append(place)
    boxes: list[np.ndarray] = []
    for _ in range(4000):
        low = rng.uniform([18, -8, -8], [125, 18, 18])
        box = np.clip([low, low + rng.uniform(4, 18, 3)], [18, 0, 0], [132, 22, 22])
        rims = np.concatenate([box[0], size - box[1]])
        if np.any(box[1] - box[0] < 1.5) or np.any((rims > 0) & (rims < gap)):
            continue
        if all(box_gap(box, other) >= gap for other in boxes) and len(boxes) < count:
            boxes.append(box)
    goals = uavs + rng.permutation(uavs)
    pairs = [(i, int(j)) if i % 2 == 0 else (int(j), i) for i, j in enumerate(goals)]
    bounds = np.array([np.zeros(3), size])
    return Scene("street", seed, bounds, ends[0], ends, np.array(boxes), **fields), pairs


class LawFlights:
    """One fleet flown by the law, until all are home.

    Attributes:
        path: (M, T, 3) at every physics step. slots: (M,) until each was home, 0 for never.
        asked: pairs (who makes room, for whom) that came up. crashed: whether any slot did.
        gap: least distance of two UAVs.
    """

    def __init__(self, courses, most, starts=None):
        uavs = len(courses)
        sims = Simulations(courses, uavs, uavs=uavs, threads=1)
        sims.reset()
        if starts is not None:
            sims.place(np.arange(uavs), np.array(starts, dtype=float), np.zeros((uavs, 3)))
        paths, self.asked = [sims.episodes.q[:, None].copy()], set()
        self.slots, self.crashed = np.zeros(uavs, dtype=int), False
        for slot in range(1, most + 1):
            outcome = sims.step(sims.law())
            paths.append(sims.path.copy())
            self.slots[outcome.success & (self.slots == 0)] = slot
            self.crashed |= bool(outcome.slot.crashed.any() or outcome.struck.any())
            if uavs > 1:
                whom = sims.episodes.traffic.asked_by.astype(int).tolist()
                self.asked |= {(row, other) for row, other in enumerate(whom) if other >= 0}
            if (self.slots > 0).all():
                break
        sims.close()
        self.path = np.concatenate(paths, axis=1)
        self.gap = least_pair_gap(self.path, uavs) if uavs > 1 else np.inf
