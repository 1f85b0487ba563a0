"""Computes provable lower bounds on the time of a segment and of a mission.

From rest to rest, a distance d takes at least d/v + v/a seconds, or 2 sqrt(d/a) where the speed
limit is never reached. A stop may lie anywhere in a ball, which shortens a segment by that ball's
radius; boxes can only lengthen it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mjcollect.geometry.compiled import Array, Indices
from mjcollect.scene.order import DEPOT, distances
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import MAX_EXACT, held_karp

EXACT, RELAXED = "held-karp-exact", "one-tree-subgradient"
_ROUNDS = 400  # The subgradient method takes at most so many rounds.
_PATIENCE = 12  # The method's step is halved after so many rounds without a better bound.
_MARGIN = 1e-9  # Bounds are lowered by this share, more than the sums can lose to rounding.


def leg_time(distance: ArrayLike, v_max: float, a_max: float) -> Array:
    """Returns the least time (...) in s from rest to rest over straight `distance` (...) in m."""
    d = np.asarray(distance, dtype=np.float64)
    return np.where(d >= v_max**2 / a_max, d / v_max + v_max / a_max, 2 * np.sqrt(d / a_max))


def segment_bound(scene: Scene, start_node: int, end_node: int) -> float:
    """Returns a lower bound in s on the segment between two nodes (the depot is -1)."""
    length = float(np.linalg.norm(scene.point(end_node) - scene.point(start_node)))
    return detour_bound(scene, start_node, end_node, length)


def detour_bound(scene: Scene, start_node: int, end_node: int, length: float) -> float:
    """Returns `segment_bound` with a path's `length` in m in place of the straight distance.

    For the shortest path found among the boxes this is no longer a bound, but a good estimate.
    """
    margin = (0.0 if start_node == DEPOT else scene.epsilon) + scene.tolerance(end_node)
    return float(leg_time(max(0.0, length - margin), scene.v_max, scene.a_max))


def mission_bound(scene: Scene) -> tuple[float, str]:
    """Returns a lower bound in s on the mission, whatever its order, and the method's name.

    Up to 12 items it is the least sum of segment bounds over all orders, exactly. Above, it is a
    relaxation that never exceeds that sum (Held and Karp 1970, on the items; the two depot segments
    stand apart, because `return_tolerance` shortens only the return).
    """
    cost = leg_bounds(scene)
    if len(scene.items) <= MAX_EXACT:
        return held_karp(cost)[0], EXACT
    return _one_tree(cost), RELAXED


def leg_bounds(scene: Scene, depots: Array | None = None, beside: float = 0.0) -> Array:
    """Returns the segment bounds (D+K, D+K) in s, from row to column, the depots first.

    Args:
        scene: K items.
        depots: (D, 3) m; the scene's depot if None. Between them nothing is flown.
        beside: metres from their depot within which UAVs start, which shortens the legs out.
    """
    count = 1 if depots is None else len(depots)
    margin = np.full((len(scene.items) + count,) * 2, 2 * scene.epsilon)
    margin[:count, :] = scene.epsilon + beside
    margin[:, :count] = scene.epsilon + scene.return_tolerance
    straight = distances(scene, depots)
    return leg_time(np.maximum(0.0, straight - margin), scene.v_max, scene.a_max)


def _one_tree(cost: Array) -> float:
    """Returns the greatest lower bound found on the cheapest tour, see `mission_bound`.

    A tour is a spanning path of the items plus a segment out and one home: two segments end at
    every item. The least spanning tree plus the cheapest two depot segments at different items
    costs no more. A price on every segment's end at an item, refunded twice, changes no tour's
    cost; prices are raised where the relaxation has more than two ends, and lowered where fewer.
    """
    out, home, between = cost[0, 1:], cost[1:, 0], cost[1:, 1:]
    count = len(between)
    price, step, best, stale = np.zeros(count), 1.0, -np.inf, 0
    target = _nearest_neighbour_tour(cost)
    for _ in range(_ROUNDS):
        legs, ends = spanning_tree(between + price[:, None] + price)
        degree = np.bincount(ends.ravel(), minlength=count)
        pair = (out + price)[:, None] + (home + price)
        np.fill_diagonal(pair, np.inf)
        first, last = np.unravel_index(np.argmin(pair), pair.shape)
        degree[first] += 1
        degree[last] += 1
        bound = sum(legs.tolist()) + float(pair[first, last]) - 2 * float(np.sum(price))
        if bound > best:
            best, stale = bound, 0
        else:
            stale += 1
        if stale == _PATIENCE:
            step, stale = step / 2, 0
        excess = degree - 2
        if not np.any(excess):  # the relaxed solution is a tour: no bound is greater
            break
        price = price + step * max(target - bound, 0.0) / np.sum(excess**2) * excess
    return max(0.0, best * (1 - _MARGIN) - _MARGIN)


def spanning_tree(weight: Array) -> tuple[Array, Indices]:
    """Returns weights (K - 1,) and ends (K - 1, 2) of the least spanning tree's edges (Prim)."""
    count = len(weight)
    edges, ends = np.empty(count - 1), np.empty((count - 1, 2), dtype=np.intp)
    nearest, link = weight[0].copy(), np.zeros(count, dtype=np.int64)
    nearest[0] = np.inf
    outside = np.ones(count, dtype=bool)
    outside[0] = False
    for edge in range(count - 1):
        node = int(np.argmin(nearest))
        edges[edge], ends[edge] = nearest[node], (node, link[node])
        outside[node] = False
        nearest[node] = np.inf
        closer = outside & (weight[node] < nearest)
        nearest[closer] = weight[node, closer]
        link[closer] = node
    return edges, ends


def _nearest_neighbour_tour(cost: Array) -> float:
    """Returns the cost of a tour to the nearest node left each time; it only scales the steps."""
    node, total, left = 0, 0.0, np.ones(len(cost), dtype=bool)
    left[0] = False
    while np.any(left):
        following = int(np.argmin(np.where(left, cost[node], np.inf)))
        total += float(cost[node, following])
        node, left[following] = following, False
    return total + float(cost[node, 0])
