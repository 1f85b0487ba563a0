from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.flight.collection import arrests, command
from mjcollect.flight.contact import judge, leaves_bounds
from mjcollect.flight.projection import project
from mjcollect.flight.straight_line import resting_point
from mjcollect.flight.world import World
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.scene import Scene

HOLDS = 1 + 1e-12


def scene(**fields) -> Scene:
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [], **fields)


LIMITS = {
    "default": World.stack([scene()]),
    "slow": World.stack([scene(v_max=5.0, a_max=20.0)]),
    "long slot": World.stack([scene(slot=1.0)]),
    "weak": World.stack([scene(v_max=50.0, a_max=2.0, slot=0.6)]),
}
anything = st.floats(allow_nan=True, allow_infinity=True)
actions = st.tuples(*[anything | st.floats(-2, 2)] * 3).map(np.array)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@st.composite
def velocities(draw):
    """In the v_max = 1 ball, often on its surface."""
    v = draw(vectors)
    size = np.linalg.norm(v)
    if size > 1 or (size > 1e-3 and draw(st.booleans())):
        v = v / size
    return v


@pytest.mark.parametrize("limits", LIMITS)
@settings(max_examples=120, deadline=None)
@given(velocities(), actions)
@example(np.array([1.0, 0, 0]), np.array([np.nan, np.inf, -np.inf]))
@example(np.array([0.0, 0, 0]), np.array([1.7e308, -1.7e308, 1e-308]))
@example(np.array([0.6, 0.8, 0]), np.array([1e200, 1.0, 0.0]))
def test_projected_commands_keep_both_limits(limits, v, action):
    world = LIMITS[limits]
    v = v * world.v_max[0, 0]
    a = project(world, v[None], action[None])[0]
    assert np.linalg.norm(a) <= world.a_max[0, 0] * HOLDS
    assert np.linalg.norm(v + a * world.slot) <= world.v_max[0, 0] * HOLDS


@pytest.mark.parametrize("limits", LIMITS)
@settings(max_examples=100, deadline=None)
@given(velocities(), vectors)
def test_feasible_actions_are_flown_as_they_are(limits, v, action):
    world = LIMITS[limits]
    action = action / max(1.0, np.linalg.norm(action))
    v, wanted = v * world.v_max[0, 0], action * world.a_max[0, 0]
    assume(np.linalg.norm(v + wanted * world.slot) <= world.v_max[0, 0])
    a = project(world, v[None], action[None])[0]
    np.testing.assert_allclose(a, wanted, rtol=0, atol=1e-11)


def test_an_infeasible_action_keeps_its_direction():
    world = LIMITS["default"]
    a = project(world, np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]]))
    np.testing.assert_allclose(a, [[12.0, 16.0, 0.0]])
    # At top speed a push ahead does nothing, a push back is granted in full.
    v = np.array([[50.0, 0, 0], [50.0, 0, 0]])
    a = project(world, v, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    np.testing.assert_allclose(a, [[0, 0, 0], [-20.0, 0, 0]], atol=1e-12)


def test_what_is_not_finite_counts_as_no_command():
    a = project(LIMITS["default"], np.zeros((1, 3)), np.array([[np.nan, np.inf, 0.5]]))
    np.testing.assert_array_equal(a, [[0.0, 0.0, 10.0]])


# The stop that collects


class Stopper:
    """MuJoCo flies one slot with a = -v / slot."""

    def __init__(self, **fields):
        flown = scene(**fields)
        self.world = World.stack([flown])
        self.model = compile_model(flown)
        self.data = mujoco.MjData(self.model)

    def fly(self, q, v):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = q, v
        self.data.ctrl[:] = -v / self.world.slot
        for _ in range(self.world.substeps):
            mujoco.mj_step(self.model, self.data)
        return self.data.qpos.copy(), self.data.qvel.copy()


STOPPERS = {
    "ten steps": Stopper(),
    "one step": Stopper(physics_step=0.2),
    "long slot": Stopper(slot=1.0, physics_step=0.05),
}


@pytest.mark.parametrize("name", STOPPERS)
@settings(max_examples=80, deadline=None)
@given(vectors, vectors, st.floats(0.5, 10.0))
def test_arrests_exactly_where_one_slot_stops_the_body_in_the_ball(
    name, heading, offset, tolerance
):
    stopper = STOPPERS[name]
    world = stopper.world
    goal = np.array([500.0, 400.0, 300.0])
    v = heading * 1.2 * world.a_max[0, 0] * world.slot
    q = goal + offset * 2 * tolerance - v * world.slot / 2
    end, speed = stopper.fly(q, v)
    np.testing.assert_allclose(resting_point(world, q[None], v[None])[0], end, rtol=0, atol=1e-9)
    assert np.linalg.norm(speed) <= 1e-6
    slow = np.linalg.norm(v) / world.slot <= world.a_max[0, 0]
    miss = np.linalg.norm(end - goal)
    stop = arrests(world, q[None], v[None], goal[None], np.array([tolerance]))[0]
    if abs(miss - tolerance) > 1e-9 and abs(np.linalg.norm(v) - 20.0 * world.slot) > 1e-9:
        assert stop == (slow and miss <= tolerance)
    a, flown = command(world, q[None], v[None], np.ones((1, 3)), goal[None], np.array([tolerance]))
    assert flown[0] == stop
    assert np.linalg.norm(a) <= world.a_max[0, 0] * HOLDS
    expected = -v[None] / world.slot if stop else project(world, v[None], np.ones((1, 3)))
    np.testing.assert_array_equal(a, expected)


def test_a_stop_replaces_the_command_only_for_those_that_arrive():
    world = LIMITS["default"]
    q, v = np.array([[10.0, 0, 0], [30.0, 0, 0]]), np.array([[2.0, 0, 0], [2.0, 0, 0]])
    goal, tolerance = np.array([[12.0, 0, 0]] * 2), np.array([5.0, 5.0])
    a, stop = command(world, q, v, np.array([[0.5, 0, 0]] * 2), goal, tolerance)
    assert stop.tolist() == [True, False]
    np.testing.assert_allclose(a, [[-10.0, 0, 0], [10.0, 0, 0]])


@pytest.fixture
def fly(request):
    """Simulations of a course, closed afterwards."""

    def make(course, count=1, **kwargs):
        sims = Simulations([course], count, threads=1, **kwargs)
        request.addfinalizer(sims.close)
        return sims

    return make


def test_a_segment_that_starts_inside_the_ball_takes_exactly_one_slot(free_scene, fly):
    course = Course.segment(free_scene, (0, 1), 1)  # item 1 is 3 m from item 0
    sims = fly(course, 3)
    sims.reset()
    assert not sims.episodes.steps.any()
    push = np.array([[1.0, 0, 0], [0, 0, 0], [-1.0, 1, 1]])
    outcome = sims.step(push)
    assert outcome.success.all()
    assert outcome.terminated.all()
    np.testing.assert_array_equal(sims.episodes.steps, 1)
    np.testing.assert_array_equal(sims.path, np.broadcast_to(free_scene.items[0], (3, 10, 3)))


def test_one_stop_collects_one_item_and_only_the_current_one(free_mission, fly):
    sims = fly(free_mission)
    near_both = free_mission.scene.items.mean(axis=0)
    sims.place(np.array([0]), near_both[None], np.zeros((1, 3)))
    collected = []
    for _ in range(3):
        outcome = sims.step(np.zeros((1, 3)))
        collected.append(sims.episodes.collected[0].tolist())
        assert not outcome.terminated[0]
    assert collected == [[True, False], [True, True], [True, True]]


def test_items_out_of_turn_and_the_depot_are_not_collected(mission_course, fly):
    sims, home = fly(mission_course, 2), mission_course.scene.depot
    # One waits at item 1 while item 0 is due, one at the depot.
    sims.place(np.arange(2), np.array([mission_course.scene.items[1], home]), np.zeros((2, 3)))
    for _ in range(3):
        outcome = sims.step(np.zeros((2, 3)))
        assert not outcome.slot.arrived.any()
        assert not outcome.terminated.any()
    assert not sims.episodes.collected.any()


def test_passing_too_fast_collects_nothing(free_course, fly):
    sims = fly(free_course)
    goal = free_course.scene.items[0]
    sims.place(np.array([0]), goal[None] - [6.0, 0, 0], np.array([[30.0, 0, 0]]))
    arrived = [bool(sims.step(np.zeros((1, 3))).slot.arrived[0]) for _ in range(3)]
    assert sims.episodes.q[0, 0] > goal[0] + 5
    assert arrived == [False] * 3


# Bounds


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, 1])
def test_bounds_are_inclusive_to_a_micrometre(axis, side):
    world = World.stack([scene()])
    outward = 2 * side - 1
    inside = np.full((1, 1, 3), 500.0)
    path = np.repeat(inside, 4, axis=1)
    path[0, :, axis] = world.bounds[0, side, axis] + outward * np.array([0.0, 0.9e-6, 1.1e-6, 5.0])
    assert leaves_bounds(world, path).tolist() == [[False, False, True, True]]


def test_a_slot_is_judged_by_its_first_event():
    world = World.stack([scene()])
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


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"observation": "guide"}, "observation: 'guide': must be one of guided, path, paper"),
        ({"reward": "fast"}, "reward: 'fast': must be one of time, lost, careful, paper"),
        ({"gamma": 1.0}, "gamma: 1.0"),
    ],
)
def test_unknown_rules_are_refused(fields, named):
    with pytest.raises(ValueError, match=named):
        Rules(**fields)


def test_courses_must_be_one_or_one_each(free_course):
    with pytest.raises(ValueError, match="courses: 2: must be 1 or the batch size 3"):
        Episodes([free_course] * 2, 3, Rules())
