"""The three environments of a fleet fly the same flights bit for bit, and end them alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fleet_yard import ASIDE, MEETING, SPEEDS, UNSHIELDED, YARD, place, rounded, stepped

from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import courses, fleet_ends
from mjcollect.fleet.pettingzoo_env import FleetParallelEnv

# One flight, in all environments


def test_a_fleet_of_one_flies_the_mission_bit_for_bit(alone, batched, single, closing):
    assert len(alone) == 1
    mission = closing(make_environment(Course.mission(YARD, (0, 1, 2, 3))))
    others = single(alone), closing(FleetParallelEnv(alone)), batched(alone)
    one, zoo, many = others
    for env in (mission, *others):
        env.reset()
    step, slots = None, 0
    while step is None or not step.last():
        assert many.simulations.law().shape == (1, 3)
        action = rounded(mission.task.episodes.guidance_action()[0])
        step, same, state = mission.step(action), one.step(action), stepped(many, action)
        seen, rewards, terminated, truncated, infos = zoo.step({"uav_0": action})
        for paths in (one.physics.flights(), (zoo.simulations.path,), (many.simulations.path,)):
            np.testing.assert_array_equal(paths[0][0], mission.physics.path)
        flat = np.concatenate(list(step.observation.values()))
        row = np.concatenate(list(same.observation.values()), axis=1)[0]
        np.testing.assert_array_equal(row, flat)
        np.testing.assert_array_equal(seen["uav_0"], rounded(flat))
        np.testing.assert_array_equal(state["uavs", "observation"][0, 0], rounded(flat))
        assert step.reward == same.reward == rewards["uav_0"]
        assert state["uavs", "reward"].item() == np.float32(step.reward)
        assert (step.step_type, step.discount) == (same.step_type, same.discount)
        assert terminated["uav_0"] == state["terminated"].item() == step.last()
        assert truncated["uav_0"] == state["truncated"].item() is False
        slots += 1
    assert step.discount == 0.0
    assert slots > 30
    assert infos["uav_0"] == {"success": True, "crashed": False, "shielded": False}
    assert state["uavs", "home"].item()
    assert zoo.agents == []


@pytest.mark.parametrize("rules", [Rules(), UNSHIELDED, Rules("path", "paper", shield=False)])
def test_many_fleets_fly_bit_for_bit_like_one(fleet, batched, single, rules):
    """Two fleets: one from the depot, one in which two UAVs meet again and again."""
    sims, alone = batched(fleet, 2, rules=rules).simulations, [single(fleet, rules) for _ in "12"]
    home = np.concatenate([course.starts("point", 1, sims.rng)[0] for course in fleet])
    q, v = np.concatenate([home, MEETING]), np.concatenate([np.zeros((3, 3)), SPEEDS])
    sims.place(np.arange(6), q, v)
    for k, env in enumerate(alone):
        env.reset()
        env.task.place(env.physics, q[3 * k : 3 * k + 3], v[3 * k : 3 * k + 3])
    ended = contacts = 0
    for actions in np.random.default_rng(0).uniform(-1.2, 1.2, (30, 6, 3)):
        outcome, seen = sims.step(actions), sims.observe()
        ends = fleet_ends(outcome, sims.episodes, 3)
        for k, env in enumerate(alone):
            mine = np.arange(3 * k, 3 * k + 3)
            step = env.step(actions[mine].ravel())
            path, _, touch = env.physics.flights()
            np.testing.assert_array_equal(sims.path[mine], path)
            np.testing.assert_array_equal(sims.speeds[mine, -1], env.physics.flights()[1])
            flat = np.concatenate(list(step.observation.values()), axis=1)
            np.testing.assert_array_equal(seen[mine], flat)
            np.testing.assert_array_equal(outcome.reward[mine], env.task.outcome.reward)
            for flag in ("contact", "outside", "arrived", "first_event"):
                single_flag = getattr(env.task.outcome.slot, flag)
                np.testing.assert_array_equal(getattr(outcome.slot, flag)[mine], single_flag)
            np.testing.assert_array_equal(outcome.shielded[mine], env.task.outcome.shielded)
            assert step.last() == bool(ends[0][k] or ends[1][k])
            assert step.discount == (0.0 if ends[0][k] else 1.0)
            contacts += touch.any()
            if step.last():
                ended += 1
                env.reset()
                env.task.place(env.physics, q[mine], v[mine])
                sims.place(mine, q[mine], v[mine])
    assert (ended > 2) == (rules == UNSHIELDED)
    assert (contacts > 0) == (not rules.shield)


# Ends


def test_uavs_at_home_rest_and_earn_nothing_until_the_last_is_home(fleet, batched, single, closing):
    env, one, zoo = batched(fleet), single(fleet), closing(FleetParallelEnv(fleet))
    for each in (env, one, zoo):
        each.reset()
    rng, was_home, agents = np.random.default_rng(0), np.zeros(3, dtype=bool), list(zoo.agents)
    rest, sizes, done = np.zeros((3, 3)), [], False
    while not done:
        action = rounded(env.simulations.law())
        action[was_home] = rng.uniform(-1, 1, (int(was_home.sum()), 3))
        state, step = stepped(env, action), one.step(action.ravel())
        flying = {agent: action[int(agent[-1])] for agent in zoo.agents}
        _, rewards, terminated, truncated, infos = zoo.step(flying)
        assert list(rewards) == agents
        done = state["done"].item()
        assert done == step.last() == (not zoo.agents)
        home, reward = state["uavs", "home"].flatten().numpy(), state["uavs", "reward"].flatten()
        assert not (was_home & ~home).any()
        assert (reward[was_home] == 0).all()
        assert step.reward == pytest.approx(float(reward.sum()), abs=1e-5)
        now = env.simulations.path[:, -1]
        np.testing.assert_allclose(now[was_home], rest[was_home], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(zoo.simulations.path, env.simulations.path)
        for number, agent in enumerate(f"uav_{k}" for k in range(3)):
            if agent in agents:
                assert terminated[agent] == infos[agent]["success"] == home[number]
                assert not truncated[agent]
        agents = list(zoo.agents)
        sizes.append(len(agents))
        rest, was_home = now.copy(), home
    assert list(dict.fromkeys(sizes)) == [3, 2, 1, 0]
    assert was_home.all()
    assert (state["terminated"].item(), state["truncated"].item()) == (True, False)
    assert step.discount == 0.0
    with pytest.raises(RuntimeError, match="call reset"):
        zoo.step({})
    assert zoo.reset()[0].keys() == {"uav_0", "uav_1", "uav_2"}


def test_a_crash_of_two_ends_the_episode_of_all(fleet, batched, single, closing):
    env, one = batched(fleet, 2, rules=UNSHIELDED), single(fleet, UNSHIELDED)
    place(env, *(np.concatenate([part, part]) for part in (MEETING, SPEEDS)))
    env.simulations.place(np.array([4]), ASIDE[None], SPEEDS[1:2])
    zoo = closing(FleetParallelEnv(fleet, rules=UNSHIELDED))
    zoo.reset()
    zoo.simulations.place(np.arange(3), MEETING, SPEEDS)
    one.reset()
    one.task.place(one.physics, MEETING, SPEEDS)
    ahead = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 0]])
    for _ in range(10):
        state = stepped(env, np.stack([ahead, ahead]))
        step, told = one.step(ahead.ravel()), zoo.step(dict(zip(zoo.agents, ahead, strict=True)))
        if step.last():
            break
    assert one.task.episodes.steps[0] > 1
    assert state["terminated"].flatten().tolist() == [True, False]
    assert not state["truncated"].any()
    assert state["uavs", "crashed"][0].flatten().tolist() == [True, True, False]
    assert not state["uavs", "crashed"][1].any()
    assert (state["uavs", "reward"][0, :2] == -2).all()
    assert step.discount == 0.0
    assert list(told[2].values()) == [True] * 3
    assert [info["crashed"] for info in told[4].values()] == [True, True, False]
    assert not any(info["success"] for info in told[4].values())
    assert zoo.agents == []


def test_under_the_paper_s_reward_a_crash_ends_nothing(fleet, batched):
    env = batched(fleet, rules=Rules(reward="paper", shield=False))
    place(env, MEETING, SPEEDS)
    states = [stepped(env, np.zeros((3, 3))) for _ in range(3)]
    assert any(state["uavs", "crashed"].any() for state in states)
    assert not any(state["done"].any() for state in states)


def test_a_step_limit_truncates_unless_its_uav_is_home(fleet, batched, single, closing):
    assert [course.step_limit > 100 for course in fleet] == [True, False, False]
    env, one, zoo = batched(fleet), single(fleet), closing(FleetParallelEnv(fleet))
    for each in (env, one, zoo):
        each.reset()
    for slot in range(1, 101):
        action = rounded(env.simulations.law())
        action[1] = 0.0  # The second one waits.
        state, step = stepped(env, action), one.step(action.ravel())
        told = zoo.step({agent: action[int(agent[-1])] for agent in zoo.agents})
        assert step.last() == state["done"].item() == (slot == 100)
    assert (state["terminated"].item(), state["truncated"].item()) == (False, True)
    assert state["uavs", "home"].flatten().tolist() == [True, False, True]
    assert step.discount == 1.0
    assert (told[2], told[3], zoo.agents) == ({"uav_1": False}, {"uav_1": True}, [])
    env.reset()
    for slot in range(1, fleet[0].step_limit + 1):  # Now the first one does, which may for longer.
        action = rounded(env.simulations.law())
        action[0] = 0.0
        truncated = stepped(env, action)["truncated"].item()
        assert truncated == (slot == fleet[0].step_limit)


# Resets


def test_a_reset_of_one_fleet_leaves_the_others(fleet, batched):
    env = batched(fleet, 3)
    first = env.reset()
    for _ in range(3):
        state = stepped(env, np.full((9, 3), 0.5))
    before = env.simulations.state.copy()
    state["_reset"] = torch.tensor([[False], [True], [False]])
    seen = state["uavs", "observation"].clone()
    after = env.reset(state.clone())
    assert env.simulations.episodes.steps.tolist() == [3, 3, 3, 0, 0, 0, 3, 3, 3]
    np.testing.assert_array_equal(env.simulations.state[[0, 2]], before[[0, 2]])
    assert (env.simulations.state[1] != before[1]).any()
    for fleet_number in (0, 2):
        assert (after["uavs", "observation"][fleet_number] == seen[fleet_number]).all()
    assert (after["uavs", "observation"][1] == first["uavs", "observation"][1]).all()


def test_a_rollout_begins_anew_those_fleets_that_have_ended(fleet, batched):
    env = batched(fleet, 2, rules=UNSHIELDED)
    place(env, *(np.concatenate([part, part]) for part in (MEETING, SPEEDS)))
    env.simulations.place(np.array([4]), ASIDE[None], SPEEDS[1:2])
    state, steps = env.fake_tensordict().exclude("next").zero_(), []
    for _ in range(4):
        state["uavs", "action"] = torch.zeros(2, 3, 3)
        _, state = env.step_and_maybe_reset(state)
        steps.append(env.simulations.episodes.steps[::3].tolist())
    assert steps == [[1, 1], [0, 2], [1, 3], [2, 4]]
    assert not state["done"].any()


def test_many_fleets_run(batched):
    env = batched(courses(YARD, [(0,), (1,), (2,), (3,)]), 256)
    flown = env.rollout(3)
    assert flown["next", "uavs", "observation"].shape == (256, 3, 4, 62)
    assert flown["next", "uavs", "reward"].isfinite().all()
    assert not flown["next", "uavs", "crashed"].any()
