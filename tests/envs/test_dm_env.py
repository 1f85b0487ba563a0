from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from dm_env import StepType

import mjcollect
from mjcollect.envs import dm_env
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import load, make_environment, register, task_names
from mjcollect.scene.scene import Scene


def test_the_registered_tasks_are_the_two_of_the_suite():
    assert {"segment", "mission"} <= set(task_names())
    assert mjcollect.load is load


# Ends of episodes


@pytest.fixture
def segment(free_course):
    environment = make_environment(free_course)
    yield environment
    environment.close()


def begin(environment, q, v=(0.0, 0.0, 0.0)):
    """Reset, then place the body."""
    environment.reset()
    environment.task.place(environment.physics, np.array(q), np.array(v))


def test_arrival_ends_with_discount_zero(segment):
    begin(segment, segment.task.course.scene.items[0] + [3.0, 0, 0])
    last = segment.step(np.ones(3))
    assert (last.step_type, last.discount) == (StepType.LAST, 0.0)
    assert segment.task.outcome.success[0]
    assert segment.physics.speed() <= 1e-6


def test_leaving_the_bounds_and_touching_a_box_end_with_discount_zero(segment, blocked_course):
    begin(segment, [100.0, 1.0, 30], [0.0, -20, 0])
    last = segment.step(np.zeros(3))
    assert (last.step_type, last.discount, last.reward) == (StepType.LAST, 0.0, -2.0)
    environment = make_environment(blocked_course)
    begin(environment, [187.2, 20, 30], [25.0, 0, 0])
    last = environment.step(np.zeros(3))
    environment.close()
    assert (last.step_type, last.discount, last.reward) == (StepType.LAST, 0.0, -2.0)
    assert environment.task.outcome.slot.contact[0]
    assert environment.task.outcome.slot.first_event[0] == 4  # 2.3 m at 0.5 m a step


def wait(environment, slots):
    timesteps = [environment.step(np.zeros(3)) for _ in range(slots)]
    assert all(timestep.mid() for timestep in timesteps)
    assert all(timestep.discount == 1.0 for timestep in timesteps)


@pytest.mark.parametrize("end", ["arrival", "crash"])
def test_on_the_very_last_slot_an_arrival_or_a_crash_is_no_truncation(segment, end):
    limit = segment.task.course.step_limit
    assert limit == 100
    begin(segment, [50.0, 30, 30])
    wait(segment, limit - 1)
    goal = segment.task.course.scene.items[0]
    q, v = (goal, [0.0, 0, 0]) if end == "arrival" else ([1.0, 30, 30], [-30.0, 0, 0])
    segment.physics.data.qpos[:], segment.physics.data.qvel[:] = q, v
    segment.task.episodes.q[0], segment.task.episodes.v[0] = q, v
    last = segment.step(np.zeros(3))
    outcome = segment.task.outcome
    assert (last.step_type, last.discount) == (StepType.LAST, 0.0)
    assert (outcome.terminated[0], outcome.truncated[0]) == (True, False)
    assert outcome.success[0] == (end == "arrival")


def test_an_outcome_is_asked_for_only_after_a_slot(segment):
    segment.reset()
    with pytest.raises(RuntimeError, match="no slot has been flown"):
        segment.task.get_reward(segment.physics)


# A whole mission


@pytest.mark.parametrize("observation", ["guided", "paper"])
def test_the_law_flies_the_mission_and_collects_everything_in_order(mission_course, observation):
    environment = make_environment(mission_course, observation=observation)
    scene, task = mission_course.scene, environment.task
    timestep, stops, flags = environment.reset(), [], []
    np.testing.assert_array_equal(environment.physics.position(), scene.depot)
    while not timestep.last():
        timestep = environment.step(task.episodes.guidance_action()[0])
        assert not task.outcome.slot.crashed[0]
        if task.outcome.slot.arrived[0]:
            assert environment.physics.speed() <= 1e-6
            stops.append(environment.physics.position())
        flags.append(task.episodes.collected[0].tolist())
        if observation == "paper":
            assert timestep.observation["p"].tolist() == flags[-1]
    environment.close()
    assert timestep.discount == 0.0
    assert task.outcome.success[0]
    assert len(stops) == 3
    for stop, node in zip(stops, mission_course.nodes[1:], strict=True):
        assert np.linalg.norm(stop - scene.point(node)) <= scene.tolerance(node) + 1e-9
    changes = [flag for flag, before in zip(flags[1:], flags[:-1], strict=True) if flag != before]
    assert changes == [[True, False], [True, True]]


# The registry


def test_a_name_can_be_registered_once_only(monkeypatch, free_scene):
    monkeypatch.setattr(dm_env, "_TASKS", dict(dm_env._TASKS))
    with pytest.raises(ValueError, match="'segment': is already registered"):
        register("segment")(Course.mission)

    @register("first item only")
    def first(scene: Scene, order: tuple[int, ...]) -> Course:
        return Course(scene, (-1, order[0]))

    assert task_names() == ("segment", "mission", "first item only")
    environment = load("first item only", free_scene, order="1,0")
    assert environment.task.course.nodes == (-1, 1)
    environment.close()


def test_unknown_names_list_the_valid_ones(free_scene, free_course):
    with pytest.raises(ValueError, match="'segments': must be one of segment, mission"):
        load("segments", free_scene)
    with pytest.raises(ValueError, match="must be one of guided, path, paper"):
        load("segment", free_scene, observation="full")
    with pytest.raises(ValueError, match="must be one of time, lost, careful, paper"):
        load("segment", free_scene, reward="sparse")
    with pytest.raises(ValueError, match="must be one of point, ball, spread"):
        make_environment(free_course, start="random")
    with pytest.raises(ValueError, match="segment: 3: must be 0 to 2"):
        load("segment", free_scene, segment=3)


def test_load_takes_a_scene_file(free_scene, tmp_path):
    free_scene.save(tmp_path / "free.json")
    environment = load("segment", tmp_path / "free.json", order="1,0", segment=2)
    assert environment.task.course.nodes == (0, -1)
    assert environment.task.course.scene == free_scene
    environment.close()


def test_the_task_imports_without_a_display_and_chooses_no_gl():
    code = (
        "import os; os.environ.pop('DISPLAY', None); os.environ.pop('MUJOCO_GL', None);"
        "import mjcollect; import sys; assert 'mujoco' not in sys.modules;"
        "import mjcollect.envs.dm_env; assert 'MUJOCO_GL' not in os.environ"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
