"""Shares the items of a scene among UAVs, so that the last one is home as early as possible.

Up to MAX_EXACT items the best sharing is found by dynamic programming over sets of items. Beyond,
PyVRP (Wouda, Lan and Kool 2024) looks for tours that all end within a time, which is bisected:
it has no objective of its own for the last tour. LKH orders each tour at the end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array, Indices, compiled
from mjcollect.scene.order import MAX_EXACT, TourError, lkh_order, way_back, ways_through

FINE = 1e-3  # The bisection ends when the time is known to this share.
ITERATIONS = 400  # A search for tours within a time ends after so many iterations of PyVRP.
_LONGEST = 1_000_000  # The greatest cost as an integer, which PyVRP needs.
_ANY = 2**62  # so long that every tour keeps it
Tours = tuple[tuple[int, ...], ...]


def assign(cost: Array, uavs: int, *, seed: int = 0) -> Tours:
    """Returns the items that each UAV collects, in the order of visit; some may get none.

    Args:
        cost: (K + 1, K + 1) seconds from row to column, the depot first; symmetric.
        uavs: M, their number. seed: of the search beyond MAX_EXACT items.

    Returns:
        M tours of item indices, the longest first.

    Raises:
        TourError: there is no UAV, or PyVRP is missing.
    """
    if uavs < 1:
        raise TourError(f"uavs: {uavs}: must be at least 1")
    count = len(cost) - 1
    if count <= MAX_EXACT:
        tours = exact_assignment(cost, uavs)
    elif uavs == 1:
        tours = [tuple(lkh_order(cost))]
    else:
        tours = search_assignment(cost, uavs, seed=seed)
    tours += [()] * (uavs - len(tours))
    return tuple(sorted(tours, key=lambda tour: -tour_time(cost, tour)))


def tour_time(cost: Array, tour: Sequence[int]) -> float:
    """Returns the seconds of a tour from the depot through items and back; 0 for none."""
    nodes = np.array([0, *(item + 1 for item in tour), 0])
    return float(cost[nodes[:-1], nodes[1:]].sum()) if len(tour) else 0.0


def makespan(cost: Array, tours: Sequence[Sequence[int]]) -> float:
    """Returns the seconds until the last of some tours is home."""
    return max(tour_time(cost, tour) for tour in tours)


# All sharings


def exact_assignment(cost: Array, uavs: int) -> list[tuple[int, ...]]:
    """Returns tours with the least makespan, by dynamic programming over sets of items.

    Raises:
        TourError: there are more than MAX_EXACT items.
    """
    count = len(cost) - 1
    if count > MAX_EXACT:
        raise TourError(f"uavs: {count} items: all sharings are tried up to {MAX_EXACT} items only")
    best, before = ways_through(cost)
    closed = best + cost[1:, 0]
    times = closed.min(axis=1)
    times[0] = 0.0
    share = np.empty((uavs, 1 << count), dtype=np.intp)
    share_sets(times, share)
    tours, left = [], (1 << count) - 1
    for uav in range(uavs - 1, -1, -1):
        mine = int(share[uav, left])
        tours.append(way_back(before, mine, int(closed[mine].argmin())))
        left ^= mine
    return tours


@compiled
def share_sets(closed: Array, share: Indices) -> None:
    """Writes for each number of UAVs and each set the part of the set that the last of them takes.

    Args:
        closed: (2^K,) s, the least tour through each set. share: (M, 2^K), written.
    """
    least = closed.copy()
    for items in range(len(closed)):
        share[0, items] = items
    for uav in range(1, len(share)):
        before = least.copy()
        for items in range(len(closed)):
            part = items
            least[items] = np.inf
            while True:  # over all parts of the set, down to the empty one
                time = max(closed[part], before[items ^ part])
                if time < least[items]:
                    least[items], share[uav, items] = time, part
                if part == 0:
                    break
                part = (part - 1) & items


# A time that all tours keep, bisected


def _ordered(cost: Array, tour: tuple[int, ...]) -> tuple[int, ...]:
    """Returns a tour in LKH's order, or as it is if that is no shorter."""
    nodes = np.array([0, *(item + 1 for item in tour)])
    other = tuple(tour[index] for index in lkh_order(cost[np.ix_(nodes, nodes)]))
    return min(tour, other, key=lambda each: tour_time(cost, each))


def search_assignment(cost: Array, uavs: int, *, seed: int = 0) -> list[tuple[int, ...]]:
    """Returns tours of which the last ends as early as PyVRP can find, each in LKH's order.

    Raises:
        TourError: PyVRP is missing.
    """
    uavs = min(uavs, len(cost) - 1)
    unit = max(float(cost.max()), 1e-12) / _LONGEST
    weights = np.ceil(cost / unit).astype(np.int64)
    least = float((cost[0, 1:] + cost[1:, 0]).max())
    tours = _within(weights, uavs, _ANY, seed)
    assert tours is not None
    most = makespan(cost, tours)
    while most - least > FINE * most:
        tried = (least + most) / 2
        found = _within(weights, uavs, int(tried / unit), seed)
        if found is None:
            least = tried
        else:
            tours, most = found, makespan(cost, found)
    return [_ordered(cost, tour) for tour in tours]


def _within(
    weights: NDArray[np.int64], uavs: int, most: int, seed: int
) -> list[tuple[int, ...]] | None:
    """Returns tours that each take at most `most`, or None where none are found."""
    try:
        import pyvrp
        from pyvrp.stop import FirstFeasible, MaxIterations, MultipleCriteria
    except ImportError:
        raise TourError(
            f"uavs: more than {MAX_EXACT} items need PyVRP: pip install 'mjcollect[fleet]'"
        ) from None
    model = pyvrp.Model()
    places = [model.add_location(0, 0) for _ in weights]
    model.add_depot(places[0])
    for place in places[1:]:
        model.add_client(place)
    model.add_vehicle_type(uavs, shift_duration=most)
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
    return [
        tuple(stop.idx for stop in route.schedule() if stop.is_client())
        for route in result.best.routes()
    ]
