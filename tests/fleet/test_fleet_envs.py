"""The three environments of a fleet keep their libraries' rules, and load by their names."""

from __future__ import annotations

import sys
import unittest
from itertools import pairwise

import numpy as np
import pytest
import torch
from dm_env import test_utils
from fleet_yard import YARD
from pettingzoo.test import parallel_api_test, parallel_seed_test
from tensordict.nn import TensorDictModule
from torchrl.envs import DMControlWrapper, PettingZooWrapper
from torchrl.envs.utils import check_env_specs, check_marl_grouping
from torchrl.modules import MultiAgentMLP

import mjcollect
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import environment_of, register, task_names
from mjcollect.envs.episode import Rules
from mjcollect.fleet.dm_env import FleetTask
from mjcollect.fleet.episode import courses
from mjcollect.fleet.pettingzoo_env import FleetParallelEnv
from mjcollect.planners.fleets import fleet_tours
from mjcollect.scene.order import TourError

# Rules of the libraries


def test_torchrl_accepts_its_environment(fleet, batched):
    env = batched(fleet, 4)
    check_env_specs(env, seed=0)
    check_marl_grouping(env.group_map, ["uav_0", "uav_1", "uav_2"])
    state = env.rollout(2)["next"]
    assert state["uavs", "observation"].shape == (4, 2, 3, 62)
    assert state["uavs", "reward"].shape == (4, 2, 3, 1)
    assert state["done"].shape == (4, 2, 1)


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested")
def test_torchrl_accepts_the_other_two_wrapped(fleet, single, closing):
    check_env_specs(DMControlWrapper(single(fleet)))
    check_env_specs(closing(PettingZooWrapper(FleetParallelEnv(fleet), use_mask=True)))


def test_a_policy_of_several_agents_flies(fleet, batched):
    env = batched(fleet, 2)
    torch.manual_seed(0)
    net = MultiAgentMLP(62, 3, 3, centralized=False, share_params=True, depth=1, num_cells=8)
    keys = {"in_keys": [("uavs", "observation")], "out_keys": [("uavs", "action")]}
    flown = env.rollout(5, TensorDictModule(torch.nn.Sequential(net, torch.nn.Tanh()), **keys))
    assert flown["uavs", "action"].shape == (2, 5, 3, 3)
    assert flown["next", "uavs", "reward"].isfinite().all()


def test_pettingzoo_accepts_its_environment(fleet, closing):
    parallel_api_test(closing(FleetParallelEnv(fleet, start="ball")), num_cycles=120)
    parallel_seed_test(lambda: FleetParallelEnv(fleet, start="ball"), num_cycles=5)


def test_pettingzoo_starts_anew_from_a_seed(fleet, closing):
    env = closing(FleetParallelEnv(fleet, start="ball", seed=1))
    runs = [env.reset(seed=seed)[0]["uav_2"] for seed in (5, None, 5, None)]
    np.testing.assert_array_equal(runs[0], runs[2])
    np.testing.assert_array_equal(runs[1], runs[3])
    assert (runs[0] != runs[1]).any()


class DmEnvRules(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """The checks of dm-env, with an episode by the law that ends."""

    def make_object_under_test(self):
        tours = courses(YARD, [(3,), (2,)])
        return environment_of(FleetTask(tours, Rules()), YARD)

    def make_action_sequence(self):
        for _ in range(40):
            yield self.environment.task.episodes.guidance_action().ravel()


def test_actions_are_flat_and_observations_have_a_row_for_each_uav(fleet, single):
    env = single(fleet, random=0)
    assert env.action_spec().shape == (env.physics.model.nu,) == (9,)
    assert {spec.shape[0] for spec in env.observation_spec().values()} == {3}
    rng, steps = np.random.default_rng(0), [env.reset()]
    steps += [env.step(rng.uniform(-1, 1, 9)) for _ in range(3)]
    for before, after in pairwise(steps):
        for name, part in after.observation.items():
            env.observation_spec()[name].validate(part)
            assert not np.may_share_memory(part, before.observation[name])
    assert steps[-1].reward == pytest.approx(env.task.outcome.reward.sum(), abs=0)


# Names and refusals


def test_load_knows_the_task_by_its_name(closing):
    env = closing(mjcollect.load("fleet", YARD, uavs=3, observation="path", random=1))
    items = np.concatenate([course.scene.items for course in env.task.courses])
    assert sorted(items.tolist()) == sorted(YARD.items.tolist())
    assert len(env.task.courses) == 3
    assert env.reset().observation["velocity"].shape == (3, 3)
    own = closing(mjcollect.load("fleet", YARD, uavs=3, tours=[(3, 1), (), (2, 0)]))
    assert [len(course.scene.items) for course in own.task.courses] == [2, 2]
    assert own.physics.model.name2id("item_3", "site") >= 0
    assert "fleet" not in task_names()
    with pytest.raises(ValueError, match=r"'flee': must be one of segment, mission.*fleet"):
        mjcollect.load("flee", YARD)
    with pytest.raises(ValueError, match="'fleet': is already registered"):
        register("fleet")(Course.mission)


def test_a_loaded_fleet_of_one_is_the_mission(closing):
    one = closing(mjcollect.load("fleet", YARD, uavs=1, start="ball", random=3))
    mission = closing(mjcollect.load("mission", YARD, start="ball", random=3))
    step = one.reset(), mission.reset()
    while not step[1].last():
        law = [env.task.episodes.guidance_action() for env in (one, mission)]
        np.testing.assert_array_equal(*law)
        step = one.step(law[0].ravel()), mission.step(law[1][0])
        np.testing.assert_array_equal(one.physics.path, mission.physics.path)
        assert (step[0].reward, step[0].discount) == (step[1].reward, step[1].discount)
    assert one.task.outcome.success.all()
    assert fleet_tours(YARD, 1, order="3,1,0,2") == ((3, 1, 0, 2),)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"uavs": 0}, "uavs: 0: must be at least 1"),
        ({"uavs": 2, "order": "random"}, "order: 'random': is for one UAV; give .* by tours"),
        ({"uavs": 2, "tours": [(0, 1, 2, 3)]}, "tours: 1 of them: must be uavs = 2"),
        ({"uavs": 2, "tours": [(0, 1), (2,)]}, "tours: .*: must have each item, 0 to 3, exactly"),
    ],
)
def test_refuses_what_is_no_fleet(arguments, message):
    with pytest.raises(TourError, match=message):
        mjcollect.fleet_courses(YARD, **arguments)


@pytest.mark.parametrize(
    ("tours", "message"),
    [
        ([(0, 4)], "tours: 4: must be an item, 0 to 3"),
        ([(0, 1), (1,)], "tours: 1: is visited more than once; leave it in one tour only"),
        ([(), ()], "tours: .*: must have at least one item; add one to a tour"),
    ],
)
def test_refuses_what_are_no_tours(tours, message):
    with pytest.raises(TourError, match=message):
        courses(YARD, tours)


def test_a_missing_action_is_named(fleet, closing):
    env = closing(FleetParallelEnv(fleet))
    with pytest.raises(RuntimeError, match="call reset"):
        env.step({})
    env.reset()
    with pytest.raises(ValueError, match="actions: 'uav_1': is missing; give each"):
        env.step({"uav_0": np.zeros(3), "uav_2": np.zeros(3)})


def test_says_how_to_get_pettingzoo(monkeypatch):
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "mjcollect.fleet.pettingzoo_env")
    with pytest.raises(ImportError, match=r"pip install 'mjcollect\[fleet\]'"):
        _ = mjcollect.FleetParallelEnv
