"""Computes what the visiting order alone is worth: with straight segments, nothing flown.

The bound of an order is the sum of its segments' lower bounds (`mjcollect.scene.bounds`): straight
distance, stops anywhere in the balls.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.scene.bounds import leg_bounds, leg_time, segment_bound
from mjcollect.scene.order import tour_segments
from mjcollect.scene.scene import Scene

MOST = 8  # items of a random instance
EXTENT, SPACING = 1000.0, 20.0  # m: the paper's cube, and the generator's least distance
V_MAX, A_MAX, EPSILON = 50.0, 20.0, 5.0  # the paper's
CHUNK = 2_000  # instances worked on at once, for the memory's sake


def order_bound(scene: Scene, order: tuple[int, ...]) -> float:
    """Return the lower bound in s on a mission flown in `order`."""
    return sum(segment_bound(scene, frm, to) for frm, to in tour_segments(order))


def all_bounds(scene: Scene) -> Array:
    """Return the bounds (K!,) in s of every order, sorted; for up to 8 items or so."""
    cost = leg_bounds(scene)
    orders = np.array(list(itertools.permutations(range(1, len(cost)))))
    depot = np.zeros((len(orders), 1), dtype=int)
    stops = np.hstack([depot, orders, depot])
    return np.sort(cost[stops[:, :-1], stops[:, 1:]].sum(axis=1))


def spread(scene: Scene, order: tuple[int, ...]) -> dict[str, float]:
    """Return how the bounds of all orders of a scene are spread, in s.

    `share_as_long` is the share of all orders whose bound is at least that of `order`.
    """
    bounds = all_bounds(scene)
    low, high = np.percentile(bounds, [5, 95])
    return {
        "best": float(bounds[0]),
        "mean": float(bounds.mean()),
        "p5": float(low),
        "p95": float(high),
        "worst": float(bounds[-1]),
        "share_as_long": float(np.mean(bounds >= order_bound(scene, order) - 1e-9)),
    }


def study(instances: int, seed: int, paper_saving: float) -> dict[str, Any]:
    """Compare a random order with the best one, for K items drawn uniformly in the cube.

    An instance's item sets are nested, K = 1 to 8, as in the paper's sweep. Those with items
    nearer than 20 m to each other or to the depot are left out.

    Returns:
        For each K: mean ratio of random to best, saving (mean, 5th and 95th percentile); for
        K = 8 also a histogram and the share that saves at least `paper_saving`; and by how much
        the best bound rises from K = 6 to 8.
    """
    rng = np.random.default_rng(seed)
    best, drawn = [], []
    for begin in range(0, instances, CHUNK):
        points = rng.uniform(0.0, EXTENT, (min(CHUNK, instances - begin), MOST + 1, 3))
        points[:, 0] = 0.0
        far = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        far += np.where(np.eye(MOST + 1, dtype=bool), np.inf, 0.0)
        points = points[far.min(axis=(1, 2)) >= SPACING]
        cost = leg_costs(points)
        best.append(nested_best(cost))
        drawn.append(nested_given(cost))
    least, given = np.concatenate(best), np.concatenate(drawn)
    saving = 1.0 - least / given
    counts, edges = np.histogram(saving[:, -1], bins=np.linspace(0.0, 0.6, 61))
    rise = least[:, MOST - 1] - least[:, MOST - 3]
    by_items = [
        {
            "items": k + 1,
            "ratio": float((given[:, k] / least[:, k]).mean()),
            "saving": float(saving[:, k].mean()),
            "p5": float(np.percentile(saving[:, k], 5)),
            "p95": float(np.percentile(saving[:, k], 95)),
        }
        for k in range(MOST)
    ]
    return {
        "drawn": instances,
        "instances": len(least),
        "seed": seed,
        "items": by_items,
        "paper_saving": paper_saving,
        "share_paper_saving": float(np.mean(saving[:, -1] >= paper_saving)),
        "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
        "rise_6_to_8": {"least": float(rise.min()), "mean": float(rise.mean())},
    }


def leg_costs(points: Array) -> Array:
    """Return the segment bounds (B, N, N) in s between points (B, N, 3), the depot first."""
    distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    slack = np.full(distance.shape[1:], 2 * EPSILON)
    slack[0, :] = EPSILON
    return leg_time(np.maximum(distance - slack, 0.0), V_MAX, A_MAX)


def nested_given(cost: Array) -> Array:
    """Return the bounds (B, K) in s of the tours of the first 1 to K items in file order.

    Of items that were drawn at random, this order is a random one.
    """
    count = cost.shape[1] - 1
    index = np.arange(count)
    between = np.cumsum(cost[:, index, index + 1], axis=1)
    return np.asarray(between + cost[:, index + 1, 0])


def nested_best(cost: Array) -> Array:
    """Return the bounds (B, K) in s of the best tours of the first 1 to K items.

    This is Held and Karp's dynamic programme, for all instances at once.
    """
    batch, count = len(cost), cost.shape[1] - 1
    best = np.full((1 << count, batch, count), np.inf)  # [visited][instance, last]
    for item in range(count):
        best[1 << item, :, item] = cost[:, 0, item + 1]
    between = cost[:, 1:, 1:]
    for visited in range(1, 1 << count):
        for item in range(count):
            if not visited >> item & 1:
                ways = (best[visited] + between[:, :, item]).min(axis=1)
                best[visited | 1 << item, :, item] = ways
    home = cost[:, 1:, 0]
    done = [best[(2 << k) - 1, :, : k + 1] + home[:, : k + 1] for k in range(count)]
    return np.stack([ways.min(axis=1) for ways in done], axis=1)
