"""Shares the items of a scene among UAVs, so that the last one is home as early as possible.

Of D depots UAV m has number m mod D, where its tour begins and ends. Costs have the depots' rows
and columns first, then the items'; nothing is flown between depots.

Up to MAX_EXACT items the best sharing is found by dynamic programming over sets of items. Beyond,
PyVRP (Wouda, Lan and Kool 2024) looks for tours that all end within a time, which is bisected:
it has no objective of its own for the last tour. LKH orders each tour at the end, or the local
search where elkai is not installed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.scene.depots import depot_of
from mjcollect.scene.shortest_tour import (
    MAX_EXACT,
    TourError,
    short_order,
    way_back,
    ways_through,
)

FINE = 1e-3  # The bisection ends when the time is known to this share.
ITERATIONS = 400  # A search for tours within a time ends after so many iterations of PyVRP.
_LONGEST = 1_000_000  # The greatest cost as an integer, which PyVRP needs.
_ANY = 2**62  # so long that every tour keeps it
Tours = tuple[tuple[int, ...], ...]


def assign(cost: Array, uavs: int, *, seed: int = 0, depots: int = 1) -> Tours:
    """Returns the items that each UAV collects, in the order of visit; some may get none.

    Args:
        cost: (D + K, D + K) seconds from row to column, the depots first; symmetric.
        uavs: M, their number. seed: of the search beyond MAX_EXACT items. depots: D.

    Returns:
        M tours of item indices, tour m from depot m mod D; those of one depot the longest first.

    Raises:
        TourError: there is no UAV or no depot, or PyVRP is missing.
    """
    if uavs < 1:
        raise TourError(f"uavs: {uavs}: must be at least 1")
    if not 1 <= depots < len(cost):
        raise TourError(f"depots: {depots}: must be at least 1, and fewer than rows of the cost")
    if len(cost) - depots <= MAX_EXACT:
        tours = exact_assignment(cost, uavs, depots)
    elif uavs == 1:
        tours = [tuple(short_order(depot_cost(cost, 0, depots), seed=seed))]
    else:
        tours = search_assignment(cost, uavs, seed=seed, depots=depots)
    own = [
        sorted(tours[depot::depots], key=lambda tour: -tour_time(cost, tour, depot, depots))
        for depot in range(depots)
    ]
    return tuple(_in_turn(own, uavs))


def depot_cost(cost: Array, depot: int, depots: int) -> Array:
    """Returns the cost (K + 1, K + 1) of one depot, first, and of the items."""
    nodes = np.array([depot, *range(depots, len(cost))])
    return cost[np.ix_(nodes, nodes)]


def tour_time(cost: Array, tour: Sequence[int], depot: int = 0, depots: int = 1) -> float:
    """Returns the seconds of a tour from a depot through items and back; 0 for none."""
    nodes = np.array([depot, *(item + depots for item in tour), depot])
    return float(cost[nodes[:-1], nodes[1:]].sum()) if len(tour) else 0.0


def makespan(cost: Array, tours: Sequence[Sequence[int]], depots: int = 1) -> float:
    """Returns the seconds until the last of some tours is home, tour m from depot m mod D."""
    return max(
        tour_time(cost, tour, depot_of(uav, depots), depots) for uav, tour in enumerate(tours)
    )


def _in_turn(own: Sequence[Sequence[tuple[int, ...]]], uavs: int) -> list[tuple[int, ...]]:
    """Returns M tours, each the next one of its depot's `own` ones, empty if there is none left."""
    left = [iter(tours) for tours in own]
    return [next(left[depot_of(uav, len(own))], ()) for uav in range(uavs)]


# All sharings


def exact_assignment(cost: Array, uavs: int, depots: int = 1) -> list[tuple[int, ...]]:
    """Returns tours with the least makespan, by dynamic programming over sets of items.

    There are M, tour m from depot m mod D; `cost` is as in `assign`, but need not be symmetric.

    Raises:
        TourError: there are more than MAX_EXACT items.
    """
    count = len(cost) - depots
    if count > MAX_EXACT:
        raise TourError(f"uavs: {count} items: all sharings are tried up to {MAX_EXACT} items only")
    ways = []
    times = np.zeros((min(depots, uavs), 1 << count))
    for depot, time in enumerate(times):
        own = depot_cost(cost, depot, depots)
        best, before = ways_through(own)
        ways.append((best + own[1:, 0], before))
        time[1:] = ways[depot][0][1:].min(axis=1)
    share = np.empty((uavs, 1 << count), dtype=np.intp)
    share_sets(times, share)
    own_tours: list[list[tuple[int, ...]]] = [[] for _ in range(depots)]
    left = (1 << count) - 1
    for uav in range(uavs - 1, -1, -1):
        depot, mine = depot_of(uav, depots), int(share[uav, left])
        closed, before = ways[depot]
        own_tours[depot].append(way_back(before, mine, int(closed[mine].argmin())))
        left ^= mine
    return _in_turn(own_tours, uavs)


@compiled
def share_sets(closed: Array, share: Indices) -> None:
    """Writes for each number of UAVs and each set the part of the set that the last of them takes.

    Args:
        closed: (D, 2^K) s, the least tour through each set from each depot, which UAVs have in
            turn. share: (M, 2^K), written.
    """
    least = closed[0].copy()
    for items in range(len(least)):
        share[0, items] = items
    for uav in range(1, len(share)):
        before, own = least.copy(), closed[uav % len(closed)]
        for items in range(len(least)):
            part = items
            least[items] = np.inf
            while True:  # over all parts of the set, down to the empty one
                time = max(own[part], before[items ^ part])
                if time < least[items]:
                    least[items], share[uav, items] = time, part
                if part == 0:
                    break
                part = (part - 1) & items


# A time that all tours keep, bisected


def _ordered(cost: Array, tour: tuple[int, ...]) -> tuple[int, ...]:
    """Returns a tour in the order of `short_order`, or as it is if that is no shorter.

    `cost` has one depot.
    """
    nodes = np.array([0, *(item + 1 for item in tour)])
    other = tuple(tour[index] for index in short_order(cost[np.ix_(nodes, nodes)]))
    return min(tour, other, key=lambda each: tour_time(cost, each))


def search_assignment(
    cost: Array, uavs: int, *, seed: int = 0, depots: int = 1
) -> list[tuple[int, ...]]:
    """Returns tours of which the last ends as early as PyVRP can find, each in a short order.

    There are M, tour m from depot m mod D; `cost` is as in `assign`.

    Raises:
        TourError: PyVRP is missing.
    """
    unit = max(float(cost.max()), 1e-12) / _LONGEST
    weights = np.ceil(cost / unit).astype(np.int64)
    least = farthest(cost, uavs, depots)
    tours = _within(weights, uavs, _ANY, seed, depots)
    assert tours is not None
    most = makespan(cost, tours, depots)
    while most - least > FINE * most:
        tried = (least + most) / 2
        found = _within(weights, uavs, int(tried / unit), seed, depots)
        if found is None:
            least = tried
        else:
            tours, most = found, makespan(cost, found, depots)
    return [
        _ordered(depot_cost(cost, depot_of(uav, depots), depots), tour)
        for uav, tour in enumerate(tours)
    ]


def farthest(cost: Array, uavs: int, depots: int = 1) -> float:
    """Returns the seconds in which UAVs can fly to any item and back, each from its depot."""
    used = min(uavs, depots)
    return float((cost[:used, depots:] + cost[depots:, :used].T).min(axis=0).max())


def _within(
    weights: NDArray[np.int64], uavs: int, most: int, seed: int, depots: int
) -> list[tuple[int, ...]] | None:
    """Returns M tours that each take at most `most`, or None where none are found."""
    try:
        import pyvrp
        from pyvrp.stop import FirstFeasible, MaxIterations, MultipleCriteria
    except ImportError:
        raise TourError(
            f"uavs: more than {MAX_EXACT} items need PyVRP: pip install pyvrp"
        ) from None
    model = pyvrp.Model()
    places = [model.add_location(0, 0) for _ in weights]
    homes = [model.add_depot(place) for place in places[:depots]]
    for place in places[depots:]:
        model.add_client(place)
    for depot, home in enumerate(homes[:uavs]):
        own = min(len(range(depot, uavs, depots)), len(places) - depots)
        model.add_vehicle_type(own, start_depot=home, end_depot=home, shift_duration=most)
    for i, one in enumerate(places):
        for j, other in enumerate(places):
            weight = int(weights[i, j])
            model.add_edge(one, other, distance=weight, duration=weight)
    # Any tours will do within a time; without one the shortest in all are looked for.
    enough = MaxIterations(ITERATIONS)
    end = enough if most == _ANY else MultipleCriteria([enough, FirstFeasible()])
    result = model.solve(end, seed=seed, display=False)
    if not result.is_feasible():
        return None
    tours: list[list[tuple[int, ...]]] = [[] for _ in homes]
    for route in result.best.routes():
        tour = tuple(stop.idx for stop in route.schedule() if stop.is_client())
        tours[route.vehicle_type()].append(tour)  # a type for each depot
    return _in_turn(tours, uavs)
