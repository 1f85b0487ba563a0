"""Provable lower bounds on the time of a segment and of a mission.

Rest to rest over a distance d takes at least d/v + v/a, or 2 sqrt(d/a) when the speed limit is
never reached. A stop may lie anywhere in a ball, which shortens a leg by that ball's radius; boxes
can only lengthen it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mjcollect.geometry.compiled import Array
from mjcollect.scene.order import DEPOT, MAX_EXACT, distances, held_karp
from mjcollect.scene.scene import Scene

EXACT, RELAXED = "held-karp-exact", "one-tree-subgradient"
_ROUNDS = 400  # of the subgradient method
_PATIENCE = 12  # rounds without a better bound before its step is halved
_HAIR = 1e-9  # relative; more than the sums above it can lose to rounding


def leg_time(distance: ArrayLike, v_max: float, a_max: float) -> Array:
    """Least time in s from rest to rest over straight `distance` (...) in metres. Shape (...)."""
    d = np.asarray(distance, dtype=np.float64)
    return np.where(d >= v_max**2 / a_max, d / v_max + v_max / a_max, 2 * np.sqrt(d / a_max))


def segment_bound(scene: Scene, frm: int, to: int) -> float:
    """Lower bound in s on the segment between nodes `frm` and `to` (depot -1)."""
    length = float(np.linalg.norm(scene.point(to) - scene.point(frm)))
    return detour_bound(scene, frm, to, length)


def detour_bound(scene: Scene, frm: int, to: int, length: float) -> float:
    """`segment_bound` with a path's `length` in metres in place of the straight distance.

    Of a shortest path among the boxes it is a bound no more, but a good estimate.
    """
    slack = (0.0 if frm == DEPOT else scene.epsilon) + scene.tolerance(to)
    return float(leg_time(max(0.0, length - slack), scene.v_max, scene.a_max))


def mission_bound(scene: Scene) -> tuple[float, str]:
    """Lower bound in s on the whole mission, whatever the order flown, and the method's name.

    Up to 12 items the least sum of segment bounds over all orders, exactly; above, a relaxation
    that never exceeds it (Held and Karp 1970, on the items, with the two depot legs apart because
    only the return is shortened by `return_tolerance`).
    """
    cost = _leg_bounds(scene)
    if len(scene.items) <= MAX_EXACT:
        return held_karp(cost)[0], EXACT
    return _one_tree(cost), RELAXED


def _leg_bounds(scene: Scene) -> Array:
    """(K+1, K+1) segment bounds in s, from row to column, depot first."""
    slack = np.full((len(scene.items) + 1,) * 2, 2 * scene.epsilon)
    slack[0, :] = scene.epsilon
    slack[:, 0] = scene.epsilon + scene.return_tolerance
    return leg_time(np.maximum(0.0, distances(scene) - slack), scene.v_max, scene.a_max)


def _one_tree(cost: Array) -> float:
    """Greatest found lower bound on the cheapest tour; see `mission_bound`.

    A tour is a spanning path of the items plus a leg out and a leg home, with two legs at every
    item. The least spanning tree plus the cheapest two depot legs at different items costs no
    more, and a price on every leg's end at an item, refunded twice, changes no tour's cost.
    """
    out, home, between = cost[0, 1:], cost[1:, 0], cost[1:, 1:]
    count = len(between)
    price, step, best, stale = np.zeros(count), 1.0, -np.inf, 0
    target = _nearest_neighbour_tour(cost)
    for _ in range(_ROUNDS):
        tree, degree = _spanning_tree(between + price[:, None] + price)
        pair = (out + price)[:, None] + (home + price)
        np.fill_diagonal(pair, np.inf)
        first, last = np.unravel_index(np.argmin(pair), pair.shape)
        degree[first] += 1
        degree[last] += 1
        bound = tree + float(pair[first, last]) - 2 * float(np.sum(price))
        if bound > best:
            best, stale = bound, 0
        else:
            stale += 1
        if stale == _PATIENCE:
            step, stale = step / 2, 0
        excess = degree - 2
        if not np.any(excess):  # the relaxed solution is a tour: nothing left to gain
            break
        price = price + step * max(target - bound, 0.0) / np.sum(excess**2) * excess
    return max(0.0, best * (1 - _HAIR) - _HAIR)


def _spanning_tree(weight: Array) -> tuple[float, Array]:
    """Least spanning tree (Prim): its weight and the degree (K,) of every node."""
    count = len(weight)
    degree = np.zeros(count)
    nearest, link = weight[0].copy(), np.zeros(count, dtype=np.int64)
    nearest[0] = np.inf
    outside = np.ones(count, dtype=bool)
    outside[0] = False
    total = 0.0
    for _ in range(count - 1):
        node = int(np.argmin(nearest))
        total += float(nearest[node])
        degree[node] += 1
        degree[link[node]] += 1
        outside[node] = False
        nearest[node] = np.inf
        closer = outside & (weight[node] < nearest)
        nearest[closer] = weight[node, closer]
        link[closer] = node
    return total, degree


def _nearest_neighbour_tour(cost: Array) -> float:
    """Cost of a tour that always goes to the nearest node left: only scales the steps."""
    node, total, left = 0, 0.0, np.ones(len(cost), dtype=bool)
    left[0] = False
    while np.any(left):
        following = int(np.argmin(np.where(left, cost[node], np.inf)))
        total += float(cost[node, following])
        node, left[following] = following, False
    return total + float(cost[node, 0])
