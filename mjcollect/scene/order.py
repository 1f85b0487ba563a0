"""Orders the items to visit: by LKH as in the paper (section IV), or as other methods do.

A node is an item index, or -1 for the depot. An order of K items has K + 1 segments, each from one
stop to the next: segment 0 leaves the depot, segment K returns to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import TourError, held_karp, lkh_order, search_order

SHORTEST = ("lkh", "exact", "search")  # methods that look for the least cost
ORDER_METHODS = (*SHORTEST, "random", "given")
DEPOT = -1  # The depot is the node before the items 0, 1, ...


def plan_order(
    scene: Scene, method: str, *, seed: int = 0, cost: Array | None = None
) -> tuple[int, ...]:
    """Returns the visiting order of the items.

    Of a tour's two directions, all but `given` and a listed order return the one whose first item
    has the smaller index.

    Args:
        scene: K items.
        method: `lkh`; `exact` (dynamic programme, K <= 12) and `search` (local search by PyVRP),
            which need no elkai; `random`; `given` (file order); or the order itself as in '2,0,1'.
        seed: the seed of the search or of the random order.
        cost: (K+1, K+1) symmetric cost between nodes, depot first, for `lkh`, `exact` and `search`;
            straight distances in metres if None.

    Returns:
        The K item indices in order of visit.

    Raises:
        TourError: the method is unknown, the order is no permutation, there are too many items,
            elkai or PyVRP is not installed, or `cost` does not fit.
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
    return _directed(search_order(cost, seed=seed) if method == "search" else lkh_order(cost))


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
