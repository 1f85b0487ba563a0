"""Finds short closed tours: exactly, by LKH, or by the local search of PyVRP, which is free to all.

Node 0 is the depot, and item k is node k + 1. LKH (in elkai) is licensed for academic and
non-commercial use only; nothing here imports it unless it is asked for.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from mjcollect.geometry.compiled import Array, Indices

MAX_EXACT = 12  # The dynamic programme takes at most so many items K: it has 2^K K entries.
# LKH computes with 100 times the weights in 32-bit integers, so greater weights overflow. In a 1 km
# cube the unit of weights is then just below a millimetre.
_LONGEST_WEIGHT = 2_000_000
_LKH_RUNS = 10
# The search ends after so many iterations for each item: a number, no time, so that a tour depends
# on costs and seed alone. benchmarks/order_search.py has what more or fewer of them bring.
ITERATIONS = 100


class TourError(ValueError):
    """Says that no order can be made as asked; the message names method or order, and the fix."""


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
            f"order exact: {count} items: takes at most {MAX_EXACT}; use --order lkh or search"
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
            "order lkh: elkai is not installed: use --order search, or --order exact (up to "
            f"{MAX_EXACT} items), or pip install elkai"
        ) from None
    # elkai cuts float weights to integers without a word. Its seed is fixed, so the same weights
    # give the same tour.
    unit = max(float(np.max(cost)), 1e-12) / _LONGEST_WEIGHT
    weights = np.rint(cost / unit).astype(np.int64).tolist()
    closed = elkai.DistanceMatrix(weights).solve_tsp(runs=_LKH_RUNS)
    return [node - 1 for node in closed[1:-1]]


def search_order(cost: Array, *, seed: int = 0, iterations: int = ITERATIONS) -> list[int]:
    """Returns the K items (0-based) in the order of a tour by the local search of PyVRP.

    The same arguments give the same tour.

    Args:
        cost: (K+1, K+1), row = from, column = to, node 0 the depot; need not be symmetric.
        seed: of the search. iterations: for each item, after which the search ends.

    Raises:
        TourError: PyVRP is not installed.
    """
    count = len(cost) - 1
    if count < 2:
        return list(range(count))
    try:
        import pyvrp
        from pyvrp.stop import MaxIterations
    except ImportError:
        raise TourError("order search: PyVRP is not installed: pip install pyvrp") from None
    unit = max(float(np.max(cost)), 1e-12) / _LONGEST_WEIGHT
    weights: Any = np.rint(cost / unit).astype(np.int64)  # its stubs know no (K+1, K+1)
    np.fill_diagonal(weights, 0)  # PyVRP refuses others
    data = pyvrp.ProblemData(
        locations=[pyvrp.Location(0, 0)] * (count + 1),  # all that counts is in the matrix
        clients=[pyvrp.Client(node) for node in range(1, count + 1)],
        depots=[pyvrp.Depot(0)],
        vehicle_types=[pyvrp.VehicleType(1)],
        distance_matrices=[weights],
        duration_matrices=[np.zeros_like(weights)],
    )
    stop = MaxIterations(iterations * count)
    (route,) = pyvrp.solve(data, stop, seed=seed, collect_stats=False).best.routes()
    return [stop.idx for stop in route.schedule() if stop.is_client()]


def lkh_installed() -> bool:
    """Returns whether LKH can be asked; imports nothing."""
    return find_spec("elkai") is not None


def short_order(cost: Array, *, seed: int = 0) -> list[int]:
    """Returns the K items (0-based) in LKH's order, or in that of the search without elkai.

    `cost` is (K+1, K+1) and symmetric; the seed is the search's.

    Raises:
        TourError: neither elkai nor PyVRP is installed.
    """
    return lkh_order(cost) if lkh_installed() else search_order(cost, seed=seed)
