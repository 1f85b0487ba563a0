import sys
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.scene.order import (
    ORDER_METHODS,
    SHORTEST,
    TourError,
    distances,
    order_label,
    plan_order,
    tour_length,
    tour_segments,
)
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import held_karp, search_order, short_order


def random_scene(seed: int, count: int) -> Scene:
    items = np.random.default_rng(seed).uniform(0, 1000, (count, 3))
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0] * 3, items, [])


def shortest_by_brute_force(scene: Scene) -> float:
    return min(tour_length(scene, order) for order in permutations(range(len(scene.items))))


def test_tour_length_of_a_square():
    scene = Scene(
        "t",
        0,
        [[0] * 3, [10] * 3],
        [0, 0, 0],
        [[9, 0, 0], [9, 9, 0], [0, 9, 0]],
        [],
        uav_radius=0.1,
    )
    assert tour_length(scene, (0, 1, 2)) == pytest.approx(36)
    assert tour_length(scene, (1, 0, 2)) == pytest.approx(18 + 18 * np.sqrt(2))


@pytest.mark.parametrize("method", SHORTEST)
@pytest.mark.parametrize("count", range(1, 8))
def test_shortest_tour_equals_brute_force(method, count):
    for seed in range(4):
        scene = random_scene(seed, count)
        order = plan_order(scene, method)
        assert sorted(order) == list(range(count))
        assert tour_length(scene, order) == pytest.approx(shortest_by_brute_force(scene))


def test_lkh_keeps_fractions_of_a_metre():
    # In a cube of 2 m weights cut to whole metres could not tell tours apart.
    rng = np.random.default_rng(0)
    for _ in range(10):
        scene = Scene(
            "t", 0, [[0] * 3, [2] * 3], [0] * 3, rng.uniform(0, 2, (7, 3)), [],
            epsilon=0.01, return_tolerance=0.01, uav_radius=0.01,
        )  # fmt: skip
        assert tour_length(scene, plan_order(scene, "lkh")) == pytest.approx(
            shortest_by_brute_force(scene), abs=1e-4
        )


def test_lkh_in_the_largest_cube_does_not_overflow():
    items = np.random.default_rng(1).uniform(0, 1e5, (7, 3))
    scene = Scene("t", 0, [[0] * 3, [1e5] * 3], [0] * 3, items, [])
    assert tour_length(scene, plan_order(scene, "lkh")) == pytest.approx(
        shortest_by_brute_force(scene), rel=1e-6
    )


def total(cost, order) -> float:
    nodes = [0, *(item + 1 for item in order), 0]
    return sum(cost[a, b] for a, b in pairwise(nodes))


@settings(deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 7))
def test_on_asymmetric_costs_exact_and_search_equal_brute_force(seed, count):
    cost = np.random.default_rng(seed).uniform(0, 10, (count + 1, count + 1))
    least = min(total(cost, order) for order in permutations(range(count)))
    value, order = held_karp(cost)
    assert sorted(order) == list(range(count))
    assert total(cost, order) == pytest.approx(value)
    assert value == pytest.approx(least)
    searched = search_order(cost)
    assert sorted(searched) == list(range(count))
    assert total(cost, searched) == pytest.approx(least, rel=1e-5)


@settings(deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 12))
def test_direction_starts_at_the_smaller_end(seed, count):
    scene = random_scene(seed, count)
    methods = ("lkh", "random", "search", "exact")
    for method in methods[:3] if count > 8 else methods:
        order = plan_order(scene, method, seed=seed)
        assert order[0] <= order[-1]
        assert all(type(item) is int for item in order)


def test_given_and_listed_orders_keep_their_direction():
    scene = random_scene(0, 4)
    assert plan_order(scene, "given") == (0, 1, 2, 3)
    assert plan_order(scene, "3,1,2,0") == (3, 1, 2, 0)
    assert plan_order(scene, " 3, 1,2,0 ") == (3, 1, 2, 0)


def test_random_order_follows_its_seed():
    scene = random_scene(0, 9)
    orders = {plan_order(scene, "random", seed=seed) for seed in range(20)}
    assert len(orders) > 15
    assert plan_order(scene, "random", seed=7) == plan_order(scene, "random", seed=7)


def test_lkh_is_deterministic_between_other_calls():
    scene = random_scene(3, 60)
    first = plan_order(scene, "lkh")
    for seed in range(3):
        plan_order(random_scene(seed, 20 + seed), "lkh")
        assert plan_order(scene, "lkh") == first


@pytest.mark.parametrize("method", ["lkh", "search"])
def test_orders_print_nothing(method, capfd):
    plan_order(random_scene(0, 30), method)
    assert capfd.readouterr() == ("", "")


def test_search_is_as_short_as_lkh_and_follows_its_seed():
    for seed in range(2):
        scene = random_scene(seed, 20)
        found = plan_order(scene, "search", seed=seed)
        assert found == plan_order(scene, "search", seed=seed)
        assert tour_length(scene, found) <= 1.005 * tour_length(scene, plan_order(scene, "lkh"))
    hurried = {tuple(search_order(distances(scene), seed=seed, iterations=1)) for seed in range(5)}
    assert len(hurried) > 1


def test_search_takes_two_hundred_items_and_more_iterations_shorten_the_tour():
    cost = distances(random_scene(0, 200))
    tours = [search_order(cost, iterations=iterations) for iterations in (1, 5)]
    assert all(sorted(tour) == list(range(200)) for tour in tours)
    assert total(cost, tours[1]) < total(cost, tours[0]) < total(cost, range(200)) / 2


def test_cost_matrix_replaces_distance():
    scene = random_scene(0, 4)
    cost = np.full((5, 5), 10.0)
    for a, b in [(0, 2), (2, 4), (4, 1), (1, 3), (3, 0)]:
        cost[a, b] = cost[b, a] = 1.0
    for method in SHORTEST:
        assert plan_order(scene, method, cost=cost) == (1, 3, 0, 2)


@pytest.mark.parametrize(
    "cost", [np.ones((4, 4)), np.full((5, 5), np.nan), -np.ones((5, 5)), np.triu(np.ones((5, 5)))]
)
def test_bad_cost_is_refused(cost):
    with pytest.raises(TourError, match="cost"):
        plan_order(random_scene(0, 4), "exact", cost=cost)


@pytest.mark.parametrize("text", ["", "best", "0,1", "0,1,1", "0,1,3", "-1,0,1", "0 1 2", "0,1,2,"])
def test_bad_order_is_refused(text):
    with pytest.raises(TourError, match="order"):
        plan_order(random_scene(0, 3), text)


def test_exact_refuses_thirteen_items():
    with pytest.raises(TourError, match=r"13 items.*--order lkh or search"):
        plan_order(random_scene(0, 13), "exact")


def test_without_elkai_lkh_names_the_fix_and_the_others_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "elkai", None)
    scene = random_scene(0, 5)
    with pytest.raises(TourError, match=r"--order search, or --order exact .up to 12 items"):
        plan_order(scene, "lkh")
    assert plan_order(scene, "exact") == plan_order(scene, "search")
    cost = distances(scene)
    assert short_order(cost) == search_order(cost)
    assert plan_order(random_scene(0, 2), "lkh") == (0, 1)


def test_without_pyvrp_search_names_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvrp", None)
    with pytest.raises(TourError, match=r"order search: .*pip install pyvrp"):
        plan_order(random_scene(0, 5), "search")
    assert plan_order(random_scene(0, 1), "search") == (0,)


def test_items_on_one_point_are_a_tour():
    scene = Scene("t", 0, [[0] * 3, [100] * 3], [50] * 3, [[50] * 3] * 5, [])
    for method in SHORTEST:
        assert sorted(plan_order(scene, method)) == [0, 1, 2, 3, 4]


def test_legs_and_labels():
    assert tour_segments((2, 0, 1)) == [(-1, 2), (2, 0), (0, 1), (1, -1)]
    assert [order_label(method) for method in (*ORDER_METHODS, "1,0")] == [
        *ORDER_METHODS,
        "explicit",
    ]
