from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.scene import bounds
from mjcollect.scene.assets import asset_path
from mjcollect.scene.bounds import detour_bound, leg_time, mission_bound, segment_bound
from mjcollect.scene.order import plan_order, tour_segments
from mjcollect.scene.scene import Scene


def random_scene(seed: int, count: int, **limits: float) -> Scene:
    items = np.random.default_rng(seed).uniform(0, 1000, (count, 3))
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0] * 3, items, [], **limits)


def speed_profile_time(distance: float, v_max: float, a_max: float) -> float:
    """Integral of dx / v(x), with v as high as start, stop and limit allow; x = d sin^2 s."""
    s = (np.arange(200_000) + 0.5) / 200_000 * np.pi / 2
    x = distance * np.sin(s) ** 2
    v = np.sqrt(2 * a_max * np.minimum(x, distance - x)).clip(max=v_max)
    return float(np.sum(distance * np.sin(2 * s) / v) * np.pi / 2 / 200_000)


@pytest.mark.parametrize("distance", [1.0, 30.0, 124.0, 126.0, 400.0])
def test_leg_time_equals_integral_over_the_speed_profile(distance):
    assert float(leg_time(distance, 50, 20)) == pytest.approx(
        speed_profile_time(distance, 50, 20), rel=1e-6
    )


def test_leg_time_values_and_shape():
    assert leg_time([0.0, 125.0, 500.0], 50, 20) == pytest.approx([0.0, 5.0, 12.5])
    assert leg_time(np.ones((2, 3)), 50, 20).shape == (2, 3)


@settings(deadline=None)
@given(st.floats(0, 1e4), st.floats(0, 1e4), st.floats(1, 100), st.floats(1, 100))
def test_leg_time_rises_and_is_subadditive(a, b, v_max, a_max):
    # Stopping on the way never helps.
    whole = float(leg_time(a + b, v_max, a_max))
    assert whole >= float(leg_time(max(a, b), v_max, a_max)) * (1 - 1e-12)
    parts = float(leg_time(a, v_max, a_max) + leg_time(b, v_max, a_max))
    assert whole <= parts * (1 + 1e-12)


def test_segment_bound_takes_off_each_ball_once():
    scene = Scene(
        "t", 0, [[0] * 3, [1000] * 3], [0] * 3, [[500, 0, 0], [500, 400, 0]], [],
        epsilon=3.0, return_tolerance=8.0,
    )  # fmt: skip
    assert segment_bound(scene, -1, 0) == pytest.approx(float(leg_time(497.0, 50, 20)))
    assert segment_bound(scene, 0, 1) == pytest.approx(float(leg_time(394.0, 50, 20)))
    assert segment_bound(scene, 0, -1) == pytest.approx(float(leg_time(489.0, 50, 20)))
    assert detour_bound(scene, 0, -1, 611.0) == pytest.approx(float(leg_time(600.0, 50, 20)))


def test_segment_bound_is_zero_between_overlapping_balls():
    scene = Scene("t", 0, [[0] * 3, [100] * 3], [0] * 3, [[50, 50, 50], [50, 50, 56]], [])
    assert segment_bound(scene, 0, 1) == 0.0


@pytest.mark.parametrize("count", range(1, 8))
def test_mission_bound_equals_brute_force(count):
    for seed in range(3):
        # A wide return ball makes the two directions of a tour differ.
        scene = random_scene(seed, count, return_tolerance=200.0)
        expected = min(
            sum(segment_bound(scene, frm, to) for frm, to in tour_segments(order))
            for order in permutations(range(count))
        )
        assert mission_bound(scene) == (pytest.approx(expected), "held-karp-exact")


@pytest.mark.parametrize(
    ("name", "expected"),
    [("scenario_1", 70.47), ("scenario_2", 73.45), ("sweep_8", 94.36), ("city_6", 101.83)],
)
def test_bundled_scenes_have_their_published_bounds(name, expected):
    scene = Scene.load(asset_path("scenes", f"{name}.json"))
    assert mission_bound(scene)[0] == pytest.approx(expected, abs=0.005)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(2, 9),
    tolerance=st.floats(0.01, 500),
    epsilon=st.floats(0.01, 100),
)
def test_relaxation_never_exceeds_the_exact_bound(seed, count, tolerance, epsilon):
    scene = random_scene(seed, count, return_tolerance=tolerance, epsilon=epsilon)
    exact = mission_bound(scene)[0]
    relaxed = bounds._one_tree(bounds.leg_bounds(scene))
    assert relaxed <= exact
    assert relaxed >= 0.9 * exact - 1e-6


def test_relaxation_on_arbitrary_costs_never_exceeds_brute_force():
    rng = np.random.default_rng(5)
    for _ in range(20):
        cost = rng.uniform(0, 10, (7, 7))
        cost[1:, 1:] = (cost[1:, 1:] + cost[1:, 1:].T) / 2
        least = min(
            sum(cost[a, b] for a, b in zip((0, *order), (*order, 0), strict=True))
            for order in permutations(range(1, 7))
        )
        assert bounds._one_tree(cost) <= least


def test_spanning_tree_equals_scipy():
    from scipy.sparse.csgraph import minimum_spanning_tree

    rng = np.random.default_rng(2)
    weight = rng.uniform(1, 2, (40, 40))
    weight = weight + weight.T
    edges, joined = bounds.spanning_tree(weight)
    total, degree = edges.sum(), np.bincount(joined.ravel(), minlength=40)
    reference = minimum_spanning_tree(weight)
    ends = np.concatenate(reference.nonzero())
    assert total == pytest.approx(reference.sum())
    assert degree.tolist() == np.bincount(ends, minlength=40).tolist()


@pytest.mark.parametrize("count", [13, 60, 200])
def test_many_items_have_a_tight_bound_below_an_lkh_tour(count):
    scene = random_scene(count, count)
    value, method = mission_bound(scene)
    flown = sum(
        segment_bound(scene, frm, to) for frm, to in tour_segments(plan_order(scene, "lkh"))
    )
    assert method != "held-karp-exact"
    assert 0.97 * flown < value <= flown
    assert mission_bound(scene) == (value, method)
