"""Touches are seen at every angle and speed; a pass one millimetre away is not a touch.

A line tangent to the box's normal cone has a least distance to the box known by construction:
the plane through the point p with normal n supports the convex box, so the line p + D n + s t with
t orthogonal to n keeps the distance D from the plane and attains it at s = 0.
"""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mjcollect.flight.contact import contacts, judge, leaves_bounds
from mjcollect.flight.world import World
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.scene import Scene

BOX = np.array([[400.0, 420, 380], [460.0, 520, 430]])
RADIUS, MM = 0.5, 1e-3
WALL_X, DOOR = (500.0, 502.0), np.array([498.5, 501.5])  # 2 m thick, 3 m wide
WALL = [
    [[WALL_X[0], 0, 0], [WALL_X[1], DOOR[0], 1000]],
    [[WALL_X[0], DOOR[1], 0], [WALL_X[1], 1000, 1000]],
    [[WALL_X[0], DOOR[0], 0], [WALL_X[1], DOOR[1], DOOR[0]]],
    [[WALL_X[0], DOOR[0], DOOR[1]], [WALL_X[1], DOOR[1], 1000]],
]
unit = st.floats(0.0, 1.0)
speeds = st.floats(1.0, 50.0)


def scene(obstacles=(BOX,), **fields) -> Scene:
    return Scene("t", 0, [[0] * 3, [1000] * 3], [5.0] * 3, [[990.0] * 3], obstacles, **fields)


@cache
def simulator(kind="box", physics_step=0.02):
    """Model, data and world of the box or of the wall with a door."""
    flown = scene([BOX] if kind == "box" else WALL, physics_step=physics_step)
    model = compile_model(flown)
    return model, mujoco.MjData(model), World.stack([flown])


def coast(q, v, slots, kind="box", physics_step=0.02):
    """Fly `slots` slots without thrust; the judged slots, the sensor (slots, n), and the path."""
    model, data, world = simulator(kind, physics_step)
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = q, v
    judged, sensed, path = [], [], [np.array(q)]
    for _ in range(slots):
        start, steps, touch = data.qpos.copy(), [], []
        for _ in range(world.substeps):
            mujoco.mj_step(model, data)
            steps.append(data.qpos.copy())
            touch.append(data.sensordata[0] > 0)
        no = np.array([False])
        judged.append(judge(world, start[None], np.array([steps]), np.array([touch]), no))
        sensed.append(touch)
        path += steps
    return judged, np.array(sensed), np.array(path)


def touched(judged) -> bool:
    return any(bool(slot.contact[0]) for slot in judged)


@st.composite
def tangents(draw):
    """A point of the box's surface, an outward normal there, and a direction across it."""
    signs = np.array(draw(st.tuples(*[st.sampled_from([-1, 0, 1])] * 3).filter(any)))
    share = np.array(draw(st.tuples(unit, unit, unit)))
    weight = np.array(draw(st.tuples(*[st.floats(0.1, 1.0)] * 3)))
    point = np.where(
        signs < 0, BOX[0], np.where(signs > 0, BOX[1], BOX[0] + share * (BOX[1] - BOX[0]))
    )
    normal = signs * weight
    normal = normal / np.linalg.norm(normal)
    angle = draw(st.floats(0.0, 2 * np.pi))
    one = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    one = one / np.linalg.norm(one)
    two = np.cross(normal, one)
    return point, normal, np.cos(angle) * one + np.sin(angle) * two


EDGE = (
    np.array([460.0, 520, 400]),
    np.array([1.0, 1, 0]) / 2**0.5,
    np.array([1.0, -1, 0]) / 2**0.5,
)
CORNER = (BOX[1], np.ones(3) / 3**0.5, np.array([1.0, -1, 0]) / 2**0.5)
FACE = (np.array([430.0, 520, 400]), np.array([0.0, 1, 0]), np.array([1.0, 0, 0]))


def graze(tangent, distance, speed, phase, physics_step):
    """Start and velocity of a straight pass at `distance`, `phase` into its second slot."""
    point, normal, across = tangent
    velocity = speed * across
    nearest = point + distance * normal
    return nearest - velocity * 0.2 * (1.0 + phase), velocity


@pytest.mark.parametrize("physics_step", [0.02, 0.2])
@settings(max_examples=80, deadline=None)
@given(tangents(), speeds, unit)
@example(EDGE, 50.0, 0.55)
@example(CORNER, 50.0, 0.5)
@example(FACE, 50.0, 0.0)
def test_a_graze_one_millimetre_deep_is_a_contact(physics_step, tangent, speed, phase):
    q, v = graze(tangent, RADIUS - MM, speed, phase, physics_step)
    judged, _, _ = coast(q, v, 3, physics_step=physics_step)
    assert touched(judged)


@pytest.mark.parametrize("physics_step", [0.02, 0.2])
@settings(max_examples=80, deadline=None)
@given(tangents(), speeds, unit)
@example(EDGE, 50.0, 0.5)
@example(FACE, 50.0, 0.0)
def test_a_pass_one_millimetre_outside_is_none(physics_step, tangent, speed, phase):
    q, v = graze(tangent, RADIUS + MM, speed, phase, physics_step)
    judged, _, path = coast(q, v, 3, physics_step=physics_step)
    assert not touched(judged)
    np.testing.assert_allclose(path[-1], q + 0.6 * v, rtol=0, atol=1e-9)  # nothing pushed it


@settings(max_examples=80, deadline=None)
@given(tangents(), st.floats(0.3, np.pi / 2), st.floats(10.0, 50.0), st.sampled_from([-MM, MM]))
def test_a_touch_on_the_last_substep_counts_in_that_slot(tangent, dive, speed, depth):
    point, normal, across = tangent  # a step before, the body is at least 5 cm farther out
    velocity = speed * (np.cos(dive) * across - np.sin(dive) * normal)
    end = point + (RADIUS - depth) * normal
    judged, sensed, path = coast(end - 0.4 * velocity, velocity, 2)
    assert not sensed.any()  # the sensor would tell a slot late
    np.testing.assert_allclose(path[-1], end, rtol=0, atol=1e-9)
    assert [bool(slot.contact[0]) for slot in judged] == [False, depth > 0]
    assert judged[1].first_event[0] == (9 if depth > 0 else 10)


@pytest.mark.parametrize("tangent", [EDGE, CORNER], ids=["edge", "corner"])
@pytest.mark.parametrize("distance", [RADIUS - MM, RADIUS - 0.2], ids=["1 mm", "0.2 m"])
def test_the_sensor_alone_is_blind_between_two_states(tangent, distance):
    # At 50 m/s the body moves its own diameter in a step: half a step before and after the edge.
    q, v = graze(tangent, distance, 50.0, 0.55, 0.02)
    judged, sensed, _ = coast(q, v, 3)
    assert not sensed.any()
    assert touched(judged)
    assert [int(slot.first_event[0]) for slot in judged] == [10, 5, 10]


def nearest_on_line(q, v, seconds, boxes, samples=20001):
    """Brute force: least sampled distance of a straight flight to the boxes, and its error."""
    points = q + np.linspace(0.0, seconds, samples)[:, None] * v
    gap = np.inf
    for box in boxes:
        over = np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0)
        gap = min(gap, float(np.sqrt((over**2).sum(axis=1)).min()))
    return gap, float(np.linalg.norm(v)) * seconds / samples


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 2),  # where it crosses the wall, from the door's centre
    st.tuples(*[st.floats(-0.5, 0.5)] * 2),  # how much across for a metre ahead
    speeds,
    unit,
    st.sampled_from([-1.0, 1.0]),
)
@example((0.0, 0.0), (0.0, 0.0), 50.0, 0.3, 1.0)
@example((0.98, -0.98), (0.0, 0.0), 50.0, 0.7, -1.0)
@example((3.0, 0.0), (0.0, 0.0), 50.0, 0.5, 1.0)
def test_a_wall_is_passed_through_its_door_only(cross, lean, speed, phase, side):
    heading = np.array([side, *lean])
    v = speed * heading / np.linalg.norm(heading)
    middle = np.array([501.0, 500.0 + cross[0], 500.0 + cross[1]])
    lead = (3.0 + 2.0 * phase) / abs(v[0])  # seconds to the wall's middle
    slots = int(np.ceil(2.5 * lead / 0.2))
    q = middle - v * lead
    judged, _, path = coast(q, v, slots, kind="wall")
    gap, error = nearest_on_line(q, v, slots * 0.2, np.array(WALL))
    if not RADIUS < gap < RADIUS + error:  # sampling can only overestimate
        assert touched(judged) == (gap <= RADIUS)
    if not touched(judged):
        assert side * (path[-1, 0] - 501.0) > 0
        assert np.all(np.abs(cross) <= 1.0)  # 1.5 m to the jamb, less the body


@pytest.mark.parametrize("speed", [1.0, 10.0, 33.3, 50.0])
@pytest.mark.parametrize("cross", [(0.0, 0.0), (0.999, 0.999), (-0.999, 0.5)])
def test_the_door_is_flown_through_without_contact(speed, cross):
    q = [495.0, 500.0 + cross[0], 500.0 + cross[1]]
    judged, _, path = coast(q, [speed, 0.0, 0.0], int(np.ceil(12.0 / speed / 0.2)), kind="wall")
    assert path[-1, 0] > 503.0
    assert not touched(judged)


@pytest.mark.parametrize("speed", [1.0, 10.0, 33.3, 50.0])
@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("physics_step", [0.02, 0.2])
def test_the_wall_is_never_flown_through(speed, phase, physics_step):
    ahead = 5.0 + phase * speed * physics_step
    slots = int(np.ceil((ahead + 3.0) / speed / 0.2))
    q = [WALL_X[0] - ahead, 300.0, 700.0]
    judged, _, path = coast(q, [speed, 0.0, 0.0], slots, kind="wall", physics_step=physics_step)
    assert touched(judged)
    first = next(k for k, slot in enumerate(judged) if slot.contact[0])
    step = first * len(path[1:]) // slots + int(judged[first].first_event[0])
    # Seen in the very step that reaches the wall.
    assert path[step, 0] <= WALL_X[0] - RADIUS <= path[step + 1, 0]


def test_worlds_of_different_box_counts_are_judged_each_by_its_own():
    rng = np.random.default_rng(0)
    scenes = [scene([BOX]), scene([]), scene([BOX + 100.0, BOX, BOX - 200.0]), scene(WALL)]
    start = rng.uniform(380, 520, (400, len(scenes), 3))
    path = start[:, :, None] + np.cumsum(rng.uniform(-8, 8, (400, len(scenes), 10, 3)), axis=2)
    together, hits = World.stack(scenes), np.zeros(len(scenes))
    assert together.boxes.shape == (4, 4, 2, 3)
    for q, steps in zip(start, path, strict=True):
        whole = np.concatenate([q[:, None], steps], axis=1)
        none = np.zeros((len(scenes), 10), dtype=bool)
        touch = contacts(together, whole, none)
        for index, alone in enumerate(scenes):
            world = World.stack([alone])
            piece = slice(index, index + 1)
            np.testing.assert_array_equal(touch[piece], contacts(world, whole[piece], none[piece]))
        hits += touch.any(axis=1)
    assert hits[1] == 0
    assert np.all(hits[[0, 2, 3]] > 10)


def test_padding_is_never_touched_however_far_the_body_strays():
    world = World.stack([scene([]), scene([BOX])])
    points = np.random.default_rng(1).uniform(-1e5, 1e5, (200, 2, 11, 3))
    for path in points:
        touch = contacts(world, path, np.zeros((2, 10), dtype=bool))
        assert not touch[0].any()


def test_what_the_sensor_says_counts_even_where_the_sweep_sees_nothing():
    world = World.stack([scene([])])
    sensed = np.zeros((1, 10), dtype=bool)
    sensed[0, 4] = True
    slot = judge(world, np.full((1, 3), 50.0), np.full((1, 10, 3), 50.0), sensed, np.array([True]))
    assert slot.contact[0]
    assert slot.first_event[0] == 4
    assert not slot.arrived[0]


def test_scenes_of_another_slot_cannot_share_a_world():
    with pytest.raises(ValueError, match=r"slot 0\.2 and 0\.4"):
        World.stack([scene(), scene(slot=0.4)])


# Bounds, and the first event


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, 1])
def test_bounds_are_inclusive_to_a_micrometre(axis, side):
    world = World.stack([scene([])])
    outward = 2 * side - 1
    inside = np.full((1, 1, 3), 500.0)
    path = np.repeat(inside, 4, axis=1)
    path[0, :, axis] = world.bounds[0, side, axis] + outward * np.array([0.0, 0.9e-6, 1.1e-6, 5.0])
    assert leaves_bounds(world, path).tolist() == [[False, False, True, True]]


def test_a_slot_is_judged_by_its_first_event():
    world = World.stack([scene([])])
    start, none = np.full((1, 3), 500.0), np.zeros((1, 10), dtype=bool)
    path = np.full((1, 10, 3), 500.0)
    calm = judge(world, start, path, none, np.array([True]))
    assert (calm.arrived[0], calm.crashed[0], calm.first_event[0]) == (True, False, 10)
    assert not judge(world, start, path, none, np.array([False])).arrived[0]
    path[0, 6, 2], sensed = -1.0, none.copy()
    out = judge(world, start, path, sensed, np.array([True]))
    assert (out.arrived[0], out.outside[0], out.contact[0]) == (False, True, False)
    assert out.first_event[0] == 6
    sensed[0, 3] = True
    both = judge(world, start, path, sensed, np.array([True]))
    assert both.contact[0]
    assert both.outside[0]
    assert both.first_event[0] == 3
