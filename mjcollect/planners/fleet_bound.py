"""Computes a provable lower bound on the time until the last of several UAVs is home."""

from __future__ import annotations

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.planners.assignment import exact_assignment, farthest, makespan
from mjcollect.scene.bounds import EXACT, leg_bounds, spanning_tree
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import MAX_EXACT

FORESTS = "forest-subgradient"
_ROUNDS = 300  # The subgradient method takes so many rounds.
_STEP = 0.1  # Its first step, in shares of the mean leg; steps fall to nothing.
_MARGIN = 1e-9  # Bounds are lowered by this share, more than the sums can lose to rounding.


def fleet_bound(scene: Scene, uavs: int) -> tuple[float, str]:
    """Returns a lower bound in s on the makespan of `uavs` UAVs, and the method's name.

    Segments take at least their `leg_bounds`. Up to MAX_EXACT items the bound is the least makespan
    with these, exactly, each UAV from its own depot. Above, it is the greater of two: the farthest
    item must be flown to and back from, by some UAV from its depot; and the last UAV takes no less
    than the mean of all tours, whose sum is no less than that of a forest (see `tours_bound`).
    """
    depots = min(uavs, len(scene.depots))  # Those that have no UAV count for nothing.
    # Several UAVs start at places of their own within the tolerance, see `fleet.share.parts`.
    beside = scene.return_tolerance if uavs > 1 else 0.0
    cost = leg_bounds(scene, scene.depots[:depots], beside)
    items = len(scene.items)
    if items <= MAX_EXACT:
        return makespan(cost, exact_assignment(cost, uavs, depots), depots), EXACT
    used = range(1, min(uavs, items) + 1)
    mean = min(tours_bound(cost, count, depots) / count for count in used)
    return max(farthest(cost, uavs, depots), mean) * (1 - _MARGIN), FORESTS


def tours_bound(cost: Array, count: int, depots: int = 1) -> float:
    """Returns a lower bound in s on the sum of `count` tours, each of an item or more.

    K items in n tours are joined by K - n legs, and n legs lead out and n home. A forest of so many
    legs, with the n cheapest ways out and home, costs no more. Of several depots each item has the
    one with the cheapest way out, and the one with the cheapest home, maybe another: whichever
    depots the tours have, their legs cost no less. As in `bounds.mission_bound` a price on every
    end of a leg at an item, refunded twice, changes no tours' cost.
    """
    between = cost[depots:, depots:]
    out, home = cost[:depots, depots:].min(axis=0), cost[depots:, :depots].min(axis=1)
    items = len(between)
    price, best = np.zeros(items), 0.0
    stride = _STEP * float(cost.mean())
    for step in range(_ROUNDS):
        forest, degree = spanning_forest(between + price[:, None] + price, count)
        ways = 0.0
        for leg in (out + price, home + price):
            first = np.argsort(leg, kind="stable")[:count]
            ways += float(leg[first].sum())
            degree[first] += 1.0
        best = max(best, forest + ways - 2 * float(price.sum()))
        price = price + stride * (1.0 - step / _ROUNDS) * (degree - 2.0)
    return best


def spanning_forest(weight: Array, parts: int) -> tuple[float, Array]:
    """Returns the least weight of a forest of `parts` trees, and the degree (K,) of every node.

    It is the least spanning tree without its `parts` - 1 heaviest edges.
    """
    edges, ends = spanning_tree(weight)
    kept = np.argsort(edges, kind="stable")[: len(weight) - parts]
    degree = np.bincount(ends[kept].ravel(), minlength=len(weight)).astype(float)
    return float(edges[kept].sum()), degree
