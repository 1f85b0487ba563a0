"""The single environment keeps Gymnasium's rules, and flies like dm-control's."""

from __future__ import annotations

import subprocess
import sys
import warnings
from itertools import pairwise

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from mjcollect.envs.dm_env import make_environment
from mjcollect.envs.observation import OBSERVATIONS
from mjcollect.envs.reward import CRASH
from mjcollect.render.video import RenderError
from mjcollect.scene.order import plan_order

# Observations have no bounds worth naming: some of their parts are distances.
UNBOUNDED = "ignore:.*Box observation space (minimum|maximum) value is -?infinity"
AHEAD = {
    "position": [376.0, 30.0, 30.0],
    "velocity": [1.0, 0.3, 0.0],
}  # it stops in its goal's ball
AT_A_BOX = {"position": [185.0, 20.0, 30.0], "velocity": [40.0, 0.0, 0.0]}


def flat(timestep):
    return np.concatenate(list(timestep.observation.values())).astype(np.float32)


# Ids


def test_a_name_makes_its_task(free_scene, closing):
    for name, nodes in (("Segment", (-1, 0)), ("Mission", (-1, 0, 1, -1))):
        env = closing(gymnasium.make(f"mjcollect/{name}-v0", scene=free_scene, order="0,1"))
        course = env.unwrapped.flights.course
        assert course.nodes == nodes
        assert course.scene is free_scene
    last = gymnasium.make("mjcollect/Segment-v0", scene=free_scene, order="1,0", segment=2)
    assert closing(last).unwrapped.flights.course.nodes == (0, -1)


def test_a_scene_file_is_taken_and_ordered_by_lkh(scene_file, closing):
    env = closing(gymnasium.make("mjcollect/Mission-v0", scene=scene_file))
    course = env.unwrapped.flights.course
    assert course.nodes == (-1, *plan_order(course.scene, "lkh"), -1)


REGISTER = """
import sys, warnings
warnings.simplefilter("error")
import gymnasium
gymnasium.envs.registration._find_spec("mjcollect.gym:mjcollect/Mission-v0")  # as make does
spec = gymnasium.spec("mjcollect/Segment-v0")
del sys.modules["mjcollect.gym"]
import mjcollect.gym  # again
assert gymnasium.spec("mjcollect/Segment-v0") is spec
heavy = {"mujoco", "torch", "matplotlib", "stable_baselines3", "OpenGL"} & set(sys.modules)
assert not heavy, heavy
"""


def test_registering_is_light_and_done_once():
    subprocess.run([sys.executable, "-c", REGISTER], check=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "pixels"}, "observation: 'pixels': must be one of guided"),
        ({"reward": "mine"}, "reward: 'mine': must be one of time"),
        ({"start": "air"}, "start: 'air': must be one of point"),
        ({"gamma": 1.0}, "gamma: 1.0: must lie"),
        ({"task": "race", "course": None}, "task: 'race': must be one of segment, mission"),
        ({"render_mode": "ansi"}, "render_mode: 'ansi': must be None or one of rgb_array"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*is not in the possible render_modes")
def test_an_unknown_name_is_refused_with_the_valid_ones(make, blocked_course, options, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make("mjcollect/Segment-v0", **({"course": blocked_course} | options))


def test_an_option_that_there_is_not_is_refused(free_scene):
    with pytest.raises(TypeError, match="sement"):
        gymnasium.make("mjcollect/Segment-v0", scene=free_scene, order="0,1", sement=1)


# Rules of the libraries


@pytest.mark.parametrize("observation", OBSERVATIONS)
@pytest.mark.parametrize("start", ["point", "spread"])
def test_gymnasium_and_stable_baselines3_accept_it(make, observation, start):
    env = make(observation=observation, start=start).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(*UNBOUNDED.split(":", 1))
        check_env(env, skip_render_check=True)  # there is no GL here; see below
        check_env_of_sb3(env)


def test_so_they_do_with_a_mission(make, mission_course):
    env = make("mjcollect/Mission-v0", mission_course, start="ball").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(*UNBOUNDED.split(":", 1))
        check_env(env, skip_render_check=True)
        check_env_of_sb3(env)


def test_torchrl_accepts_it_wrapped(make):
    check_env_specs(GymWrapper(make(start="spread")))


def test_episodes_are_counted_by_gymnasiums_wrapper(make):
    env = RecordEpisodeStatistics(make())
    env.reset(options=AHEAD)
    *_, terminated, _, info = env.step(np.zeros(3, np.float32))
    assert terminated
    assert info["episode"]["l"] == 1


# Behaviour


@pytest.mark.parametrize(("observation", "reward"), [("guided", "time"), ("path", "lost")])
def test_it_flies_bit_for_bit_like_dm_control(make, blocked_course, observation, reward):
    env = make(observation=observation, reward=reward)
    peer = make_environment(blocked_course, observation=observation, reward=reward)
    rng = np.random.default_rng(0)
    ends = set()
    for _ in range(12):
        q, v = (part[0] for part in blocked_course.starts("spread", 1, rng))
        seen, info = env.reset(options={"position": q, "velocity": v})
        peer.reset()
        peer.task.place(peer.physics, q, v)
        peers = peer.task.get_observation(peer.physics)
        np.testing.assert_array_equal(seen, np.concatenate([*peers.values()], dtype=np.float32))
        assert info == {"success": False, "crashed": False, "shielded": False, "time": 0.0}
        for slot in range(1, 41):
            by_law = env.unwrapped.law()
            np.testing.assert_array_equal(by_law, peer.task.episodes.guidance_action()[0])
            action = by_law if slot % 4 else rng.uniform(-1.2, 1.2, 3)
            seen, reward_, terminated, truncated, info = env.step(action.astype(np.float32))
            step = peer.step(action.astype(np.float32))
            np.testing.assert_array_equal(seen, flat(step))
            outcome = peer.task.outcome
            assert (reward_, terminated, truncated) == (step.reward, step.discount == 0.0, False)
            assert info["time"] == pytest.approx(0.2 * slot)
            assert info["success"] == outcome.success[0]
            assert info["crashed"] == outcome.slot.crashed[0]
            assert info["shielded"] == outcome.shielded[0]
            ends |= {name for name in ("success", "crashed", "shielded") if info[name]}
            if terminated:
                break
    peer.close()
    assert {"success", "shielded"} <= ends


def test_an_arrival_and_a_crash_terminate_and_the_step_limit_truncates(make, blocked_course):
    env = make(shield=False)
    still = np.zeros(3, np.float32)
    env.reset(options=AHEAD)
    *_, terminated, truncated, info = env.step(still)
    assert (terminated, truncated, info["success"], info["crashed"]) == (True, False, True, False)
    env.reset(options=AT_A_BOX)
    _, reward, terminated, truncated, info = env.step(still)
    assert (terminated, truncated, info["success"], info["crashed"]) == (True, False, False, True)
    assert reward == CRASH
    env.reset()
    ends = [env.step(still)[2:4] for _ in range(blocked_course.step_limit)]
    assert ends[:-1] == [(False, False)] * (blocked_course.step_limit - 1)
    assert ends[-1] == (False, True)


def test_the_shield_is_an_option(make):
    for shield in (True, False):
        env = make(shield=shield)
        env.reset(options={"position": [165.0, 20.0, 30.0], "velocity": [25.0, 0.0, 0.0]})
        crashed, shielded = False, False
        for _ in range(5):
            *_, terminated, _, info = env.step(np.array([1.0, 0.0, 0.0], np.float32))
            crashed, shielded = crashed or info["crashed"], shielded or info["shielded"]
            if terminated:
                break
        assert (crashed, shielded) == (not shield, shield)


def test_a_seed_fixes_all_starts_from_then_on(make):
    one, two = (make(start="spread") for _ in range(2))
    runs = [
        [env.reset(seed=seed)[0], env.reset()[0]] for env, seed in ((one, 5), (two, 5), (one, 6))
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0][0] != runs[0][1]).any()
    assert (runs[0][0] != runs[2][0]).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"velocity": [0.0, 0.0, 0.0]}, "options: .'velocity'.: must be position"),
        ({"position": [1.0, 2.0, 3.0], "speed": 1.0}, "options: .'position', 'speed'"),
        ({"position": [1.0, 2.0]}, "position: .*: must be three numbers"),
        ({"position": [1.0, np.nan, 3.0]}, "position: .*: must be three numbers"),
        ({"position": "here"}, "position: here: must be three numbers"),
        ({"position": [-500.0, 20.0, 30.0]}, "position: .*: is out of bounds"),
        ({"position": [200.0, 20.0, 30.0]}, "position: .*: is in or too near to a box"),
        ({"position": [20.0, 20.0, 30.0], "velocity": [500.0, 0.0, 0.0]}, "beyond v_max, 50 m/s"),
    ],
)
def test_a_start_that_is_none_is_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make().reset(options=options)


@pytest.mark.parametrize("shape", [(1, 3), (6,), (3, 1), ()])
def test_an_action_of_another_shape_is_refused(make, shape):
    env = make().unwrapped
    env.reset()
    with pytest.raises(ValueError, match=r"action: shape .*: must be \(1, 3\)"):
        env.step(np.zeros(shape))


# Pictures


PICTURES = """
import sys, warnings
warnings.simplefilter("error")
warnings.filterwarnings("ignore", ".*Box observation space")
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env
from dataclasses import replace
from mjcollect.envs.course import Course
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene
course = Course.segment(Scene.load(sys.argv[1]), (0, 1), 1)
options = {"course": course, "size": (160, 90)}
env = gymnasium.make("mjcollect.gym:mjcollect/Segment-v0", render_mode="rgb_array", **options)
check_env(env.unwrapped)
env.reset()
shown = [env.render()]
for _ in range(3):
    env.step(env.unwrapped.law().astype(np.float32))
    shown.append(env.render())
env.close()
many = gymnasium.make_vec("mjcollect/Segment-v0", 2, render_mode="rgb_array", **options)
many.reset()
for _ in range(3):
    many.step(many.law())
box = MovingBox((20.0, 20.0, 20.0), ((75.0, 65.0, 15.0), (75.0, 66.0, 15.0)), 1.0)
course = Course.segment(replace(course.scene, moving=(box,)), (0, 1), 1)
among = gymnasium.make(
    "mjcollect/Segment-v0", render_mode="rgb_array", course=course, size=(160, 90)
)
among.reset(options={"position": [75.0, 100.0, 15.0], "velocity": [0.0, -3.0, 0.0]})
among.step(among.unwrapped.law().astype(np.float32))
np.savez(
    sys.argv[2], shown=shown, many=many.render(), fps=env.metadata["render_fps"],
    among=among.render(),
)
many.close()
among.close()
"""


def test_pictures_show_the_flight_where_there_is_gl(scene_file, tmp_path, egl):
    found = tmp_path / "shown.npz"
    command = [sys.executable, "-c", PICTURES, str(scene_file), str(found)]
    subprocess.run(command, env=egl, check=True)
    with np.load(found) as file:
        shown, many, among = file["shown"], file["many"], file["among"].astype(int)
        assert file["fps"] == 5
    assert shown.dtype == np.uint8
    assert shown.shape == (4, 90, 160, 3)
    assert shown[0].std() > 10
    assert all((one != two).any() for one, two in pairwise(shown))
    assert many.shape == (2, 90, 160, 3)
    np.testing.assert_array_equal(many[0], shown[-1])  # The same flight is shown the same.
    np.testing.assert_array_equal(many[0], many[1])
    violet = [
        (pixels[..., 2] > 1.2 * pixels[..., 0]) & (pixels[..., 0] > 1.1 * pixels[..., 1])
        for pixels in (among, shown[0].astype(int))
    ]
    assert violet[0].sum() > 20  # the moving box
    assert not violet[1].any()


def test_without_gl_a_picture_says_what_to_do(make, monkeypatch):
    def fails(*args):
        raise RuntimeError("no display")

    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(mujoco, "Renderer", fails)
    env = make(render_mode="rgb_array")
    env.reset()
    with pytest.raises(RenderError, match=r"MUJOCO_GL=glfw failed .*no display.*MUJOCO_GL=egl"):
        env.render()


def test_without_a_render_mode_there_is_no_picture(make):
    env = make()
    env.reset()
    assert env.unwrapped.render() is None
