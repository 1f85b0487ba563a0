from __future__ import annotations

import math

import numpy as np
import pytest
from crowds import FLAT, RADIUS, crowded, gaps, least_gap
from scipy.interpolate import RegularGridInterpolator

from mjcollect.generate import generate
from mjcollect.geometry.boxes import inflate
from mjcollect.geometry.polyline import path_length
from mjcollect.guidance.aim import AIM_ROOM, AIM_SHARE, choose_aim
from mjcollect.guidance.guidance import Guidance, GuidanceError
from mjcollect.scene.scene import Scene


def scene(obstacles, item=(380.0, 30, 30), depot=(10.0, 30, 30), **fields) -> Scene:
    return Scene("t", 0, FLAT, depot, [item], obstacles, **fields)


def random_scene(seed) -> Scene:
    """Six boxes that leave room between them."""
    rng = np.random.default_rng(seed)
    low = np.stack([40.0 + 55 * np.arange(6), rng.uniform(0, 20, 6), rng.uniform(0, 20, 6)], 1)
    size = np.stack([rng.uniform(5, 30, 6), rng.uniform(20, 40, 6), rng.uniform(20, 40, 6)], 1)
    return scene(np.stack([low, np.minimum(low + size, FLAT[1])], axis=1))


def free_points(flown, count, seed=0):
    """Random points in bounds where the body touches nothing."""
    points = np.random.default_rng(seed).uniform(*FLAT, (8 * count, 3))
    return points[gaps(points, flown.obstacles) > RADIUS][:count]


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
    # What is flown keeps room at the corners.
    distance, _ = guide.query(flown.depot[None])
    assert shortest * (1 - 1e-9) <= distance[0] <= 1.02 * shortest


@pytest.mark.parametrize("box", [[[190.0, 0, 0], [210, 50, 60]], [[250.0, 0, 0], [252, 40, 60]]])
def test_before_a_wall_distances_are_the_analytic_shortest_and_little_more(box):
    """The wall spans all heights: a string round it, unrolled, is straight in the third axis."""
    flown = scene([box])
    guide = Guidance(flown, 0, flown.depot)
    q = np.random.default_rng(0).uniform([2, 3, 3], [box[0][0] - 30, 30, 57], (400, 3))
    shortest = np.array(
        [math.hypot(wrapped(p, guide.aim, np.array(box), RADIUS), p[2] - guide.aim[2]) for p in q]
    )
    distance, direction = guide.query(q)
    assert np.all(distance >= shortest * (1 - 1e-9))
    assert np.median(distance / shortest) < 1.015
    assert np.mean(distance / shortest < 1.05) > 0.9
    # All go round the end of the wall, none into it.
    assert np.all(direction[:, 0] > 0.0)
    assert np.all(q[:, 1] + direction[:, 1] / direction[:, 0] * (box[0][0] - q[:, 0]) > box[1][1])


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


def crosses(start, end, boxes):
    """Whether a segment meets any box (M, 2, 3): by clipping it at the faces."""
    step = end - start
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    faces = (boxes - start) / step
    enter, leave = faces.min(axis=1).max(axis=1), faces.max(axis=1).min(axis=1)
    return bool(np.any((enter <= leave) & (leave >= 0) & (enter <= 1)))


def field_value(way, q):
    """Value by scipy of the finest field that is defined at q."""
    for field in reversed(range(len(way.first))):
        axes = [
            way.low[field, k] + way.spacing[field, k] * np.arange(way.nodes[field, k])
            for k in range(3)
        ]
        if any(not axis[0] <= x <= axis[-1] for x, axis in zip(q, axes, strict=True)):
            continue
        values = way.values[way.first[field] :][: np.prod(way.nodes[field])]
        values = values.reshape(way.nodes[field]).astype(float)
        found = RegularGridInterpolator(axes, values)(q)[0]
        if np.isfinite(found):
            return found
    return np.inf


@pytest.mark.parametrize("seed", range(3))
def test_distances_are_over_waypoints_in_sight_and_else_the_field_s(seed):
    flown = crowded(seed, 12)
    guide = Guidance(flown, 0, flown.depot)
    way, counts = guide.way, {"aim": 0, "corner": 0, "field": 0}
    hiding = [inflate(flown.boxes, margin) for margin in way.margin]
    for q in free_points(flown, 150, seed):
        seen = [not crosses(q, *pair) for pair in zip(way.points, hiding, strict=True)]
        whole = np.where(seen, np.linalg.norm(way.points - q, axis=1) + way.remaining, np.inf)
        distance, direction = guide.query(q[None])
        straight = np.linalg.norm(guide.aim - q)
        field = max(field_value(way, q), straight)
        if seen[-1]:
            expected, to = straight, way.points[-1]
            counts["aim"] += 1
        elif whole.min() <= field + 1.0:
            expected, to = whole.min(), way.points[whole.argmin()]
            counts["corner"] += 1
        else:
            assert distance[0] == pytest.approx(field, rel=1e-9)
            counts["field"] += 1
            continue
        assert distance[0] == pytest.approx(expected, rel=1e-9)
        np.testing.assert_allclose(direction[0], (to - q) / np.linalg.norm(to - q), atol=1e-9)
    assert min(counts.values()) >= 5, counts


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


def test_an_item_in_a_tunnel_closed_on_the_coarse_grids_is_found():
    """There the nodes seen from the aim have no free neighbours at all."""
    tunnel = np.array(door(5.5))
    tunnel[:, 0, 0], tunnel[:, 1, 0] = 100.0, 250.0
    flown = scene(tunnel, item=(170.0, 50, 30), depot=(10.0, 20, 30))
    guide = Guidance(flown, 0, flown.depot)
    assert least_gap(guide.path, flown.obstacles) >= RADIUS - 1e-9
    edge = (100.0, 47.25)  # of the tunnel's mouth, round which the way leads
    around = math.dist(flown.depot[:2], edge) + math.dist(edge, guide.aim[:2])
    assert around <= path_length(guide.path) <= 1.02 * around


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


# Aims


def test_on_a_tour_aims_are_moved_inside_its_turn():
    """Against the best of all points of the ball: both ways together get shorter, with room kept.

    An aim 0.6 of the tolerance away wins at least half of that where the tour turns sharply.
    """
    rng, moved, sharp = np.random.default_rng(0), 0, 0
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    for seed in range(40):
        made = generate(seed, 3, obstacles=10)
        start, goal, beyond = made.items
        aim = choose_aim(made, goal, made.epsilon, start, beyond)
        assert np.linalg.norm(aim - goal) <= AIM_SHARE * made.epsilon + 1e-9
        assert gaps(aim[None], made.obstacles)[0] >= RADIUS + AIM_ROOM
        assert np.all((aim >= made.bounds[0] + AIM_ROOM) & (aim <= made.bounds[1] - AIM_ROOM))
        room = np.minimum(goal - made.bounds[0], made.bounds[1] - goal).min()
        if room < made.epsilon + AIM_ROOM:  # boxes are 10 m away, bounds may be nearer
            continue
        around = [
            np.linalg.norm(points - start, axis=-1) + np.linalg.norm(points - beyond, axis=-1)
            for points in (goal, aim, goal + made.epsilon * sphere)
        ]
        assert around[1] < around[0]
        moved += 1
        there, onward = (goal - start) / math.dist(goal, start), beyond - goal
        if np.linalg.norm(onward / np.linalg.norm(onward) - there) > 1.0:  # by more than 60 degrees
            assert around[0] - around[1] >= 0.5 * (around[0] - around[2].min())
            sharp += 1
    assert moved >= 30
    assert sharp >= 15


def test_without_a_turn_or_without_room_aims_stay():
    flown = scene([[[300.0, 20, 20], [340, 40, 26]]], item=(320.0, 30, 30))
    goal = flown.items[0]
    ahead, back = np.array([390.0, 30, 30]), np.array([20.0, 30, 30])
    for beyond in (None, ahead, goal + 4.0):
        aim = choose_aim(flown, goal, 5.0, flown.depot, beyond)
        np.testing.assert_allclose(aim, goal, atol=1e-9)
    np.testing.assert_allclose(choose_aim(flown, goal, 5.0, flown.depot, back)[0], 317.0)
    # The turn's inside lies towards the box: not there.
    below = choose_aim(flown, goal, 5.0, np.array([310.0, 30, 15]), np.array([330.0, 30, 15]))
    assert gaps(below[None], flown.obstacles)[0] >= RADIUS + AIM_ROOM
    assert below[2] >= goal[2] - 1e-9


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
