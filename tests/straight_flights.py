"""Straight flights from rest to rest, made by hand, and what breaks them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

STEP, SLOT_ROWS = 0.02, 10
ITEMS = [[300.0, 0, 0], [300, 400, 0], [0, 400, 300]]
ORDER = (0, 1, 2)
WALL = [[100.0, 0.6, 0], [200, 10, 10]]  # 0.6 m beside the first segment


def scene(**fields) -> Scene:
    fields = {"obstacles": [WALL]} | fields
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0] * 3, ITEMS, **fields)


def bang_bang(distance: float) -> np.ndarray:
    """Accelerations (R,) along a line, rest to rest over exactly `distance`."""
    peak = min(50.0, np.sqrt(20.0 * distance))
    half = int(np.ceil(peak / 20.0 / STEP))
    cruise = max(0, int(np.floor(distance / (peak * STEP))) - half)
    # Displacement is a STEP^2 half (half + cruise): scaled down to fit exactly.
    a = distance / (STEP**2 * half * (half + cruise))
    while a > 20.0 or a * half * STEP > 50.0:
        cruise += 1
        a = distance / (STEP**2 * half * (half + cruise))
    return np.concatenate([np.full(half, a), np.zeros(cruise), np.full(half, -a)])


def fly(points) -> Trajectory:
    """Straight rest-to-rest flight through points, by the recursion of the contract."""
    points = np.asarray(points, float)
    a = []
    for start, end in pairwise(points):
        length = np.linalg.norm(end - start)
        a.append(bang_bang(length)[:, None] * (end - start) / length)
    a = np.concatenate([*a, np.zeros((1, 3))])
    v = np.concatenate([np.zeros((1, 3)), np.cumsum(a[:-1] * STEP, axis=0)])
    v[np.linalg.norm(v, axis=1) < 1e-9] = 0.0
    x = points[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(v[1:] * STEP, axis=0)])
    return Trajectory(np.arange(len(a)) * STEP, x, v, a)


def mission(order=ORDER) -> Trajectory:
    return fly([[0, 0, 0], *(ITEMS[item] for item in order), [0, 0, 0]])


def edited(flight: Trajectory, part: str, row: int, value) -> Trajectory:
    array = getattr(flight, part).copy()
    array[row] = value
    return replace(flight, **{part: array})


def cut(flight: Trajectory, first: int, last: int) -> Trajectory:
    """Rows first..last, renumbered from t = 0, at the end without a push."""
    a = flight.a[first:last].copy()
    a[-1] = 0.0
    t = np.arange(last - first) * STEP
    return Trajectory(t, flight.x[first:last], flight.v[first:last], a)
