"""The guidance law: near the least time where nothing is in the way, and never into anything."""

from __future__ import annotations

import numpy as np
import pytest
from crowds import FLAT, RADIUS, Flown, crowded
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.generate import generate
from mjcollect.guidance.law import stopping
from mjcollect.scene.bounds import detour_bound, leg_time
from mjcollect.scene.scene import Scene

SLOT, A_MAX, V_MAX = 0.2, 20.0, 50.0


def scene(obstacles, item=(380.0, 30, 30), depot=(10.0, 30, 30), bounds=FLAT, **fields) -> Scene:
    return Scene("t", 0, bounds, depot, [item], obstacles, **fields)


def flies_clear(flown, course) -> bool:
    """By the recorded positions, not by the flags of the environment."""
    inside = flown.farthest_outside(course.scene.bounds) <= 1e-6
    return inside and flown.least_gap(course.scene.obstacles) >= RADIUS - 1e-9


@pytest.fixture(scope="module")
def open_scene():
    bounds, items = [[0, 0, 0], [600, 120, 120]], [[500, 60, 60], [120, 90, 30]]
    return Scene("open", 0, bounds, [10, 60, 60], items, [])


@pytest.mark.parametrize(("order", "segment"), [((0, 1), 0), ((0, 1), 1), ((1, 0), 0), ((0, 1), 2)])
def test_straight_legs_take_the_least_number_of_slots_or_one_more(open_scene, order, segment):
    course = Course.segment(open_scene, order, segment)
    guide = course.guidance[0]
    q = np.random.default_rng(segment).uniform(*open_scene.bounds, (300, 3))
    flown = Flown(course, 300, places=(q, np.zeros_like(q)))
    assert flown.won.all()
    far = np.linalg.norm(guide.goal - q, axis=1)
    least = leg_time(np.maximum(far - guide.tolerance, 0.0), V_MAX, A_MAX) / SLOT
    assert np.all(flown.slots >= least - 1e-6)
    more = flown.slots - np.maximum(np.ceil(least - 1e-6), 1)
    assert np.mean(more <= 0) > 0.7
    assert np.mean(more <= 1) > 0.98
    assert more.max() <= 2
    assert flown.fastest <= V_MAX * (1 + 1e-9)
    assert 0.999 * A_MAX <= flown.hardest <= A_MAX * (1 + 1e-9)


def test_spare_time_goes_into_a_stop_nearer_to_the_next_target(open_scene):
    """Where the tour goes back, the last slots are used up to the far end of the ball at most."""
    course = Course.segment(open_scene, (0, 1), 1)  # from the far item, then home to the depot
    guide, home = course.guidance[0], open_scene.depot
    q = np.random.default_rng(0).uniform([300, 0, 0], [600, 120, 120], (200, 3))
    flown = Flown(course, 200, places=(q, np.zeros_like(q)))
    stops = flown.q[:, -1]
    assert np.all(np.linalg.norm(stops - guide.goal, axis=1) <= guide.tolerance)
    towards = (q - guide.goal) / np.linalg.norm(q - guide.goal, axis=1, keepdims=True)
    first = guide.goal + towards * guide.tolerance  # where the ball is reached
    nearer = np.linalg.norm(first - home, axis=1) - np.linalg.norm(stops - home, axis=1)
    assert np.median(nearer) > 2.0
    assert nearer.min() > -1.5


def test_it_brakes_in_time_from_any_speed_that_leaves_room(open_scene):
    course = Course.segment(open_scene, (0, 1), 0)
    guide, rng = course.guidance[0], np.random.default_rng(3)
    towards = rng.normal(size=(300, 3)) * [1, 0.15, 0.15]
    towards[:, 0] = np.abs(towards[:, 0])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    far = rng.uniform(8, 55, 300)
    speed = np.minimum(np.sqrt(2 * A_MAX * far) * rng.uniform(0, 1, 300), V_MAX)
    places = guide.goal - towards * far[:, None], towards * speed[:, None]
    flown = Flown(course, 300, places=places)
    assert flown.won.all()
    beyond = np.einsum("ntk,nk->nt", flown.q - guide.goal, towards).max(axis=1)
    assert beyond.max() <= guide.tolerance


def law(course, q, v):
    """Actions of the law from states (n, 3)."""
    episodes = Episodes([course], len(q), Rules())
    episodes.reset(np.arange(len(q)), q, v)
    return episodes.guidance_action()


def test_actions_stay_in_the_unit_ball_whatever_the_state(blocked_course):
    rng = np.random.default_rng(0)
    q = rng.uniform(*FLAT, (500, 3))
    v = rng.normal(size=(500, 3))
    v *= rng.uniform(0, V_MAX, (500, 1)) / np.linalg.norm(v, axis=1, keepdims=True)
    action = law(blocked_course, q, v)
    assert np.all(np.linalg.norm(action, axis=1) <= 1 + 1e-12)
    assert np.all(np.linalg.norm(v + action * A_MAX * SLOT, axis=1) <= V_MAX * (1 + 1e-12))


def test_too_fast_for_the_goal_it_brakes_fully(free_course):
    near, fast = free_course.guidance[0].goal[None] - [20.0, 0, 0], np.array([[45.0, 0, 0]])
    np.testing.assert_allclose(law(free_course, near, fast), [[-1.0, 0, 0]], atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 14), st.booleans())
def test_it_arrives_from_the_whole_ball_and_touches_nothing(seed, boxes, back):
    course = Course.segment(crowded(seed, boxes), (0,), int(back))
    flown = Flown(course)
    assert flown.won.all()
    assert flies_clear(flown, course)
    assert flown.fastest <= V_MAX * (1 + 1e-9)
    assert flown.hardest <= A_MAX * (1 + 1e-9)


@pytest.mark.parametrize(("slot", "start"), [(0.1, "ball"), (0.2, "spread"), (1.0, "ball")])
def test_it_touches_nothing_in_other_slots_and_from_moving_starts(slot, start):
    course = Course.segment(crowded(7, 10, slot=slot), (0,), 0)
    flown = Flown(course, 32, start=start)
    assert flown.won.all()
    assert flies_clear(flown, course)


@pytest.mark.parametrize(("layout", "seed"), [("floating", 1), ("city", 4)])
def test_scenes_of_the_generator(layout, seed):
    """Full size: at 50 m/s along 20 boxes of 50 to 200 m."""
    made = generate(seed, 2, layout=layout)
    course = Course.segment(made, (0, 1), 1)
    flown = Flown(course, 8)
    assert flown.won.all()
    assert flies_clear(flown, course)
    assert flown.slots.max() * SLOT < 1.15 * detour_bound(made, 0, 1, course.guidance[0].length)


def test_a_hundred_boxes():
    course = Course.segment(generate(1, 1, obstacles=100), (0,), 0)
    flown = Flown(course, 8)
    assert flown.won.all()
    assert flies_clear(flown, course)


def test_ten_kilometres():
    made = generate(3, 1)
    wide = Scene("wide", 3, made.bounds * 10, made.depot, made.items * 10, made.obstacles * 10)
    course = Course.segment(wide, (0,), 0)
    flown = Flown(course, 3)
    assert flown.won.all()
    assert flies_clear(flown, course)
    assert flown.slots.max() * SLOT < 1.02 * detour_bound(wide, -1, 0, course.guidance[0].length)


def test_round_a_wall_it_is_flown_at_speed():
    course = Course.segment(scene([[[190.0, 0, 0], [210, 45, 60]]]), (0,), 0)
    flown = Flown(course, 32)
    assert flown.won.all()
    assert flies_clear(flown, course)
    assert flown.slots.max() * SLOT < 1.1 * detour_bound(
        course.scene, -1, 0, course.guidance[0].length
    )


def test_home_into_a_corner_of_the_bounds():
    """Where a stop a few metres too far would be out of bounds, from all over the scene."""
    course = Course.segment(scene([], item=(200.0, 30, 30), depot=(0.0, 0, 0)), (0,), 1)
    q = np.random.default_rng(0).uniform(*FLAT, (200, 3))
    flown = Flown(course, 200, places=(q, np.zeros_like(q)))
    assert flown.won.all()
    assert flies_clear(flown, course)
    least = leg_time(np.maximum(np.linalg.norm(q, axis=1) - 5.0, 0.0), V_MAX, A_MAX)
    assert np.max(flown.slots * SLOT - least) < 1.5  # the stop is 2 m inside, at half the ball


@pytest.mark.parametrize("width", [6.0, 9.0, 12.0])
def test_through_a_door_on_the_way(width):
    half, y, z = width / 2, 45.0, 20.0
    door = [
        [[200, 0, 0], [210, y - half, 60]],
        [[200, y + half, 0], [210, 60, 60]],
        [[200, y - half, 0], [210, y + half, z - half]],
        [[200, y - half, z + half], [210, y + half, 60]],
    ]
    course = Course.segment(scene(door), (0,), 0)
    flown = Flown(course, 32)
    assert flown.won.all()
    assert flies_clear(flown, course)


@pytest.mark.parametrize("room", [0.01, 0.3, 1.0])
def test_it_leaves_the_side_of_a_box_that_stands_in_the_way(room):
    wall = np.array([[100.0, 0, 0], [110, 50, 60]])
    course = Course.segment(scene([wall]), (0,), 0)
    y = np.linspace(2.0, 48.0, 24)
    q = np.stack([np.full(24, 100 - RADIUS - room), y, np.linspace(5, 55, 24)], axis=1)
    flown = Flown(course, 24, places=(q, np.zeros_like(q)))
    assert flown.won.all()
    assert flies_clear(flown, course)


@pytest.mark.parametrize("room", [0.02, 0.5, 1.5])
def test_to_an_item_close_to_a_box(room):
    box = np.array([[300.0, 20, 20], [340, 40, 40]])
    for item in ([300 - RADIUS - room, 30, 30], [340 + RADIUS + room, 30, 30]):
        course = Course.segment(scene([box], item=item), (0,), 0)
        flown = Flown(course)
        assert flown.won.all()
        assert flies_clear(flown, course)


@pytest.mark.parametrize("outside", [1e-13, 9e-7])
def test_it_leaves_a_bound_that_rounding_has_put_it_beyond(outside):
    course = Course.segment(scene([]), (0,), 0)
    q = np.array([[10.0, -outside, 30], [10.0, 60 + outside, 30], [-outside, 30, 60 + outside]])
    flown = Flown(course, 3, places=(q, np.zeros_like(q)))
    assert flown.won.all()
    assert flies_clear(flown, course)


@settings(deadline=None)
@given(st.floats(1, 40), st.floats(0, 500), st.floats(-50, 50), st.sampled_from([0.1, 0.2, 1.0]))
def test_after_the_slot_braking_takes_all_the_room(brake, room, speed, slot):
    then = stopping(brake, room, speed, slot)
    left = room - (speed + then) * slot / 2
    if then > 0.0:  # a stop takes a whole slot, however slow
        assert max(then**2 / (2 * brake), then * slot / 2) == pytest.approx(left, abs=1e-6)
    else:  # nothing forward will do
        assert room - speed * slot / 2 <= 1e-6
