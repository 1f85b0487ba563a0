"""Sharing items among UAVs against all sharings there are, and its lower bound."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.generate import generate
from mjcollect.planners.assignment import (
    assign,
    exact_assignment,
    makespan,
    search_assignment,
    tour_time,
)
from mjcollect.planners.fleet_bound import FORESTS, fleet_bound, spanning_forest, tours_bound
from mjcollect.scene.bounds import leg_bounds, leg_time, mission_bound
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import TourError, held_karp


def costs(seed, count):
    points = np.random.default_rng(seed).uniform(0, 1000, (count + 1, 3))
    far = np.linalg.norm(points[:, None] - points[None], axis=-1)
    cost = np.array(leg_time(np.maximum(far - 10.0, 0.0), 50.0, 20.0))
    np.fill_diagonal(cost, 0.0)
    return cost


def least_makespan(cost, uavs):
    """By all ways to give each item to a UAV, and all orders of what each gets."""
    count, least = len(cost) - 1, np.inf
    tour = {
        frozenset(items): min(
            (tour_time(cost, order) for order in itertools.permutations(items)), default=0.0
        )
        for size in range(count + 1)
        for items in itertools.combinations(range(count), size)
    }
    for owner in itertools.product(range(uavs), repeat=count):
        sets = [frozenset(i for i in range(count) if owner[i] == uav) for uav in range(uavs)]
        least = min(least, max(tour[each] for each in sets))
    return least


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 6), st.integers(1, 3))
def test_few_items_are_shared_as_all_sharings_say(seed, count, uavs):
    cost = costs(seed, count)
    tours = assign(cost, uavs)
    assert len(tours) == uavs
    assert sorted(item for tour in tours for item in tour) == list(range(count))
    assert makespan(cost, tours) == pytest.approx(least_makespan(cost, uavs), rel=1e-12)
    times = [tour_time(cost, tour) for tour in tours]
    assert times == sorted(times, reverse=True)


def test_one_uav_flies_the_shortest_tour():
    cost = costs(1, 9)
    assert tour_time(cost, assign(cost, 1)[0]) == pytest.approx(held_karp(cost)[0])
    asymmetric = leg_bounds(generate(3, 9, layout="floating"))
    assert makespan(asymmetric, exact_assignment(asymmetric, 1)) == pytest.approx(
        held_karp(asymmetric)[0]
    )


@pytest.mark.parametrize(("count", "uavs"), [(7, 2), (10, 3)])
def test_the_search_finds_what_is_best_within_a_hundredth(count, uavs):
    for seed in range(5):
        cost = costs(seed, count)
        found = search_assignment(cost, uavs, seed=seed)
        assert sorted(item for tour in found for item in tour) == list(range(count))
        best = makespan(cost, exact_assignment(cost, uavs))
        assert best <= makespan(cost, found) * (1 + 1e-12)
        assert makespan(cost, found) <= 1.01 * best


def test_many_items_are_shared_the_same_way_again():
    cost = costs(5, 20)
    tours = assign(cost, 4, seed=3)
    assert sorted(item for tour in tours for item in tour) == list(range(20))
    assert assign(cost, 4, seed=3) == tours
    assert makespan(cost, tours) < makespan(cost, assign(cost, 2, seed=3))
    for tour in tours:  # in an order that no two items can be exchanged in to win
        for one, other in itertools.combinations(range(len(tour)), 2):
            swapped = list(tour)
            swapped[one], swapped[other] = swapped[other], swapped[one]
            assert tour_time(cost, tour) <= tour_time(cost, swapped) + 1e-9


def test_more_uavs_than_items_leave_some_at_home():
    cost = costs(2, 2)
    tours = assign(cost, 5)
    assert [len(tour) for tour in tours] == [1, 1, 0, 0, 0]


def test_what_cannot_be_shared_is_refused(monkeypatch):
    with pytest.raises(TourError, match="uavs: 0: must be at least 1"):
        assign(costs(0, 3), 0)
    with pytest.raises(TourError, match="up to 12 items only"):
        exact_assignment(costs(0, 13), 2)
    monkeypatch.setitem(sys.modules, "pyvrp", None)
    with pytest.raises(TourError, match="pip install pyvrp"):
        assign(costs(0, 13), 2)


def line(count, gap=100.0) -> Scene:
    """Items to both sides of a depot in the middle."""
    places = gap * np.concatenate([np.arange(1, count // 2 + 1), -np.arange(1, count // 2 + 1)])
    items = np.stack([places, np.zeros(count), np.zeros(count)], axis=1)
    bounds = np.array([[-2000.0, -10, -10], [2000.0, 10, 10]])
    return Scene("line", 0, bounds, np.zeros(3), items, [])


def test_no_sharing_beats_the_bound():
    for seed in range(4):
        for count, uavs in ((8, 2), (16, 3), (24, 5)):
            scene = generate(seed, count, layout="floating")
            cost = leg_bounds(scene)
            bound, method = fleet_bound(scene, uavs)
            assert (method == FORESTS) == (count > 12)
            tours = assign((cost + cost.T) / 2, uavs)
            found = makespan(cost, tours)
            assert bound <= found * (1 + 1e-9)
            assert bound > 0.5 * found
    assert fleet_bound(generate(1, 8, layout="floating"), 1)[0] == pytest.approx(
        mission_bound(generate(1, 8, layout="floating"))[0]
    )


def test_on_a_line_the_bound_is_what_two_take():
    few, many = line(6), line(14)
    for scene, share in ((few, 0.99), (many, 0.9)):
        cost = leg_bounds(scene)
        half = len(cost) // 2
        bound, _ = fleet_bound(scene, 2)
        best = makespan(cost, (tuple(range(half)), tuple(range(half, 2 * half))))
        assert share * best - 1e-6 <= bound <= best + 1e-6


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 6), st.integers(1, 3))
def test_forests_and_tours_are_bounded_as_enumeration_says(seed, count, parts):
    parts = min(parts, count)
    cost = costs(seed, count)
    edges = list(itertools.combinations(range(count), 2))
    least = np.inf
    for chosen in itertools.combinations(edges, count - parts):
        root = list(range(count))
        for a, b in chosen:
            root = [root[a] if each == root[b] else each for each in root]
        if len(set(root)) == parts:
            least = min(least, sum(cost[a + 1, b + 1] for a, b in chosen))
    found, degree = spanning_forest(cost[1:, 1:], parts)
    assert found == pytest.approx(least, abs=1e-9)
    assert degree.sum() == 2 * (count - parts)
    total = np.inf
    for owner in itertools.product(range(parts), repeat=count):
        sets = [[i for i in range(count) if owner[i] == tour] for tour in range(parts)]
        if all(sets):
            tours = [min(tour_time(cost, o) for o in itertools.permutations(s)) for s in sets]
            total = min(total, sum(tours))
    assert tours_bound(cost, parts) <= total + 1e-9
