from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from dm_control.rl import control
from dm_env import StepType
from torchrl.envs import DMControlWrapper

import mjcollect
from mjcollect.envs import dm_env
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import load, make_environment, register, task_names
from mjcollect.geometry.boxes import segment_box_distance
from mjcollect.scene.scene import Scene

COMBINATIONS = [
    (name, observation, reward)
    for name in task_names()
    for observation in ("guided", "paper")
    for reward in ("time", "paper")
]


@pytest.fixture(scope="module", params=COMBINATIONS, ids="-".join)
def combination(request, corridor):
    """Name, observation, reward and the environment that `load` makes of them."""
    name, observation, reward = request.param
    environment = load(
        name,
        corridor,
        order="0,1",
        observation=observation,
        reward=reward,
        start="spread",
        random=1,
    )
    yield name, observation, reward, environment
    environment.close()


def again(combination, **changes) -> control.Environment:
    """Another environment of the same combination, without building the fields again."""
    _, observation, reward, environment = combination
    options = {"observation": observation, "reward": reward, "start": "spread", "random": 1}
    return make_environment(environment.task.course, **(options | changes))


def random_actions(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def flat(timestep):
    return np.concatenate(list(timestep.observation.values()))


def test_the_registered_tasks_are_the_two_of_the_suite():
    assert {"segment", "mission"} <= set(task_names())
    assert mjcollect.load is load


def test_specs_conform(combination):
    environment = combination[-1]
    spec = environment.action_spec()
    assert (spec.shape, spec.dtype) == ((3,), np.float64)
    np.testing.assert_array_equal(spec.minimum, -1.0)
    np.testing.assert_array_equal(spec.maximum, 1.0)
    first = environment.reset()
    specs = environment.observation_spec()
    assert list(specs) == list(first.observation)
    timesteps = [first] + [environment.step(action) for action in random_actions(30)]
    for timestep in timesteps:
        for name, array in timestep.observation.items():
            specs[name].validate(array)
            assert array.dtype == np.float64
            assert np.all(np.isfinite(array)), name
        if timestep.first():
            assert timestep.reward is None
            assert timestep.discount is None
        else:
            environment.reward_spec().validate(timestep.reward)
            environment.discount_spec().validate(timestep.discount)
            assert np.isfinite(timestep.reward)
    assert not environment.physics.legacy_step
    assert environment.control_timestep() == pytest.approx(0.2)


def test_same_seed_and_actions_same_episodes_other_seed_others(combination):
    runs = []
    for seed in (7, 7, 8):
        environment = again(combination, random=seed, start="ball")
        timesteps = [environment.reset()]
        timesteps += [environment.step(action) for action in random_actions(40, seed=3)]
        timesteps.append(environment.reset())
        runs.append(timesteps)
        environment.close()
    one, two, other = runs
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(flat(a), flat(b))
        assert (a.step_type, a.reward, a.discount) == (b.step_type, b.reward, b.discount)
    assert not np.array_equal(flat(one[0]), flat(other[0]))
    assert not np.array_equal(flat(one[-1]), flat(one[0]))  # the next start is another one


def test_no_element_of_the_observation_is_constant(combination):
    """Over random play from all over the scene. It has four boxes, none padded.

    Constant by nature: `p` and `next_direction` until a target is reached (random play does not get
    that far: the mission flown below checks it), and the axes of `l` on which a box spans the whole
    of the bounds, so that its nearest point is always level.
    """
    environment = again(combination)
    rows = []
    for _ in range(12):
        rows.append(environment.reset())
        for action in random_actions(25, seed=len(rows)):
            rows.append(environment.step(action))
            if rows[-1].last():
                break
    scene = environment.task.course.scene
    # Random play does not stop near a goal, where `braking` tells metres apart.
    first = environment.task.course.guidance[0]
    for far in (20.0, 30.0):
        environment.task.place(environment.physics, first.aim - [far, 0, 0], np.array([25.0, 0, 0]))
        rows.append(environment.step(np.zeros(3)))
    environment.close()
    spans = np.all(scene.obstacles == scene.bounds, axis=1).reshape(-1)
    for name in rows[0].observation:
        values = np.array([row.observation[name] for row in rows])
        constant = np.ptp(values, axis=0) == 0.0
        if name in ("p", "next_direction"):
            assert constant.all()
        elif name == "l":
            np.testing.assert_array_equal(constant, spans)
        else:
            assert not constant.any(), name


def test_actions_out_of_the_spec_or_not_finite_are_flown_within_the_limits(combination):
    environment = again(combination, start="point")
    environment.reset()
    for action in ([5.0, -7.0, 0.0], [np.nan, 1.0, np.inf], [1e308, 1e308, 1e308]):
        environment.step(np.array(action))
        assert np.linalg.norm(environment.task.acceleration) <= 20.0 * (1 + 1e-12)
        assert np.isfinite(environment.physics.velocity()).all()
    environment.close()


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


def test_a_time_out_is_a_truncation_with_discount_one(segment):
    limit = segment.task.course.step_limit
    assert limit == 100
    begin(segment, [50.0, 30, 30])
    wait(segment, limit - 1)
    last = segment.step(np.zeros(3))
    assert (last.step_type, last.discount) == (StepType.LAST, 1.0)
    assert segment.task.outcome.truncated[0]
    assert not segment.task.outcome.terminated[0]


@pytest.mark.parametrize("end", ["arrival", "crash"])
def test_on_the_very_last_slot_an_arrival_or_a_crash_is_no_truncation(segment, end):
    begin(segment, [50.0, 30, 30])
    wait(segment, segment.task.course.step_limit - 1)
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


# Starts


@pytest.mark.parametrize("kind", ["point", "ball", "spread"])
def test_starts_are_in_bounds_clear_of_boxes_and_of_their_kind(blocked_course, kind):
    scene = blocked_course.scene
    q, v = blocked_course.starts(kind, 400, np.random.default_rng(0))
    assert np.all((q >= scene.bounds[0]) & (q <= scene.bounds[1]))
    for box in scene.obstacles:
        over = np.maximum(np.maximum(box[0] - q, q - box[1]), 0.0)
        assert np.all(np.linalg.norm(over, axis=1) >= scene.uav_radius)
    speed, away = np.linalg.norm(v, axis=1), np.linalg.norm(q - scene.depot, axis=1)
    assert speed.max() <= (scene.v_max if kind == "spread" else 0.0)
    if kind == "point":
        assert away.max() == 0.0
    if kind == "ball":
        assert 4.0 < away.max() <= 5.0
        assert np.mean(away < 2.5) == pytest.approx(1 / 8, abs=0.06)  # uniform in volume
    if kind == "spread":
        assert 0.2 < np.mean(away <= 5.0) < 0.4
        assert q[:, 0].max() > 300.0
        # Some are about as fast as can still be stopped in the goal's ball.
        goal = blocked_course.guidance[0].goal
        left = np.linalg.norm(goal - q, axis=1)
        share = speed**2 / (2 * scene.a_max) / left
        assert np.mean((share > 0.7) & (share < 1.2)) > 0.05
    stop = q + v * speed[:, None] / (2 * scene.a_max)
    for box in scene.obstacles:
        assert segment_box_distance(q, stop, box).min() >= scene.uav_radius


# Others' tools


def test_torchrl_accepts_the_environment(combination):
    wrapped = DMControlWrapper(again(combination))
    tensordict = wrapped.reset()
    tensordict["action"] = wrapped.action_spec.rand()
    after = wrapped.step(tensordict)["next"]
    assert after["reward"].shape == (1,)
    assert not after["truncated"].any()
    assert set(combination[-1].observation_spec()) <= set(after.keys())
    wrapped.close()


def test_the_task_imports_without_a_display_and_chooses_no_gl():
    code = (
        "import os; os.environ.pop('DISPLAY', None); os.environ.pop('MUJOCO_GL', None);"
        "import mjcollect; import sys; assert 'mujoco' not in sys.modules;"
        "import mjcollect.envs.dm_env; assert 'MUJOCO_GL' not in os.environ"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
