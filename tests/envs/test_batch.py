"""Many simulations fly bit for bit like one dm-control environment and like MuJoCo alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from mjcollect.envs.batch import BatchedFlightEnv, Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.envs.episode import Rules
from mjcollect.envs.reward import PRESETS
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.scene import Scene

SLOTS = 40
COMBINATIONS = [(o, r) for o in ("guided", "paper") for r in ("time", "paper")]


@pytest.fixture
def simulate(request):
    """Simulations, closed afterwards."""

    def make(courses, count, **kwargs):
        sims = Simulations(courses, count, **kwargs)
        request.addfinalizer(sims.close)
        return sims

    return make


def starts(count=5):
    """Flights that arrive, hit the box ahead, leave the bounds, graze a box, and drift."""
    q = [[371.0, 30, 30], [170, 20, 30], [100, 57, 30], [50, 20.3, 10], [340, 20, 40]]
    v = [[1.0, 0.3, 0], [40, 0, 0], [5, 20, 3], [30, 0, 0], [0, 0, 0]]
    return np.array(q)[:count], np.array(v)[:count]


def actions(slots=SLOTS, count=5, seed=0):
    """Random, except the first: it steers for rest, so that the stop at its goal comes about."""
    drawn = np.random.default_rng(seed).uniform(-1.2, 1.2, (slots, count, 3))
    drawn[:, 0] = 0.0
    return drawn


class Alone:
    """One dm-control environment and one plain MuJoCo simulation, flown side by side."""

    def __init__(self, course, rules):
        self.environment = make_environment(
            course, observation=rules.observation, reward=rules.reward
        )
        self.model = compile_model(course.scene, solid=PRESETS[rules.reward].crash_ends)
        self.data = mujoco.MjData(self.model)
        self.substeps = course.scene.substeps

    def begin(self, q, v):
        self.environment.reset()
        self.environment.task.place(self.environment.physics, q, v)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = q, v

    def plain(self, acceleration):
        """Positions and velocities (n, 3) of a slot by mj_step."""
        q, v = [], []
        self.data.ctrl[:] = acceleration
        for _ in range(self.substeps):
            mujoco.mj_step(self.model, self.data)
            q.append(self.data.qpos.copy())
            v.append(self.data.qvel.copy())
        return np.array(q), np.array(v)


def compare(sims, alone, commands, q, v):
    """Step all, compare everything, begin anew where an episode ended. Counts of the events."""
    counts = dict.fromkeys(("success", "contact", "outside", "ended"), 0)
    for index, one in enumerate(alone):
        one.begin(q[index], v[index])
    sims.place(np.arange(len(alone)), q, v)
    for command in commands:
        outcome = sims.step(command)
        seen = sims.observe()
        for index, one in enumerate(alone):
            timestep = one.environment.step(command[index])
            physics, single = one.environment.physics, one.environment.task.outcome
            positions, speeds = one.plain(sims.acceleration[index])
            np.testing.assert_array_equal(sims.path[index], physics.path)
            np.testing.assert_array_equal(sims.speeds[index], physics.speeds)
            np.testing.assert_array_equal(sims.path[index], positions)
            np.testing.assert_array_equal(sims.speeds[index], speeds)
            flat = np.concatenate(list(timestep.observation.values()))
            np.testing.assert_array_equal(seen[index], flat)
            assert outcome.reward[index] == timestep.reward
            for flag in ("terminated", "truncated", "success"):
                assert getattr(outcome, flag)[index] == getattr(single, flag)[0], flag
            for flag in ("contact", "outside", "arrived", "first_event"):
                assert getattr(outcome.slot, flag)[index] == getattr(single.slot, flag)[0], flag
            counts["success"] += bool(single.success[0])
            counts["contact"] += bool(single.slot.contact[0])
            counts["outside"] += bool(single.slot.outside[0])
            done = outcome.terminated[index] or outcome.truncated[index]
            assert done == timestep.last()
            if done:
                counts["ended"] += 1
                one.begin(q[index], v[index])
                sims.place(np.array([index]), q[index : index + 1], v[index : index + 1])
    for one in alone:
        one.environment.close()
    return counts


@pytest.mark.parametrize(("observation", "reward"), COMBINATIONS)
def test_bit_for_bit_like_one_environment_and_like_plain_mujoco(
    blocked_course, simulate, observation, reward
):
    rules = Rules(observation, reward)
    sims = simulate([blocked_course], 5, rules=rules)
    alone = [Alone(blocked_course, rules) for _ in range(5)]
    counts = compare(sims, alone, actions(), *starts())
    assert min(counts.values()) > 0, counts
    assert counts["contact"] > 2


def test_bit_for_bit_over_a_whole_mission(mission_course, simulate):
    rules = Rules("paper", "time")
    sims = simulate([mission_course], 2, rules=rules)
    alone = [Alone(mission_course, rules) for _ in range(2)]
    q = np.array([[10.0, 30, 30], [12.0, 29, 31]])
    sims.place(np.arange(2), q, np.zeros((2, 3)))
    flown, ends = [], 0
    for _ in range(mission_course.step_limit):  # the law's commands, to be flown again
        flown.append(sims.episodes.guidance_action())
        ends += int(sims.step(flown[-1]).success.sum())
        if ends == 2:
            break
    counts = compare(sims, alone, flown, q, np.zeros((2, 3)))
    assert counts["success"] == 2


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 3, 2, 1, 0), (2, 0, 4, 1, 3)])
def test_bit_for_bit_with_a_scene_of_its_own_for_each(
    blocked_course, mission_course, free_course, free_mission, simulate, order
):
    crowded = crowd(6)
    courses = [blocked_course, free_course, crowded, free_mission, mission_course]
    courses = [courses[index] for index in order]
    q, v = starts()
    sims = simulate(courses, 5)
    alone = [Alone(course, Rules()) for course in courses]
    counts = compare(sims, alone, actions(), q[list(order)], v[list(order)])
    assert counts["ended"] > 0


def test_bit_for_bit_through_lasting_contact(blocked_course, simulate):
    """Flown on after the crash, pushed against a box: a step must not remember the one before."""
    rules = Rules(shield=False)
    sims = simulate([blocked_course], 2, rules=rules)
    alone = [Alone(blocked_course, rules) for _ in range(2)]
    q, v = np.array([[189.3, 20, 30], [188.0, 25, 40]]), np.array([[0.0, 0, 0], [10, 3, 0]])
    for index, one in enumerate(alone):
        one.begin(q[index], v[index])
    sims.place(np.arange(2), q, v)
    contacts = np.zeros(2, dtype=int)
    for _ in range(8):
        contacts += sims.step(np.array([[0.9, 0.1, 0.1]] * 2)).slot.contact
        for index, one in enumerate(alone):
            positions, speeds = one.plain(sims.acceleration[index])
            np.testing.assert_array_equal(sims.path[index], positions)
            np.testing.assert_array_equal(sims.speeds[index], speeds)
            one.environment.close()
    assert contacts.min() >= 5


def crowd(boxes, items=1) -> Course:
    """Many boxes along one side of a flat scene, the way free."""
    low = np.stack([np.linspace(25, 380, boxes), np.zeros(boxes), np.full(boxes, 5.0)], axis=1)
    scene = Scene(
        name="crowd",
        seed=0,
        bounds=[[0, 0, 0], [400, 60, 60]],
        depot=[10, 50, 30],
        items=[[380 - 8 * k, 50, 30] for k in range(items)],
        obstacles=np.stack([low, low + np.array([1.0, 18.0, 50.0])], axis=1),
    )
    return Course.segment(scene, tuple(range(items)), 0)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("last", [0, 1])
def test_scenes_of_very_different_sizes_share_the_threads(simulate, threads, last):
    # One has the most boxes, the other the most items: no one's data has room for both.
    courses = [crowd(150), crowd(1, items=30)][:: 1 - 2 * last]
    sims = simulate(courses, 2, threads=threads)
    q = np.array([[375.0, 40, 30], [40.0, 40, 20]])
    v = np.array([[-10.0, -30, 0], [-12.0, -35, 0]])
    hits = np.zeros(2, dtype=bool)
    alone = [Alone(course, Rules()) for course in courses]
    for one, at, speed in zip(alone, q, v, strict=True):
        one.begin(at, speed)
    sims.place(np.arange(2), q, v)
    for _ in range(6):
        hits |= sims.step(np.zeros((2, 3))).slot.contact
        for index, one in enumerate(alone):
            positions, speeds = one.plain(sims.acceleration[index])
            np.testing.assert_array_equal(sims.path[index], positions)
            np.testing.assert_array_equal(sims.speeds[index], speeds)
    assert hits.any()
    for one in alone:
        one.environment.close()


def flight(sims, which, slots=SLOTS):
    """Paths, observations, rewards and flags of the flights `which`."""
    q, v = starts()
    sims.place(np.arange(len(which)), q[which], v[which])
    rows = []
    for command in actions(slots):
        outcome = sims.step(command[which])
        rows.append((sims.path.copy(), sims.speeds.copy(), sims.observe(), outcome.reward))
        rows[-1] += (outcome.terminated, outcome.slot.contact, outcome.slot.first_event)
    return [np.stack(part, axis=1) for part in zip(*rows, strict=True)]


@pytest.mark.parametrize("observation", ["guided", "paper"])
def test_the_result_depends_neither_on_threads_nor_on_the_batch_size(
    blocked_course, simulate, observation
):
    rules = Rules(observation)
    whole = flight(simulate([blocked_course], 5, rules=rules, threads=1), list(range(5)))
    for threads in (2, 3):
        again = simulate([blocked_course], 5, rules=rules, threads=threads)
        for part, other in zip(whole, flight(again, list(range(5))), strict=True):
            np.testing.assert_array_equal(part, other)
    for which in ([3], [1, 4], [4, 2, 0]):
        few = flight(simulate([blocked_course], len(which), rules=rules), which)
        for part, other in zip(whole, few, strict=True):
            np.testing.assert_array_equal(part[which], other)
    many = [0, 1, 2, 3, 4] * 13  # wide enough for other vector instructions
    wide = flight(simulate([blocked_course], 65, rules=rules), many, slots=10)
    for part, other in zip(whole, wide, strict=True):
        np.testing.assert_array_equal(part[many][:, :10], other)


def test_a_course_for_each_is_the_same_as_one_for_all(blocked_course, simulate):
    one = flight(simulate([blocked_course], 5), list(range(5)))
    each = flight(simulate([blocked_course] * 5, 5), list(range(5)))
    for part, other in zip(one, each, strict=True):
        np.testing.assert_array_equal(part, other)


def test_a_partial_reset_touches_the_chosen_only(blocked_course, simulate):
    sims = simulate([blocked_course], 5, start="spread", rng=np.random.default_rng(4))
    sims.reset()
    for command in actions(3):
        sims.step(command)
    before = {name: getattr(sims.episodes, name).copy() for name in ("q", "v", "steps", "crashed")}
    state, seen = sims.state.copy(), sims.observe()
    sims.reset(np.array([1, 3]))
    kept, new = [0, 2, 4], [1, 3]
    np.testing.assert_array_equal(sims.state[kept], state[kept])
    np.testing.assert_array_equal(sims.observe()[kept], seen[kept])
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(sims.episodes, name)[kept], values[kept])
    assert sims.episodes.steps[new].tolist() == [0, 0]
    assert not np.any(np.all(sims.observe()[new] == seen[new], axis=1))
    np.testing.assert_array_equal(sims.state[new, 1:4], sims.episodes.q[new])
    np.testing.assert_array_equal(sims.state[new, 4:7], sims.episodes.v[new])


# TorchRL


@pytest.fixture
def environment(request):
    def make(course, count=4, seed=0, **kwargs):
        sims = Simulations([course], count, rng=np.random.default_rng(seed), **kwargs)
        env = BatchedFlightEnv(sims)
        request.addfinalizer(env.close)
        return env

    return make


@pytest.mark.parametrize(("observation", "reward"), COMBINATIONS)
def test_torchrl_finds_the_specs_kept(mission_course, environment, observation, reward):
    env = environment(mission_course, rules=Rules(observation, reward), start="spread")
    check_env_specs(env)


def test_the_seed_decides_the_starts(blocked_course, environment):
    env = environment(blocked_course, start="spread")
    drawn = []
    for seed in (1, 1, 2):
        env.set_seed(seed)
        drawn.append(env.reset()["observation"])
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


def test_done_simulations_are_reset_and_the_others_go_on(blocked_course, environment):
    env = environment(blocked_course, count=5)
    now = env.reset()
    fresh = now["observation"][0].clone()
    env.simulations.place(np.arange(5), *starts())
    flags = dict.fromkeys(("success", "crashed", "truncated"), 0)
    counted = np.zeros(5, dtype=int)
    for command in actions(30):
        now["action"] = torch.from_numpy(command).clamp(-1, 1).float()
        stepped, now = env.step_and_maybe_reset(now)
        after, done = stepped["next"], stepped["next", "done"][:, 0]
        counted = np.where(done.numpy(), 0, counted + 1)
        np.testing.assert_array_equal(env.simulations.episodes.steps, counted)
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        assert torch.equal(now["observation"][~done], after["observation"][~done])
        for observation in now["observation"][done]:
            assert torch.equal(observation, fresh)
        assert not now["done"].any()
        for flag in flags:
            flags[flag] += int(after[flag].sum())
    assert flags["success"] > 0
    assert flags["crashed"] > 1


@pytest.mark.parametrize("reward", PRESETS)
def test_ended_episodes_begin_anew_as_torchrl_itself_would_do_it(
    blocked_course, environment, reward
):
    """`maybe_reset` is a short cut: `EnvBase`'s own gives the same tensors and the same starts."""
    short, own = (environment(blocked_course, 5, rules=Rules(reward=reward)) for _ in range(2))
    nows = [short.reset(), own.reset()]
    for env in (short, own):
        env.simulations.place(np.arange(5), *starts())
    ended = 0
    for command in actions(30):
        befores = []
        for now, env in zip(nows, (short, own), strict=True):
            now["action"] = torch.from_numpy(command).clamp(-1, 1).float()
            befores.append(env._step_mdp(env.step(now)))
        ended += int(befores[0]["done"].sum())
        nows = [short.maybe_reset(befores[0]), EnvBase.maybe_reset(own, befores[1])]
        assert set(nows[0].keys()) == set(nows[1].keys())
        for name, values in nows[0].items():
            assert torch.equal(values, nows[1][name]), name
        np.testing.assert_array_equal(short.simulations.state, own.simulations.state)
    assert ended > (2 if PRESETS[reward].crash_ends else 0)


def test_the_step_limit_truncates_and_does_not_terminate(free_course, environment):
    env = environment(free_course, count=2)
    rollout = env.rollout(free_course.step_limit + 5, policy=lambda *_: torch.zeros(2, 3))
    assert rollout.shape == (2, free_course.step_limit)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "terminated"].any()
    assert not rollout["next", "done"][:, :-1].any()
    assert not rollout["next", "success"].any()


def test_rewards_and_observations_are_those_of_the_simulations(blocked_course, environment):
    env, command = environment(blocked_course, count=5), actions()[0].clip(-1, 1)
    now = env.reset()
    env.simulations.place(np.arange(5), *starts())
    after = env.step(now.set("action", torch.from_numpy(command).float()))["next"]
    other = Simulations([blocked_course], 5, threads=1)
    other.place(np.arange(5), *starts())
    outcome = other.step(command.astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(after["reward"][:, 0].numpy(), outcome.reward.astype(np.float32))
    np.testing.assert_array_equal(after["observation"].numpy(), other.observe().astype(np.float32))
    other.close()
