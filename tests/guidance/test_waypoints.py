"""Waypoints: corners with room around them, and what is stored with each."""

from __future__ import annotations

import math

import numpy as np
import pytest
from crowds import FLAT, RADIUS, crowded, dense, gaps, least_gap
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mjcollect.geometry.polyline import path_length
from mjcollect.guidance.distance_field import WAY_ROOM
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.waypoints import CUT_SHARE, LEAST_CUT, SHIFT_SHARE, STRAIGHT_SIGHT
from mjcollect.scene.scene import Scene


def scene(obstacles, item=(380.0, 30, 30), depot=(10.0, 30, 30), **fields) -> Scene:
    return Scene("t", 0, FLAT, depot, [item], obstacles, **fields)


def polyline(guide):
    """The way flown, (P + 1, 3), start included."""
    return np.concatenate([guide.start[None], guide.way.points])


def check(guide):
    """What holds of any way: numbers that agree with its points, inside bounds, clear of boxes."""
    way, points = guide.way, polyline(guide)
    count = len(way.points)
    np.testing.assert_allclose(way.points[-1], guide.aim, rtol=0, atol=1e-9)
    for p in range(count):
        rest = sum(math.dist(way.points[i], way.points[i + 1]) for i in range(p, count - 1))
        assert way.remaining[p] == pytest.approx(rest, abs=1e-9)
        if p < count - 1:
            onward = way.points[p + 1] - way.points[p]
            length = np.linalg.norm(onward)
            np.testing.assert_allclose(way.next_direction[p] * length, onward, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(way.next_direction, axis=1), 1.0)
    assert way.cut.shape == (count,)
    assert np.all((way.cut > 0) & np.isfinite(way.cut))
    assert np.all((points >= guide.scene.bounds[0]) & (points <= guide.scene.bounds[1]))
    assert least_gap(points, guide.scene.obstacles) >= RADIUS - 1e-9
    # A corner takes a detour to keep room, never a short cut.
    assert path_length(points) >= path_length(guide.path) * 0.98


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 16), st.booleans())
def test_among_boxes_with_room_between_them_the_promised_room_is_kept(seed, boxes, back):
    flown = crowded(seed, boxes)
    guide = Guidance(flown, -1, flown.items[0]) if back else Guidance(flown, 0, flown.depot)
    check(guide)
    points = polyline(guide)
    promised = STRAIGHT_SIGHT if len(points) == 2 else SHIFT_SHARE * WAY_ROOM
    assert least_gap(points, flown.obstacles) >= RADIUS + promised - 1e-9
    assert path_length(points) <= 1.15 * path_length(guide.path)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
@example(942)  # the corners of inflated boxes hid the first waypoint from the start
def test_along_the_way_some_waypoint_or_the_aim_is_always_in_sight(seed):
    """So that on the way distances are its length, without the field."""
    flown = crowded(seed, 10)
    guide = Guidance(flown, 0, flown.depot)
    points = polyline(guide)
    length = np.cumsum([0.0, *np.linalg.norm(np.diff(points, axis=0), axis=1)])
    at = np.linspace(0.0, length[-1] - 0.1, 200)
    q = np.stack([np.interp(at, length, points[:, k]) for k in range(3)], axis=1)
    distance, direction = guide.query(q)
    left = length[-1] - at
    assert np.all(distance <= left + 1e-6)
    assert np.all(distance >= np.linalg.norm(guide.aim - q, axis=1) - 1e-9)
    # To be followed: a step along the direction shortens what is left by as much.
    after, _ = guide.query(q + 0.05 * direction)
    assert np.mean(np.abs(distance - after - 0.05) < 1e-6) > 0.95


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 2.0), st.integers(0, 2), st.booleans())
@example(14937, 0.5, 0, False)  # nodes that the aim sees, in cells that are not free throughout
def test_starts_and_aims_beside_boxes(seed, room, axis, high):
    """The start touches nearly a side of one box, and the item one of another."""
    flown = crowded(seed, 8)
    points = []
    for box in (flown.obstacles[0], flown.obstacles[-1]):
        point = box.mean(axis=0)
        inner = [k for k in range(3) if box[0, k] > FLAT[0, k] and box[1, k] < FLAT[1, k]]
        side = axis if axis in inner else inner[0] if inner else 0
        point[side] = box[1, side] + RADIUS + room if high else box[0, side] - RADIUS - room
        points.append(point)
    start, item = points
    beside = Scene("beside", 0, FLAT, start, [item], flown.obstacles)
    for guide in (Guidance(beside, 0, start), Guidance(beside, -1, item)):
        check(guide)
        assert np.linalg.norm(guide.aim - guide.goal) <= guide.tolerance


def test_without_boxes_the_aim_is_the_only_waypoint():
    guide = Guidance(scene([]), 0, np.array([10.0, 30, 30]))
    np.testing.assert_array_equal(guide.way.points, [[380.0, 30, 30]])
    np.testing.assert_array_equal(guide.way.remaining, [0.0])
    check(guide)


@pytest.mark.parametrize("v_max", [5.0, 20.0, 35.0, 50.0])
def test_corners_are_moved_outwards_by_what_is_cut_of_them(v_max):
    """A turn at v_max cuts v^2 |u - w|^2 / (8 a) metres: so far a corner is moved."""
    wall = np.array([[190.0, 0, 0], [192, 40, 60]])
    start, end = np.array([10.0, 30, 30]), np.array([380.0, 30, 30])
    guide = Guidance(scene([wall], v_max=v_max), 0, start)
    check(guide)
    corner, unit = guide.way.points[0], guide.scene.unit
    there = (corner - start) / math.dist(corner, start)
    onward = (end - corner) / math.dist(end, corner)
    moved = guide.way.cut[0] - (CUT_SHARE * WAY_ROOM + LEAST_CUT) * unit
    assert moved == pytest.approx(v_max**2 * np.sum((onward - there) ** 2) / (8 * 20.0), rel=0.1)
    above = corner[1] - wall[1, 1]
    assert RADIUS + (WAY_ROOM - 0.1) * unit < above < RADIUS + WAY_ROOM * unit + 2.0


@pytest.mark.parametrize("room", [1.0, 1.5, 2.0, 4.0])
def test_a_passage_with_less_room_is_flown_in_its_middle_or_as_near_as_it_goes(room):
    """A slit between two boxes that leaves `room` on both sides of the body.

    Narrower ones are not found on the finest grid and refused, see `test_guidance`.
    """
    half = RADIUS + room
    boxes = [[[200.0, 0, 0], [206, 40 - half, 60]], [[200.0, 40 + half, 0], [206, 60, 60]]]
    guide = Guidance(scene(boxes), 0, np.array([10.0, 30, 30]))
    check(guide)
    inside = dense(polyline(guide))
    inside = inside[(inside[:, 0] >= 200) & (inside[:, 0] <= 206)]
    assert gaps(inside, np.array(boxes)).min() >= RADIUS + 0.39 * min(room, WAY_ROOM) - 1e-9


@pytest.mark.parametrize("beside", [0.55, 0.9, 2.0])
def test_between_goals_beside_walls_a_way_keeps_clearance(beside):
    """Both ends are nearer to a wall than the way is to the boxes between them."""
    walls = np.array(
        [
            [[0.0, 0.0, 0.0], [60.0, 28.0, 60.0]],
            [[150.0, 20.0, 0.0], [170.0, 60.0, 60.0]],
            [[340.0, 32.0, 0.0], [400.0, 60.0, 60.0]],
        ]
    )
    ends = {"depot": (30.0, 28.0 + beside, 30.0), "item": (370.0, 32.0 - beside, 30.0)}
    guide = Guidance(scene(walls, **ends), 0, np.array(ends["depot"]))
    points = polyline(guide)
    check(guide)
    far = (points[:, 0] > 60.0) & (points[:, 0] < 340.0)
    midway = points[np.flatnonzero(far)[0] : np.flatnonzero(far)[-1] + 1]
    assert least_gap(midway, walls) >= RADIUS + SHIFT_SHARE * WAY_ROOM - 1e-9
    assert np.sort(guide.way.cut)[-1] >= 1.0  # A corner round the box may be cut.
