from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from mjcollect.batch import Simulations
from mjcollect.bounds import leg_time
from mjcollect.course import Course
from mjcollect.episode import Episodes, Rules
from mjcollect.generate import generate
from mjcollect.guidance import Guidance, GuidanceError
from mjcollect.paths import path_length
from mjcollect.scene import Scene

FLAT = np.array([[0.0, 0.0, 0.0], [400.0, 60.0, 60.0]])
RADIUS = 0.5


def scene(obstacles, item=(380.0, 30, 30), depot=(10.0, 30, 30), **fields) -> Scene:
    return Scene("t", 0, FLAT, depot, [item], obstacles, **fields)


def random_scene(seed) -> Scene:
    """Six boxes that leave room between them."""
    rng = np.random.default_rng(seed)
    low = np.stack([40.0 + 55 * np.arange(6), rng.uniform(0, 20, 6), rng.uniform(0, 20, 6)], 1)
    size = np.stack([rng.uniform(5, 30, 6), rng.uniform(20, 40, 6), rng.uniform(20, 40, 6)], 1)
    return scene(np.stack([low, np.minimum(low + size, FLAT[1])], axis=1))


def least_gap(path, boxes, spacing=0.05):
    """Brute force: least distance of a densely sampled polyline to the boxes."""
    points = []
    for start, end in pairwise(path):
        count = max(2, int(np.linalg.norm(end - start) / spacing))
        points.append(start + np.linspace(0, 1, count)[:, None] * (end - start))
    points = np.concatenate(points)
    over = [np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0) for box in boxes]
    return min(float(np.linalg.norm(gap, axis=1).min()) for gap in over)


def free_points(flown, count, seed=0):
    """Random points in bounds where the body touches nothing."""
    points = np.random.default_rng(seed).uniform(*FLAT, (8 * count, 3))
    gap = [np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0) for box in flown.obstacles]
    clear = np.min([np.linalg.norm(over, axis=1) for over in gap], axis=0) > RADIUS
    return points[clear][:count]


def test_without_boxes_guidance_is_exact():
    flown = scene([])
    guide = Guidance(flown, 0, flown.depot)
    np.testing.assert_array_equal(guide.path, [flown.depot, flown.items[0]])
    q = np.random.default_rng(0).uniform(*FLAT, (200, 3))
    distance, direction = guide.query(q)
    offset = flown.items[0] - q
    straight = np.sqrt((offset**2).sum(axis=1))
    np.testing.assert_allclose(distance, straight, rtol=1e-12)
    np.testing.assert_allclose(direction, offset / straight[:, None], rtol=0, atol=1e-12)


def test_at_the_goal_the_distance_is_zero_and_there_is_no_direction():
    flown = scene([])
    distance, direction = Guidance(flown, 0, flown.depot).query(flown.items[:1])
    assert distance[0] == 0.0
    np.testing.assert_array_equal(direction, 0.0)


def wrapped(start, end, box, radius):
    """Length of the shortest way in the plane over the top of a box for a disc of `radius`.

    A string round two corner arcs: tangent, arc, flat top, arc, tangent.
    """
    length = box[1, 0] - box[0, 0]
    for point, corner in ((start, box[0, 0]), (end, box[1, 0])):
        across, down = abs(corner - point[0]), box[1, 1] - point[1]
        far = math.hypot(across, down)
        length += math.sqrt(far**2 - radius**2)  # tangent
        # The arc turns the tangent into the flat top.
        tangent = math.atan2(down, across) + math.asin(radius / far)
        length += radius * tangent
    return length


@pytest.mark.parametrize(
    ("box", "depot", "item"),
    [
        ([[190.0, 0, 0], [210, 50, 60]], (10.0, 30, 30), (380.0, 30, 30)),
        ([[150.0, 0, 0], [250, 40, 60]], (20.0, 10, 30), (390.0, 25, 30)),
        ([[100.0, 0, 0], [102, 45, 60]], (10.0, 20, 30), (300.0, 5, 30)),
    ],
)
def test_round_one_box_the_path_is_the_analytic_shortest(box, depot, item):
    flown = scene([box], item=item, depot=depot)
    guide = Guidance(flown, 0, flown.depot)
    shortest = wrapped(depot, item, np.array(box), RADIUS)
    assert shortest > math.dist(depot, item)
    assert shortest * (1 - 1e-9) <= path_length(guide.path) <= 1.02 * shortest
    assert guide.length == pytest.approx(path_length(guide.path))
    # The field is for steering: it keeps away from boxes and so overestimates, never under 0.98.
    distance, _ = guide.query(flown.depot[None])
    assert 0.98 * shortest <= distance[0] <= 1.5 * shortest


@pytest.mark.parametrize("seed", range(4))
def test_paths_keep_clear_and_distances_are_no_shorter_than_straight(seed):
    flown = random_scene(seed)
    guide = Guidance(flown, 0, flown.depot)
    np.testing.assert_array_equal(guide.path[0], flown.depot)
    np.testing.assert_array_equal(guide.path[-1], guide.aim)
    assert least_gap(guide.path, flown.obstacles) >= RADIUS - 1e-9
    assert path_length(guide.path) >= math.dist(flown.depot, guide.aim) - 1e-9
    q = free_points(flown, 500)
    distance, direction = guide.query(q)
    straight = np.linalg.norm(guide.aim - q, axis=1)
    assert np.all(distance >= straight * (1 - 1e-12))
    assert np.all(distance <= 3 * FLAT[1, 0])
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_directions_lead_to_the_goal(seed):
    """Points that follow the direction in short steps get to the aim, from everywhere."""
    flown = random_scene(seed)
    guide = Guidance(flown, 0, flown.depot)
    q = free_points(flown, 60, seed)
    for _ in range(900):
        distance, direction = guide.query(q)
        q = np.clip(q + direction * np.minimum(distance, 1.0)[:, None], *FLAT)
    assert np.mean(np.linalg.norm(q - guide.aim, axis=1) < 5.0) > 0.95


def door(width, y=50.0, z=30.0, x=200.0) -> list:
    """Four boxes: a wall across the bounds, 10 m thick, with a square door."""
    half = width / 2
    return [
        [[x, 0, 0], [x + 10, y - half, 60]],
        [[x, y + half, 0], [x + 10, 60, 60]],
        [[x, y - half, 0], [x + 10, y + half, z - half]],
        [[x, y - half, z + half], [x + 10, y + half, 60]],
    ]


def test_a_gap_closed_on_the_coarse_grid_is_found_on_the_fine_one():
    # 4 m cells: nodes at 48 and 52, whose cells reach out of the door; 2 m cells: a node at 50.
    flown = scene(door(5.5), item=(380.0, 20, 30), depot=(10.0, 20, 30))
    guide = Guidance(flown, 0, flown.depot)
    assert least_gap(guide.path, flown.obstacles) >= RADIUS - 1e-9
    inside = (guide.path[:-1, 0] - 205) * (guide.path[1:, 0] - 205) <= 0
    assert inside.any()
    jamb = np.array([[200.0, 0, 0], [210, 47.25, 60]])
    shortest = wrapped(flown.depot, flown.items[0], jamb, RADIUS)
    assert shortest * (1 - 1e-9) <= path_length(guide.path) <= 1.02 * shortest
    distance, _ = guide.query(flown.depot[None])
    assert np.isfinite(distance[0])


def test_a_gap_too_narrow_for_the_finest_grid_raises():
    # The body fits, so the scene itself is not refused.
    flown = scene(door(1.5), item=(380.0, 20, 30), depot=(10.0, 20, 30))
    with pytest.raises(GuidanceError, match=r"no passage from \[10.0, 20.0, 30.0\] to items\[0\]"):
        Guidance(flown, 0, flown.depot)


def test_the_depot_is_named_where_it_cannot_be_reached():
    flown = scene(door(1.5), item=(380.0, 20, 30), depot=(10.0, 20, 30))
    with pytest.raises(GuidanceError, match="to the depot"):
        Guidance(flown, -1, flown.items[0])


def test_an_item_too_close_to_a_box_is_aimed_at_beside_it():
    # 0.2 m from the face: the body's centre must stay 0.5 m away, the item's ball is 5 m wide.
    flown = scene([[[300.0, 20, 20], [340, 40, 40]]], item=(299.8, 30, 30))
    guide = Guidance(flown, 0, flown.depot)
    assert np.linalg.norm(guide.aim - guide.goal) < flown.epsilon
    assert 300.0 - guide.aim[0] >= RADIUS
    assert guide.length == pytest.approx(path_length(guide.path) + math.dist(guide.aim, guide.goal))


# The law


def fly(course, start, count=8, seed=0):
    """Share of episodes that succeed, and any crash, flown by the law to the end."""
    sims = Simulations([course], count, start=start, rng=np.random.default_rng(seed), threads=1)
    sims.reset()
    won, lost = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for _ in range(course.step_limit):
        outcome = sims.step(sims.episodes.guidance_action())
        won |= outcome.success & ~lost
        lost |= outcome.slot.crashed & ~won
        if np.all(won | lost):
            break
    sims.close()
    return won, lost


def test_the_law_arrives_on_a_free_segment(free_course):
    won, _ = fly(free_course, "ball")
    assert won.all()


def test_the_law_arrives_on_a_blocked_segment(blocked_course):
    won, _ = fly(blocked_course, "ball")
    assert won.all()


def law(course, q, v):
    """Actions of the law from states (n, 3)."""
    episodes = Episodes([course], len(q), Rules())
    episodes.reset(np.arange(len(q)), q, v)
    return episodes.guidance_action()


def test_the_law_stays_in_the_unit_ball_and_brakes_for_the_goal(free_course):
    rng = np.random.default_rng(0)
    q = rng.uniform(FLAT[0], FLAT[1], (300, 3))
    v = rng.normal(size=(300, 3))
    v *= rng.uniform(0, 50, (300, 1)) / np.linalg.norm(v, axis=1, keepdims=True)
    assert np.all(np.linalg.norm(law(free_course, q, v), axis=1) <= 1 + 1e-12)
    near, fast = free_course.guidance[0].goal[None] - [20.0, 0, 0], np.array([[45.0, 0, 0]])
    np.testing.assert_allclose(law(free_course, near, fast), [[-1.0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize("item", [60.0, 139.0, 263.0, 391.0])
def test_the_law_is_within_two_slots_of_the_least_time_on_a_free_segment(item):
    flown = scene([], item=(item, 31, 29), depot=(5.0, 30, 30))
    course = Course.segment(flown, (0,), 0)
    sims = Simulations([course], 1, threads=1)
    sims.place(np.array([0]), *course.starts("point", 1, np.random.default_rng(0)))
    slots = 1
    while not sims.step(sims.episodes.guidance_action()).success[0]:
        slots += 1
    sims.close()
    away = np.linalg.norm(flown.items[0] - flown.depot) - flown.epsilon
    least = float(leg_time(away, flown.v_max, flown.a_max))
    assert least <= slots * flown.slot <= least + 2 * flown.slot


@pytest.mark.parametrize(("layout", "seed"), [("floating", 1), ("floating", 2), ("city", 3)])
def test_the_law_flies_generated_missions_without_contact(layout, seed):
    flown = generate(seed, 3, layout=layout)
    won, lost = fly(Course.mission(flown, (0, 1, 2)), "ball", count=4)
    assert won.all()
    assert not lost.any()


def test_an_aim_in_a_corner_keeps_room_to_the_bounds():
    """A depot in the corner of the bounds is flown to from inside, within its tolerance."""
    flown = scene([], item=(200.0, 30, 30), depot=(0.0, 0, 0))
    guide = Guidance(flown, -1, flown.items[0])
    assert np.all(guide.aim >= 1.5)
    assert np.linalg.norm(guide.aim - flown.depot) < 0.8 * flown.return_tolerance
    assert guide.length == pytest.approx(np.linalg.norm(flown.items[0] - flown.depot))


@pytest.mark.parametrize("gap", [1.0, 2.5])
def test_an_aim_close_to_a_box_is_in_sight(gap):
    """The last metres are exact beside a box, too, not read off blocked cells of the grid."""
    flown = scene([[[300.0, 20, 20], [340, 40, 40]]], item=(300.0 - gap, 30, 30))
    guide = Guidance(flown, 0, flown.depot)
    q = guide.aim - np.array([[0.3, 0, 0], [4.0, 1, -2], [60.0, 20, 10]])
    distance, direction = guide.query(q)
    straight = np.linalg.norm(guide.aim - q, axis=1)
    np.testing.assert_allclose(distance, straight, rtol=1e-12)
    np.testing.assert_allclose(direction, (guide.aim - q) / straight[:, None], atol=1e-12)
