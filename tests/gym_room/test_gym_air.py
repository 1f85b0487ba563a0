"""Environments in disturbed air: what the options say happens, and a seed fixes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mjcollect.envs.course import Course
from mjcollect.flight.disturbance import Disturbance
from mjcollect.scene.moving import MovingBox

STILL = np.zeros(3, dtype=np.float32)


def state(env):
    episodes = env.unwrapped.flights.simulations.episodes
    return episodes.truth.copy(), episodes.v.copy()


def test_steady_wind_accelerates_at_first_and_then_is_held_against(make):
    env = make(disturbance={"wind": 3.0}, shield=False)
    env.reset(seed=0, options={"position": [40.0, 20.0, 30.0]})
    slot, (before, _) = env.unwrapped.flights.course.scene.slot, state(env)
    env.step(STILL)
    x, v = state(env)
    assert np.linalg.norm(v[0]) == pytest.approx(3.0 * slot)
    assert np.linalg.norm(x - before) == pytest.approx(3.0 * slot**2 / 2, rel=0.2)
    assert v[0, 2] == 0.0
    for _ in range(3):  # The wind is known from how the command was followed.
        env.step(STILL)
    np.testing.assert_allclose(state(env)[1], v, atol=0.1 * 3.0 * slot)


def test_a_seed_fixes_starts_and_air(make):
    def flown(seed):
        env = make(disturbance=Disturbance(wind=3.0, gusts=2.0, noise=0.2), observation="robust")
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(STILL)[0] for _ in range(4)]
        seen += [env.reset()[0], env.step(STILL)[0]]
        return np.array(seen)

    one, same, other = flown(5), flown(5), flown(6)
    np.testing.assert_array_equal(one, same)
    assert np.all(np.any(one[1:5] != other[1:5], axis=1))
    assert np.any(one[1] != one[6])  # the next episode's air is another


def test_each_of_many_flights_has_air_of_its_own(make_vec):
    env = make_vec(8, disturbance={"wind": 3.0}, shield=False)
    env.reset(seed=1, options={"position": [40.0, 20.0, 30.0]})
    env.step(np.tile(STILL, (8, 1)))
    _, v = state(env)
    angles = np.sort(np.arctan2(v[:, 1], v[:, 0]))
    assert np.min(np.diff(angles)) > 1e-3
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), np.linalg.norm(v[0]))


def test_gymnasium_accepts_it_in_disturbed_air(make):
    env = make(disturbance={"wind": 3.0, "gusts": 1.0, "noise": 0.1}).unwrapped
    with pytest.warns(UserWarning, match="Box observation space"):
        check_env(env, skip_render_check=True)


def test_the_boxes_of_a_scene_move_and_strike(make, corridor):
    box = MovingBox((10.0, 10.0, 10.0), ((40.0, 55.0, 30.0), (40.0, 5.0, 30.0)), 20.0)
    for moving in ((), (box,)):
        course = Course.segment(replace(corridor, moving=moving), (0, 1), 0)
        env = make(course=course, shield=False)
        env.reset(seed=0, options={"position": [40.0, 20.0, 30.0]})
        ends = [env.step(STILL)[2:] for _ in range(15)]
        assert any(terminated and info["crashed"] for terminated, _, info in ends) == bool(moving)


@pytest.mark.parametrize(
    ("disturbance", "message"),
    [
        ({"breeze": 1.0}, "disturbance: breeze: unknown; choose from wind, gusts"),
        ({"wind": -1.0}, "wind: -1.0: must be 0 or more"),
    ],
)
def test_what_is_no_disturbance_is_refused(make, disturbance, message):
    with pytest.raises(ValueError, match=message):
        make(disturbance=disturbance)
