from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.flight.collection import arrests, command
from mjcollect.flight.projection import project
from mjcollect.flight.straight_line import resting_point
from mjcollect.flight.world import World
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.scene import Scene

HOLDS = 1 + 1e-12


def scene(**fields) -> Scene:
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [], **fields)


vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


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
    world = World.stack([scene()])
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
