"""The vector environment flies like N single ones and like TorchRL's, and resets as it says."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from tensordict import TensorDict
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from mjcollect.envs.batch import BatchedFlightEnv, Simulations
from mjcollect.envs.episode import Rules
from mjcollect.gym.vector_env import FlightVectorEnv

MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)
COUNT = 5


@pytest.fixture
def starts(blocked_course):
    """Positions and velocities from which flights arrive, crash, and fly on."""
    q, v = blocked_course.starts("spread", COUNT, np.random.default_rng(3))
    q[0], v[0] = [376.0, 30.0, 30.0], [1.0, 0.3, 0.0]
    q[1], v[1] = [185.0, 20.0, 30.0], [40.0, 0.0, 0.0]
    return {"position": q, "velocity": v}


def same(one, two):
    """Says that infos are equal, with keys, types and masks."""
    assert one.keys() == two.keys()
    for name, value in one.items():
        if isinstance(value, dict):
            same(value, two[name])
        elif value.dtype == object:
            for a, b in zip(value, two[name], strict=True):
                assert (a is None) == (b is None)
                np.testing.assert_array_equal(a, b)
        else:
            assert value.dtype == two[name].dtype, name
            np.testing.assert_array_equal(value, two[name], err_msg=name)


@pytest.mark.parametrize("mode", MODES)
def test_it_is_bit_for_bit_what_gymnasium_makes_of_single_ones(make, make_vec, starts, mode):
    """From the same starts; all later episodes begin at the point, the same for all."""
    env = make_vec(COUNT, autoreset_mode=mode, shield=False)
    peers = SyncVectorEnv([lambda: make(shield=False)] * COUNT, autoreset_mode=mode)
    seen = [each.reset(seed=0) for each in (env, peers)]
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    same(seen[0][1], seen[1][1])
    env.reset(options=starts)
    for k, peer in enumerate(peers.envs):
        peer.reset(options={name: value[k] for name, value in starts.items()})
    rng, ends = np.random.default_rng(0), 0
    for slot in range(30):
        action = rng.uniform(-1.2, 1.2, (COUNT, 3)).astype(np.float32) * (slot > 0)
        one, two = env.step(action), peers.step(action)
        for a, b in zip(one[:4], two[:4], strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        same(one[4], two[4])
        ended = one[2] | one[3]
        ends += ended.sum()
        if mode is AutoresetMode.DISABLED and ended.any():
            again = [each.reset(options={"reset_mask": ended}) for each in (env, peers)]
            np.testing.assert_array_equal(again[0][0], again[1][0])
            for name in ("success", "time"):
                np.testing.assert_array_equal(again[0][1][f"_{name}"], again[1][1][f"_{name}"])
    assert ends >= 2


def test_it_is_bit_for_bit_what_torchrl_steps(make_vec, blocked_course, closing):
    """From the same seed, through resets."""
    env = make_vec(COUNT, start="spread", observation="path", reward="lost", threads=1)
    sims = Simulations(
        [blocked_course], COUNT, rules=Rules("path", "lost"), start="spread", threads=1
    )
    peer = closing(BatchedFlightEnv(sims))
    seen, _ = env.reset(seed=4)
    sims.rng = np.random.default_rng(4)
    now = peer.reset()
    rng, ends = np.random.default_rng(0), 0
    for _ in range(80):
        np.testing.assert_array_equal(seen, now["observation"].numpy())
        action = rng.uniform(-1.0, 1.0, (COUNT, 3)).astype(np.float32)
        action[:3] = env.unwrapped.law()[:3]
        seen, reward, terminated, truncated, infos = env.step(action)
        now["action"] = torch.from_numpy(action)
        step, now = peer.step_and_maybe_reset(now)
        after = step["next"]
        np.testing.assert_array_equal(reward.astype(np.float32), after["reward"][:, 0].numpy())
        np.testing.assert_array_equal(terminated, after["terminated"][:, 0].numpy())
        np.testing.assert_array_equal(truncated, after["truncated"][:, 0].numpy())
        for k in np.flatnonzero(terminated | truncated):
            np.testing.assert_array_equal(infos["final_obs"][k], after["observation"][k].numpy())
            for name in ("success", "crashed", "shielded"):
                assert infos["final_info"][name][k] == after[name][k, 0]
            ends += 1
    assert ends >= 3


def test_alone_it_starts_like_the_single_one(make, make_vec):
    one, many = make(start="spread"), make_vec(1, start="spread")
    for seed in (3, None):
        np.testing.assert_array_equal(one.reset(seed=seed)[0], many.reset(seed=seed)[0][0])


def test_threads_do_not_change_a_bit(make_vec):
    ends = []
    for threads in (1, 3):
        env = make_vec(7, start="spread", threads=threads)
        env.reset(seed=1)
        action = np.random.default_rng(0).uniform(-1, 1, (30, 7, 3))
        ends.append([env.step(each)[0] for each in action])
    np.testing.assert_array_equal(*ends)


def test_a_seed_fixes_all_starts_and_flights_start_apart(make_vec):
    env = make_vec(3, start="spread")
    runs = [(env.reset(seed=seed)[0], env.reset()[0]) for seed in (5, 5, 6)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0][0] != runs[2][0]).any(axis=1).all()
    assert (runs[0][0] != runs[0][1]).any(axis=1).all()
    assert (runs[0][0][0] != runs[0][0][1]).any()


@pytest.mark.parametrize("mode", MODES)
def test_the_mode_is_told(make_vec, mode):
    for given in (mode, mode.value):
        env = make_vec(2, autoreset_mode=given)
        assert env.metadata["autoreset_mode"] is mode
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert env.spec.kwargs["vectorization_mode"] == "vector_entry_point"


def test_the_batched_simulation_is_the_default(closing, blocked_course):
    env = closing(gymnasium.make_vec("mjcollect/Segment-v0", 2, course=blocked_course))
    assert isinstance(env.unwrapped, FlightVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_gymnasium_makes_others_of_the_single_one(make_vec):
    env = make_vec(2, "sync", start="spread")
    assert isinstance(env, SyncVectorEnv)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0].shape == (2, 62)


def test_who_waits_is_not_flown_without_autoreset(make_vec, starts):
    env = make_vec(COUNT, autoreset_mode="Disabled", shield=False)
    env.reset(options=starts)
    still = np.zeros((COUNT, 3))
    ended = np.logical_or(*env.step(still)[2:4])
    assert ended[:2].all()
    with pytest.raises(RuntimeError, match=r"flights \[0, 1.* have ended: call reset"):
        env.step(still)
    _, infos = env.reset(options={"reset_mask": ended})
    np.testing.assert_array_equal(infos["_time"], ended)
    env.step(still)


@pytest.mark.parametrize("mask", [[True], [1] * COUNT, True])
def test_a_mask_that_is_none_is_refused(make_vec, mask):
    with pytest.raises(ValueError, match=r"reset_mask: .*: must be Boolean of shape"):
        make_vec(COUNT).reset(options={"reset_mask": np.array(mask)})


@pytest.mark.parametrize("shape", [(3, 8), (1, 3), (16, 3), (24,)])
def test_actions_of_another_shape_are_refused(make_vec, shape):
    env = make_vec(8)
    env.reset()
    with pytest.raises(ValueError, match=r"action: shape .*: must be \(8, 3\)"):
        env.unwrapped.step(np.zeros(shape))


def test_a_mode_has_its_name_or_its_value(make_vec):
    for mode in ("NEXT_STEP", "NextStep", AutoresetMode.NEXT_STEP):
        assert make_vec(1, autoreset_mode=mode).unwrapped.autoreset_mode is AutoresetMode.NEXT_STEP
    with pytest.raises(ValueError, match=r"autoreset_mode: never: must be one of NEXT_STEP, "):
        make_vec(1, autoreset_mode="never")


def test_there_must_be_flights(make_vec):
    with pytest.raises(ValueError, match="num_envs: 0: must be at least 1"):
        make_vec(0)


def test_gymnasiums_wrappers_work(make_vec):
    env = NormalizeObservation(RecordEpisodeStatistics(make_vec(3, autoreset_mode="NextStep")))
    env.reset(seed=0)
    lengths = []
    for _ in range(100):
        *_, infos = env.step(env.unwrapped.law())
        lengths += infos["episode"]["l"][infos["_episode"]].tolist() if "episode" in infos else []
    assert len(lengths) == 3
    assert len(set(lengths)) == 1


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
@pytest.mark.filterwarnings("ignore:.*VecGymEnvTransform")
def test_torchrl_accepts_it_wrapped(make_vec, mode):
    env = GymWrapper(make_vec(3, start="spread", autoreset_mode=mode))
    check_env_specs(env)
    flown = env.rollout(60, break_when_any_done=False)
    assert flown["next", "observation"].shape == (3, 60, 62)


def test_torchrl_sees_the_last_observation_of_an_episode(make_vec, starts):
    """Not that of the next one's start, which comes in the same step."""
    env = make_vec(COUNT, shield=False)
    wrapped = GymWrapper(env)
    now = wrapped.reset()
    env.reset(options=starts)
    expected = make_vec(COUNT, shield=False, autoreset_mode="Disabled")
    expected.reset(options=starts)
    action = torch.zeros(COUNT, 3)
    after = wrapped.step(TensorDict({**now, "action": action}, COUNT))["next"]
    np.testing.assert_array_equal(after["observation"].numpy(), expected.step(action.numpy())[0])
    assert after["done"][:2].all()
