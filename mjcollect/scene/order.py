"""Orders the items to visit: by LKH as in the paper (section IV), or as other methods do.

A node is an item index, or -1 for the depot. An order of K items has K + 1 segments, each from one
stop to the next: segment 0 leaves the depot, segment K returns to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array, Indices
from mjcollect.scene.scene import Scene

ORDER_METHODS = ("lkh", "exact", "random", "given")
DEPOT = -1  # The depot is the node before the items 0, 1, ...
MAX_EXACT = 12  # The dynamic programme takes at most so many items K: it has 2^K K entries.
# LKH computes with 100 times the weights in 32-bit integers, so greater weights overflow. In a 1 km
# cube the unit of weights is then just below a millimetre.
_LONGEST_WEIGHT = 2_000_000
_LKH_RUNS = 10


class TourError(ValueError):
    """Says that no order can be made as asked; the message names method or order, and the fix."""


def plan_order(
    scene: Scene, method: str, *, seed: int = 0, cost: Array | None = None
) -> tuple[int, ...]:
    """Returns the visiting order of the items.

    Of a tour's two directions, `lkh`, `exact` and `random` return the one whose first item has the
    smaller index.

    Args:
        scene: K items.
        method: `lkh`; `exact` (dynamic programme, K <= 12, needs no elkai); `random`; `given`
            (file order); or the order itself as in '2,0,1'.
        seed: the seed of the random order.
        cost: (K+1, K+1) symmetric cost between nodes, depot first, for `lkh` and `exact`;
            straight distances in metres if None.

    Returns:
        The K item indices in order of visit.

    Raises:
        TourError: the method is unknown, the order is no permutation, there are too many items,
            elkai is not installed, or `cost` does not fit.
    """
    count = len(scene.items)
    if method not in ORDER_METHODS:
        return _explicit(method, count)
    if method == "given":
        return tuple(range(count))
    if method == "random":
        return _directed(np.random.default_rng(seed).permutation(count).tolist())
    cost = distances(scene) if cost is None else _checked(cost, count)
    if method == "exact":
        return _directed(held_karp(cost)[1])
    return _directed(lkh_order(cost))


def order_label(method: str) -> str:
    """Returns how results call a method: by its name, or 'explicit' for a listed order."""
    return method if method in ORDER_METHODS else "explicit"


def tour_segments(order: Sequence[int]) -> list[tuple[int, int]]:
    """Returns the K+1 segments (from, to) of an order; the depot is -1."""
    return list(zip([DEPOT, *order], [*order, DEPOT], strict=True))


def tour_length(scene: Scene, order: Sequence[int]) -> float:
    """Returns the length in m of the closed straight-line tour from the depot through the items."""
    stops = np.concatenate([[scene.depot], scene.items[list(order)], [scene.depot]])
    return float(np.sum(np.linalg.norm(np.diff(stops, axis=0), axis=1)))


def distances(scene: Scene, depots: Array | None = None) -> Array:
    """Returns the straight distances (D+K, D+K) in m; depots (D, 3) are first, or the depot."""
    nodes = np.concatenate([scene.depot[None] if depots is None else depots, scene.items])
    return np.asarray(np.linalg.norm(nodes[:, None] - nodes[None], axis=-1))


def held_karp(cost: Array) -> tuple[float, tuple[int, ...]]:
    """Returns the cheapest closed tour by the dynamic programme of Held and Karp (1962).

    Args:
        cost: (K+1, K+1), row = from, column = to, node 0 the depot; need not be symmetric.

    Returns:
        The tour's cost and its K items (0-based, so node minus one) in order.

    Raises:
        TourError: there are more than 12 items.
    """
    count = len(cost) - 1
    if count > MAX_EXACT:
        raise TourError(
            f"order exact: {count} items: takes at most {MAX_EXACT}; use --order lkh or given"
        )
    best, before = ways_through(cost)
    closed = best[-1] + cost[1:, 0]
    return float(np.min(closed)), way_back(before, (1 << count) - 1, int(np.argmin(closed)))


def ways_through(cost: Array) -> tuple[Array, Indices]:
    """Returns the cheapest ways from the depot through each set of items, (2^K, K) for each end.

    A set has bit k if item k is in it. With the costs come the items before the last ones, for
    `way_back`; `cost` is as in `held_karp`.
    """
    count = len(cost) - 1
    between, bits = cost[1:, 1:], 1 << np.arange(count)
    best = np.full((1 << count, count), np.inf)
    before = np.zeros((1 << count, count), dtype=np.intp)
    best[bits, np.arange(count)] = cost[0, 1:]
    for visited in range(1, (1 << count) - 1):
        free = np.flatnonzero(visited & bits == 0)
        ways = best[visited][:, None] + between[:, free]
        last = np.argmin(ways, axis=0)
        best[visited | bits[free], free] = ways[last, np.arange(len(free))]
        before[visited | bits[free], free] = last
    return best, before


def way_back(before: Indices, visited: int, last: int) -> tuple[int, ...]:
    """Returns the order of the cheapest way through a set of items to the `last` of them."""
    order = []
    while visited:
        order.append(last)
        visited, last = visited ^ (1 << last), int(before[visited, last])
    return tuple(reversed(order))


def lkh_order(cost: Array) -> list[int]:
    """Returns the K items (0-based) in the order of LKH's tour.

    Args:
        cost: (K+1, K+1), symmetric; node 0 is the depot.

    Raises:
        TourError: elkai is not installed.
    """
    count = len(cost) - 1
    if count < 3:  # every order is a shortest one; elkai refuses fewer than three nodes
        return list(range(count))
    try:
        import elkai
    except ImportError:
        raise TourError(
            "order lkh: elkai is not installed: pip install elkai, or use --order exact"
        ) from None
    # elkai cuts float weights to integers without a word. Its seed is fixed, so the same weights
    # give the same tour.
    unit = max(float(np.max(cost)), 1e-12) / _LONGEST_WEIGHT
    weights = np.rint(cost / unit).astype(np.int64).tolist()
    closed = elkai.DistanceMatrix(weights).solve_tsp(runs=_LKH_RUNS)
    return [node - 1 for node in closed[1:-1]]


def _directed(order: list[int] | tuple[int, ...]) -> tuple[int, ...]:
    return tuple(order if order[0] <= order[-1] else reversed(order))


def _explicit(text: str, count: int) -> tuple[int, ...]:
    try:
        order = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise TourError(
            f"order: {text!r}: must be one of {', '.join(ORDER_METHODS)}, "
            "or item indices such as 2,0,1"
        ) from None
    if sorted(order) != list(range(count)):
        raise TourError(
            f"order: {text!r}: must name each of the items 0 to {count - 1} exactly once"
        )
    return order


def _checked(cost: Array, count: int) -> Array:
    if cost.shape != (count + 1, count + 1) or not np.all(np.isfinite(cost)) or np.any(cost < 0):
        raise TourError(
            f"cost: shape {cost.shape}: must be ({count + 1}, {count + 1}), finite and not negative"
        )
    if not np.allclose(cost, cost.T):
        raise TourError("cost: must be symmetric; take the mean of both directions")
    return cost


def node_name(node: int) -> str:
    """Returns the name of a node: 'item 3', 'depot' for -1, or 'depot 1' for the next, -2."""
    if node >= 0:
        return f"item {node}"
    return "depot" if node == DEPOT else f"depot {DEPOT - node}"


# `from` is a keyword of Python, hence the functional form.
Segment = TypedDict(
    "Segment", {"index": int, "from": int, "to": int, "distance": float, "blocked": bool}
)


def segments_table(scene: Scene, order: Sequence[int]) -> list[Segment]:
    """Returns a row for each of the K+1 segments: nodes, straight distance (m), blocked or not.

    A segment is blocked if the body, flying straight from point to point, would touch a box.
    """
    pairs, between = tour_segments(order), distances(scene)
    ends = np.array([[scene.point(start), scene.point(end)] for start, end in pairs])
    clear = segment_clear(ends[:, 0], ends[:, 1], scene.tree, scene.reach)
    return [
        {
            "index": index,
            "from": start,
            "to": end,
            "distance": float(between[start + 1, end + 1]),
            "blocked": not bool(clear[index]),
        }
        for index, (start, end) in enumerate(pairs)
    ]


def first_blocked(scene: Scene, order: Sequence[int]) -> int:
    """Returns the number of the first blocked segment, or 0 if none is blocked."""
    return next((row["index"] for row in segments_table(scene, order) if row["blocked"]), 0)
