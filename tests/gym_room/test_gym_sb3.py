"""Stable-Baselines3 sees the same flights through our vector environment as through its own."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from examples import train_sb3
from mjcollect.gym.env import FlightEnv
from mjcollect.gym.sb3 import FlightVecEnv


def test_it_steps_like_the_dummy_vector_environment(make_vec, blocked_course, closing):
    """From the point, where all episodes begin: by the law to the goal and beyond."""
    ours = FlightVecEnv(make_vec(3, shield=False))
    theirs = closing(DummyVecEnv([lambda: FlightEnv(course=blocked_course, shield=False)] * 3))
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    rng, dones = np.random.default_rng(0), 0
    for slot in range(90):
        action = ours.env.law().astype(np.float32)
        if slot > 60:
            action[0] = rng.uniform(-1, 1, 3)
        for one, two in zip(ours.step(action), theirs.step(action), strict=True):
            if isinstance(one, list):
                for mine, its in zip(one, two, strict=True):
                    dones += mine.pop("is_success", 0)
                    np.testing.assert_equal(mine, its)
            else:
                assert one.dtype == two.dtype
                np.testing.assert_array_equal(one, two)
        assert ours.reset_infos == theirs.reset_infos
    assert dones == 3


def test_its_learners_learn_on_it_and_log_successes(make_vec):
    venv = VecMonitor(FlightVecEnv(make_vec(4, start="ball")))
    model = SAC("MlpPolicy", venv, learning_starts=8, batch_size=8, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.actor.parameters()]
    model.learn(60)
    assert model.num_timesteps == 60
    assert any((a != b).any() for a, b in zip(before, model.actor.parameters(), strict=True))
    model.ep_success_buffer.clear()
    while len(model.ep_success_buffer) < 4:
        _, _, dones, infos = venv.step(venv.get_attr("law")[0]())
        model._update_info_buffer(infos, dones)
    assert list(model.ep_success_buffer) == [True] * len(model.ep_success_buffer)


def test_a_seed_reaches_the_starts(make_vec):
    venv = FlightVecEnv(make_vec(2, start="spread"))
    runs = []
    for seed in (1, 1, 2):
        venv.seed(seed)
        runs.append(venv.reset())
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


def test_options_reach_the_starts_once(make_vec):
    env = FlightVecEnv(make_vec(2))
    usual = env.reset()
    env.set_options([{"position": [20.0, 30.0, 30.0]}, {"position": [30.0, 30.0, 30.0]}])
    given = env.reset()
    truth = env.env.flights.simulations.episodes.truth
    np.testing.assert_array_equal(truth, [[20, 30, 30], [30, 30, 30]])
    assert (given != usual).any(axis=1).all()
    np.testing.assert_array_equal(env.reset(), usual)
    env.set_options([{"position": [20.0, 30.0, 30.0]}, {}])
    with pytest.raises(ValueError, match=r"options: \['position'\]: must be given to all"):
        env.reset()


def test_a_method_answers_for_each_flight_asked_for(make_vec):
    env = FlightVecEnv(make_vec(3, start="spread"))
    env.reset()
    whole = env.env.law()
    np.testing.assert_array_equal(env.env_method("law", indices=[2, 0]), whole[[2, 0]])


def test_a_wrapped_environment_is_refused(make_vec):
    with pytest.raises(TypeError, match="VecMonitor"):
        FlightVecEnv(RecordEpisodeStatistics(make_vec(2)))


def test_it_must_reset_in_the_same_step(make_vec):
    with pytest.raises(ValueError, match=r"autoreset_mode: .*NEXT_STEP.*: must be SAME_STEP"):
        FlightVecEnv(make_vec(2, autoreset_mode="NextStep"))


def test_single_ones_by_their_id(blocked_course, closing):
    venv = make_vec_env("mjcollect/Segment-v0", 2, env_kwargs={"course": blocked_course})
    assert closing(venv).reset().shape == (2, 62)


def test_the_example_learns_and_compares(scene_file, capsys):
    """A few slots, after which nothing is learned yet; docs/gymnasium.md has what it reaches."""
    train_sb3.main(train_sb3.Args(str(scene_file), segment=0, quick=True))
    bound, law, learned = capsys.readouterr().out.splitlines()
    least, taken = float(bound.split()[-2]), float(law.split(" in ")[1].split()[0])
    assert law.startswith("guidance law: 100% arrive")
    assert 0.0 < least <= taken < 2 * least
    assert learned.startswith("SAC, seed 0: ")


def test_the_examples_flights_are_judged_by_their_first_episodes(blocked_course):
    """Those of the law arrive; who hovers never does."""
    share, mean, crashes = train_sb3.fly(blocked_course, 4, lambda env, _: env.law())
    assert (share, crashes) == (1.0, 0)
    assert mean > 8.0  # 370 m at 50 m/s
    share, mean, crashes = train_sb3.fly(blocked_course, 2, lambda env, _: np.zeros((2, 3)))
    assert (share, crashes) == (0.0, 0)
    assert np.isnan(mean)
