"""Flat scenes with boxes strewn at random, and brute-force distances to their boxes."""

from __future__ import annotations

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.scene.scene import Scene

FLAT = np.array([[0.0, 0.0, 0.0], [400.0, 60.0, 60.0]])
GAP = 6.0  # metres between boxes, and from them to the bounds unless they lie against them
RADIUS = 0.5


def crowded(seed, count, **fields) -> Scene:
    """A depot, one item 360 to 380 m away, and up to `count` boxes between them."""
    rng = np.random.default_rng(seed)
    ends = np.array([[10.0, 30, 30], [rng.uniform(370, 390), *rng.uniform(8, 52, 2)]])
    boxes = []
    for _ in range(40 * count):
        low = rng.uniform([25, -10, -10], [350, 55, 55])
        box = np.clip([low, low + rng.uniform(6, 35, 3)], *FLAT)
        wall = np.concatenate([box[0] - FLAT[0], FLAT[1] - box[1]])
        if np.any(box[1] - box[0] < 2) or np.any((wall > 0) & (wall < GAP)):
            continue
        others = [*boxes, *np.repeat(ends[:, None], 2, axis=1)]
        if all(box_gap(box, other) >= GAP for other in others):
            boxes.append(box)
        if len(boxes) == count:
            break
    boxes = np.array(boxes).reshape(-1, 2, 3)
    return Scene("crowded", seed, FLAT, ends[0], ends[1:], boxes, **fields)


def box_gap(one, other) -> float:
    """Distance between two boxes (2, 3)."""
    return float(np.linalg.norm(np.maximum(np.maximum(one[0] - other[1], other[0] - one[1]), 0.0)))


def gaps(points, boxes) -> np.ndarray:
    """Distance (N,) of each of points (N, 3) to the nearest box."""
    over = [np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0) for box in boxes]
    return np.min([np.linalg.norm(gap, axis=1) for gap in over], axis=0, initial=np.inf)


def dense(path, spacing=0.05) -> np.ndarray:
    """Points (N, 3) along a polyline, at most `spacing` metres apart."""
    steps = np.diff(path, axis=0)
    shares = np.linspace(0, 1, 2 + int(np.linalg.norm(steps, axis=1).max() / spacing))
    return (path[:-1, None] + shares[:, None] * steps[:, None]).reshape(-1, 3)


def least_gap(path, boxes, spacing=0.05) -> float:
    """Least distance of a densely sampled polyline to the boxes."""
    return float(gaps(dense(np.asarray(path), spacing), boxes).min())


class Flown:
    """Flights by the law from `ball` starts, or from places and speeds given, to their ends.

    Attributes:
        q: (N, T, 3) positions at every physics step, standing still after the end.
        won: (N,). slots: (N,) flown until then.
    """

    def __init__(self, course, count=16, start="ball", seed=0, places=None):
        sims = Simulations([course], count, start=start, rng=np.random.default_rng(seed), threads=1)
        sims.reset()
        if places is not None:
            sims.place(np.arange(count), *places)
        self.won, self.lost = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self.slots = np.zeros(count, dtype=int)
        self.fastest, self.hardest = 0.0, 0.0
        track = [sims.episodes.q[:, None].copy()]
        for _ in range(course.step_limit):
            going = ~(self.won | self.lost)
            if not going.any():
                break
            outcome = sims.step(sims.episodes.guidance_action())
            track.append(np.where(going[:, None, None], sims.path, track[-1][:, -1:]))
            self.slots += going
            self.won |= outcome.success & going
            self.lost |= outcome.slot.crashed & going
            self.fastest = max(self.fastest, np.linalg.norm(sims.speeds[going], axis=-1).max())
            self.hardest = max(
                self.hardest, np.linalg.norm(sims.acceleration[going], axis=-1).max()
            )
        sims.close()
        self.q = np.concatenate(track, axis=1)

    def least_gap(self, boxes) -> float:
        """Least distance of all flights to the boxes, at points at most 0.25 m apart."""
        return min(least_gap(track, boxes, spacing=0.25) for track in self.q)

    def farthest_outside(self, bounds) -> float:
        """Metres by which any position lies outside the bounds; negative inside."""
        return float(np.maximum(bounds[0] - self.q, self.q - bounds[1]).max())
