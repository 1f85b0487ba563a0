"""Computes a provable lower bound on the time until the last of several UAVs is home."""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.compiled import Array, compiled, plain
from mjcollect.planners.assignment import exact_assignment, makespan
from mjcollect.scene.bounds import EXACT, leg_bounds
from mjcollect.scene.order import MAX_EXACT
from mjcollect.scene.scene import Scene

FORESTS = "forest-subgradient"
_ROUNDS = 300  # The subgradient method takes so many rounds.
_STEP = 0.1  # Its first step, in shares of the mean leg; steps fall to nothing.
_MARGIN = 1e-9  # Bounds are lowered by this share, more than the sums can lose to rounding.


def fleet_bound(scene: Scene, uavs: int) -> tuple[float, str]:
    """Returns a lower bound in s on the makespan of `uavs` UAVs, and the method's name.

    Segments take at least their `leg_bounds`. Up to MAX_EXACT items the bound is the least makespan
    with these, exactly. Above, it is the greater of two: the farthest item must be flown to and
    back from; and the last UAV takes no less than the mean of all tours, whose sum is no less than
    that of a forest (see `tours_bound`).
    """
    cost = leg_bounds(scene)
    if len(cost) - 1 <= MAX_EXACT:
        return makespan(cost, exact_assignment(cost, uavs)), EXACT
    farthest = float((cost[0, 1:] + cost[1:, 0]).max())
    used = range(1, min(uavs, len(cost) - 1) + 1)
    mean = min(tours_bound(cost, count) / count for count in used)
    return max(farthest, mean) * (1 - _MARGIN), FORESTS


def tours_bound(cost: Array, count: int) -> float:
    """Returns a lower bound in s on the sum of `count` tours, each of an item or more.

    K items in n tours are joined by K - n legs, and n legs lead out and n home. A forest of so many
    legs, with the n cheapest ways out and home, costs no more. As in `bounds.mission_bound` a price
    on every end of a leg at an item, refunded twice, changes no tours' cost.
    """
    out, home, between = cost[0, 1:], cost[1:, 0], plain(cost[1:, 1:])
    items = len(between)
    price, best, degree = np.zeros(items), 0.0, np.empty(items)
    stride = _STEP * float(cost.mean())
    for step in range(_ROUNDS):
        forest = spanning_forest(between + price[:, None] + price, count, degree)
        ways = 0.0
        for leg in (out + price, home + price):
            first = np.argsort(leg, kind="stable")[:count]
            ways += float(leg[first].sum())
            degree[first] += 1.0
        best = max(best, forest + ways - 2 * float(price.sum()))
        price = price + stride * (1.0 - step / _ROUNDS) * (degree - 2.0)
    return best


@compiled
def spanning_forest(weight: Array, parts: int, degree: Array) -> float:
    """Returns the least weight of a forest of `parts` trees; writes the `degree` (K,) of nodes.

    It is the least spanning tree (Prim) without its `parts` - 1 heaviest edges.
    """
    count = len(weight)
    nearest, link, outside = weight[0].copy(), np.zeros(count, np.int64), np.ones(count)
    outside[0], degree[:] = 0.0, 0.0
    edges, ends = np.empty(count - 1), np.empty((count - 1, 2), np.int64)
    for edge in range(count - 1):
        node = -1
        for other in range(count):
            if outside[other] > 0.0 and (node < 0 or nearest[other] < nearest[node]):
                node = other
        edges[edge], ends[edge, 0], ends[edge, 1] = nearest[node], node, link[node]
        outside[node] = 0.0
        for other in range(count):
            if outside[other] > 0.0 and weight[node, other] < nearest[other]:
                nearest[other], link[other] = weight[node, other], node
    total, order = 0.0, np.argsort(edges)
    for k in range(count - parts):
        total += edges[order[k]]
        degree[ends[order[k], 0]] += 1.0
        degree[ends[order[k], 1]] += 1.0
    return total
