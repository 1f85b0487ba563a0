"""Turned boxes against MuJoCo's own distances, and against boxes that are not turned."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.boxes import (
    box_offset,
    inflate,
    nearest_point_offset,
    point_box_distance,
    segment_box_distance,
    slab,
)
from mjcollect.geometry.occupancy import blocked_grid
from mjcollect.geometry.turns import (
    around,
    corners,
    from_axes,
    in_axes,
    inside,
    is_near,
    joined,
    turned,
    with_turn,
)
from mjcollect.planners.separating_planes import separate

numbers = st.floats(-40, 40)
points = st.tuples(numbers, numbers, numbers).map(np.array)
sizes = st.tuples(*[st.floats(0.5, 15)] * 3).map(np.array)
yaws = st.floats(-180, 180)


@st.composite
def boxes(draw):
    """A box (1, 2, 3) and its yaw (1,)."""
    centre, half = draw(points), draw(sizes)
    return np.stack([centre - half, centre + half])[None], np.array([draw(yaws)])


def by_mujoco(box, yaw, start, end):
    """The distance from MuJoCo between a box and a thin capsule from start to end."""
    length = float(np.linalg.norm(end - start)) / 2
    spec = mujoco.MjSpec()
    half = np.radians(yaw) / 2
    # The body is turned, not the geom: MuJoCo takes turns of a geom below 2e-6 rad for none.
    turned_body = spec.worldbody.add_body(
        pos=box.mean(axis=0), quat=[np.cos(half), 0, 0, np.sin(half)]
    )
    turned_body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(box[1] - box[0]) / 2)
    body = spec.worldbody.add_body(pos=(start + end) / 2)
    if length < 1e-3:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.25, 0, 0])
    else:
        quat, z = np.empty(4), (end - start) / (2 * length)
        mujoco.mju_quatZ2Vec(quat, z)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.25, length, 0], quat=quat)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 1e3, None) + 0.25


@settings(deadline=None, max_examples=60)
@given(boxes(), points, points)
@example(  # a turn of a hundred-thousandth of a degree
    (np.array([[[-1.0, 0.0, -1.15], [1.0, 12.0, 1.15]]]), np.array([1e-5])),
    np.array([37.971573006808214, 0.0, 0.0]),
    np.array([16.49781445, 20.0, 24.75250607]),
)
def test_distances_are_those_of_mujoco(box, start, end):
    """Apart from each other: what overlaps has no distance."""
    (plain,), (yaw,) = box
    other = turned(*box)
    ours = float(segment_box_distance(start, end, other)[0])
    assume(ours > 0.3)
    assert ours == pytest.approx(by_mujoco(plain, yaw, start, end), abs=2e-3)
    point = float(point_box_distance(start, other)[0])
    assert point == pytest.approx(by_mujoco(plain, yaw, start, start), abs=1e-6)


@settings(deadline=None)
@given(boxes(), points, points)
def test_what_is_turned_with_the_box_sees_the_box_as_it_was(box, start, end):
    """Turned back about the box's centre, everything is as beside a box that is not turned."""
    plain, yaw = box
    other = turned(plain, yaw)
    centre, angle = plain[0].mean(axis=0), np.radians(-yaw[0])
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    a, b = (centre + turn @ (point - centre) for point in (start, end))
    np.testing.assert_allclose(
        segment_box_distance(start, end, other), segment_box_distance(a, b, plain), atol=1e-9
    )
    away = nearest_point_offset(start, other)[0]
    np.testing.assert_allclose(turn @ away, nearest_point_offset(a, plain)[0], atol=1e-9)
    offset = np.empty(3)
    assert box_offset(start, np.ascontiguousarray(other[0]), offset) == pytest.approx(
        np.linalg.norm(away), abs=1e-9
    )
    np.testing.assert_allclose(offset, away, atol=1e-9)
    step, straight = end - start, b - a
    if np.all(np.abs(straight) > 1e-3):
        np.testing.assert_allclose(
            slab(start, step, np.ascontiguousarray(other[0]), 0.5, 1e-12),
            slab(a, straight, np.ascontiguousarray(plain[0]), 0.5, 1e-12),
            rtol=1e-5, atol=1e-6,
        )  # fmt: skip
    grown, was = inflate(other, 1.5), inflate(plain, 1.5)
    np.testing.assert_allclose(
        point_box_distance(start, grown), point_box_distance(a, was), atol=1e-9
    )
    low, high = np.minimum(start, end), np.maximum(start, end)
    if not is_near(low, high, 2.0, np.ascontiguousarray(other[0])):
        assert segment_box_distance(start, end, other)[0] >= 2.0 - 1e-9


@settings(deadline=None)
@given(boxes(), points)
def test_hulls_hold_a_box_and_inner_boxes_lie_in_it(box, point):
    other = turned(*box)
    at = corners(other)[0]
    np.testing.assert_allclose(point_box_distance(at, other[0]), 0.0, atol=1e-9)
    centre = box[0][0].mean(axis=0)
    np.testing.assert_allclose(at.mean(axis=0), centre, atol=1e-9)
    hull, core = around(other)[0], inside(other)[0]
    np.testing.assert_allclose(hull, [at.min(axis=0), at.max(axis=0)], atol=1e-12)
    np.testing.assert_allclose(point_box_distance(corners(core[None])[0], other[0]), 0.0, atol=1e-9)
    assert np.all(core[1] - core[0] > 0)
    back = np.atleast_2d(from_axes(in_axes(point, other), other))
    np.testing.assert_allclose(back[0], point, atol=1e-12)


def test_a_yaw_of_zero_is_the_same_box_to_the_bit():
    rng = np.random.default_rng(0)
    low = rng.uniform(-500, 500, (30, 3))
    plain = np.stack([low, low + rng.uniform(1, 90, (30, 3))], axis=1)
    assert turned(plain, np.zeros(30)) is plain
    other = with_turn(plain)
    start, end = rng.uniform(-500, 500, (2, 40, 1, 3))
    one, two = (segment_box_distance(start, end, each) for each in (plain, other))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(
        nearest_point_offset(start, plain), nearest_point_offset(start, other)
    )
    yaw = np.where(np.arange(30) == 7, 30.0, 0.0)
    np.testing.assert_array_equal(
        np.delete(turned(plain, yaw), 7, axis=0), np.delete(other, 7, axis=0)
    )
    assert joined(plain, turned(plain, yaw), axis=0).shape == (60, 3, 3)


@pytest.mark.parametrize("yaw", [90.0, -90.0, 180.0, 270.0])
def test_right_angles_are_exact(yaw):
    box = np.array([[[10.0, 20, 0], [30, 28, 50]]])
    hull = around(turned(box, np.array([yaw])))[0]
    expected = [[16, 14, 0], [24, 34, 50]] if yaw % 180 else box[0]
    np.testing.assert_array_equal(hull, expected)


@settings(deadline=None, max_examples=50)
@given(boxes(), st.floats(0.2, 3))
def test_free_cells_are_free_throughout(box, radius):
    other = turned(*box)
    bounds = np.array([[-60.0, -60, -60], [60, 60, 60]])
    blocked = blocked_grid(bounds, other, radius, (25, 25, 25))
    spacing, rng = 5.0, np.random.default_rng(0)
    free = np.argwhere(~blocked)
    near = point_box_distance(bounds[0] + free * spacing, other[0]) < radius + 6.0
    for node in free[near]:
        cell = bounds[0] + (node + rng.uniform(-0.5, 0.5, (20, 3))) * spacing
        assert np.all(point_box_distance(cell, other[0]) >= radius - 1e-9)
    # And no cell is blocked whose every part is far from the box.
    for node in np.argwhere(blocked)[::7]:
        at = bounds[0] + node * spacing
        assert point_box_distance(at, other[0]) < radius + np.sqrt(2) * spacing


@settings(deadline=None)
@given(boxes(), st.lists(points, min_size=2, max_size=6))
def test_planes_part_a_path_from_a_turned_box(box, path):
    other, path = turned(*box), np.array(path)
    planes = separate(path, other)
    at = corners(other)[0]
    for piece, normal, offset, clearance in zip(
        planes.piece, planes.normal, planes.offset, planes.clearance, strict=True
    ):
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert (at @ normal).max() == pytest.approx(offset, abs=1e-6)
        ends = path[piece : piece + 2] @ normal - offset
        assert ends.min() == pytest.approx(clearance, abs=1e-9)
        gap = segment_box_distance(path[piece], path[piece + 1], other)[0]
        if gap > 0.1:
            assert clearance == pytest.approx(gap, rel=1e-3, abs=1e-2)


def test_segments_are_clear_of_a_wall_that_stands_at_an_angle():
    wall = turned(np.array([[[-50.0, -1, -50], [50, 1, 50]]]), np.array([45.0]))
    along = np.array([[-30.0, -25, 0], [25, 30, 0]])  # 5 / sqrt(2) m beside it
    assert segment_clear(*along, wall, 2.5)
    assert not segment_clear(*along, wall, 2.6)
    assert not segment_clear(np.array([10.0, -10, 0]), np.array([-10.0, 10, 0]), wall, 0.1)
