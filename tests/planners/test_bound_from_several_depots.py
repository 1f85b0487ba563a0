"""Sharing items among UAVs of several depots against all sharings there are, and its bound."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.generate import generate
from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners import fleet_bound as bounds
from mjcollect.planners.assignment import (
    assign,
    exact_assignment,
    makespan,
    search_assignment,
    tour_time,
)
from mjcollect.planners.fleet_bound import fleet_bound, tours_bound
from mjcollect.planners.fleets import fleet_tours
from mjcollect.scene.bounds import leg_bounds, leg_time, mission_bound
from mjcollect.scene.order import TourError
from mjcollect.scene.scene import Scene


def costs(seed, count, depots=2):
    points = np.random.default_rng(seed).uniform(0, 1000, (depots + count, 3))
    far = np.linalg.norm(points[:, None] - points[None], axis=-1)
    cost = np.array(leg_time(np.maximum(far - 10.0, 0.0), 50.0, 20.0))
    np.fill_diagonal(cost, 0.0)
    cost[:depots, :depots] = 0.0
    return cost


def least_makespan(cost, uavs, depots):
    """By all ways to give each item to a UAV, and all orders of what each gets."""
    count, least = len(cost) - depots, np.inf
    for owner in itertools.product(range(uavs), repeat=count):
        times = []
        for uav in range(uavs):
            mine = [item for item in range(count) if owner[item] == uav]
            ways = [[uav % depots, *(depots + item for item in order), uav % depots]
                    for order in itertools.permutations(mine)]  # fmt: skip
            legs = [sum(cost[a, b] for a, b in itertools.pairwise(way)) for way in ways]
            times.append(min(legs) if mine else 0.0)
        least = min(least, max(times))
    return least


def check_tours(cost, tours, uavs, depots):
    """Each item once; UAVs of the same depot by time, the longest first."""
    assert len(tours) == uavs
    items = sorted(item for tour in tours for item in tour)
    assert items == list(range(len(cost) - depots))
    times = [tour_time(cost, tour, m % depots, depots) for m, tour in enumerate(tours)]
    for depot in range(depots):
        assert times[depot::depots] == sorted(times[depot::depots], reverse=True)
    assert makespan(cost, tours, depots) == max(times)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 5), st.integers(1, 3), st.integers(1, 3))
def test_few_items_are_shared_as_all_sharings_say(seed, count, uavs, depots):
    cost = costs(seed, count, depots)
    tours = assign(cost, uavs, depots=depots)
    check_tours(cost, tours, uavs, depots)
    least = least_makespan(cost, uavs, depots)
    assert makespan(cost, tours, depots) == pytest.approx(least, rel=1e-12)


@pytest.mark.parametrize("uavs", [2, 3])
def test_the_search_finds_what_is_best_within_a_hundredth(uavs):
    for seed in range(4):
        cost = costs(seed, 8)
        found = search_assignment(cost, uavs, seed=seed, depots=2)
        assert sorted(item for tour in found for item in tour) == list(range(8))
        best = makespan(cost, exact_assignment(cost, uavs, 2), 2)
        assert best <= makespan(cost, found, 2) * (1 + 1e-12)
        assert makespan(cost, found, 2) <= 1.01 * best


def test_many_items_are_shared_the_same_way_again():
    cost = costs(5, 18, 3)
    for uavs in (2, 4):
        tours = assign(cost, uavs, seed=3, depots=3)
        check_tours(cost, tours, uavs, 3)
        assert assign(cost, uavs, seed=3, depots=3) == tours
    check_tours(cost, assign(cost, 1, depots=3), 1, 3)


def test_items_beside_the_second_depot_are_left_to_its_uav():
    """The first UAV has nothing to do: without its empty tour places would not tell depots."""
    points = np.array([[0.0, 0, 0], [900, 0, 0], [890, 10, 0], [910, 20, 0]])
    cost = np.linalg.norm(points[:, None] - points[None], axis=-1) / 10
    assert [sorted(tour) for tour in assign(cost, 2, depots=2)] == [[], [0, 1]]
    assert [len(tour) for tour in assign(cost, 4, depots=2)] == [0, 1, 0, 1]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 6), st.integers(1, 3))
def test_a_second_depot_that_is_the_first_changes_nothing(seed, count, uavs):
    cost = costs(seed, count, 1)
    nodes = [0, *range(len(cost))]
    twice = cost[np.ix_(nodes, nodes)]
    alone = makespan(cost, assign(cost, uavs))
    assert makespan(twice, assign(twice, uavs, depots=2), 2) == pytest.approx(alone, rel=1e-12)


def test_what_cannot_be_shared_is_refused():
    with pytest.raises(TourError, match="depots: 0: must be at least 1"):
        assign(costs(0, 3), 2, depots=0)
    with pytest.raises(TourError, match="depots: 5"):
        assign(costs(0, 3), 2, depots=5)


def several(seed, count, more=1) -> Scene:
    """A generated scene; further depots are in other corners of the cube."""
    corners = [[1000.0, 1000.0, 0.0], [1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]]
    return replace(generate(seed, count, layout="floating"), more_depots=corners[:more])


def test_travel_times_have_the_same_rows_as_one_depot_has():
    scene = several(1, 4, 2)
    whole = travel_times(scene, 3)
    assert whole.shape == (7, 7)
    np.testing.assert_array_equal(whole, whole.T)
    assert not whole[:3, :3].any()
    for depot in range(3):
        nodes = [depot, 3, 4, 5, 6]
        alone = travel_times(replace(scene, depot=scene.depots[depot], more_depots=[]))
        np.testing.assert_array_equal(whole[np.ix_(nodes, nodes)], alone)
    np.testing.assert_array_equal(
        travel_times(scene), whole[np.ix_([0, 3, 4, 5, 6], [0, 3, 4, 5, 6])]
    )
    bound = leg_bounds(scene, scene.depots)
    assert np.all(bound[:3, 3:] <= whole[:3, 3:] + 1e-9)
    assert np.all(bound[3:] <= whole[3:] + 1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**4), st.integers(1, 7), st.integers(1, 4), st.integers(1, 3))
def test_no_sharing_beats_the_bound(seed, count, uavs, more):
    """Legs as they are without boxes; the bounds of both methods are below their best."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, 1000, (1 + more + count, 3))
    scene = Scene(
        "open", 0, [[0, 0, 0], [1000, 1000, 1000]], points[0], points[1 + more :], [],
        more_depots=points[1 : 1 + more],
    )  # fmt: skip
    depots = 1 + more
    cost = travel_times(scene, depots)
    best = makespan(cost, exact_assignment(cost, uavs, depots), depots)
    assert fleet_bound(scene, uavs)[0] <= best * (1 + 1e-9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounds, "MAX_EXACT", 0)
        relaxed, method = fleet_bound(scene, uavs)
    assert method == bounds.FORESTS
    assert relaxed <= best * (1 + 1e-9)


def test_many_items_have_a_bound_that_is_not_far_below():
    scene = several(2, 20)
    cost = travel_times(scene, 2)
    for uavs in (2, 3):
        bound, method = fleet_bound(scene, uavs)
        found = makespan(cost, assign(cost, uavs, depots=2), 2)
        assert method == bounds.FORESTS
        assert 0.5 * found < bound <= found
    assert fleet_bound(scene, 1)[0] == fleet_bound(replace(scene, more_depots=[]), 1)[0]


def test_a_leg_out_may_begin_beside_a_depot():
    """UAVs of a depot start up to return_tolerance from it, which makes their legs out shorter."""
    scene = several(2, 8)
    both = leg_bounds(scene, scene.depots, scene.return_tolerance)
    np.testing.assert_allclose(both[:2, 2:], both[2:, :2].T)
    assert np.all(both[0, 2:] < leg_bounds(scene)[0, 1:])
    assert fleet_bound(scene, 1) == pytest.approx(mission_bound(scene))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 5), st.integers(1, 3))
def test_tours_of_several_depots_are_bounded_as_enumeration_says(seed, count, parts):
    parts, cost, total = min(parts, count), costs(seed, count), np.inf
    for owner in itertools.product(range(parts), repeat=count):
        sets = [[item for item in range(count) if owner[item] == tour] for tour in range(parts)]
        if all(sets):
            total = min(total, sum(
                min(tour_time(cost, order, depot, 2)
                    for depot in range(2) for order in itertools.permutations(each))
                for each in sets
            ))  # fmt: skip
    assert tours_bound(cost, parts, 2) <= total + 1e-9


def test_tours_of_a_scene_are_those_of_its_depots():
    scene = several(3, 6)
    tours = fleet_tours(scene, 3)
    assert tours == assign(travel_times(scene, 2), 3, depots=2)
    alone = replace(scene, more_depots=[])
    assert fleet_tours(alone, 3) == assign(travel_times(alone), 3)
    assert fleet_tours(scene, 1) == fleet_tours(alone, 1)
