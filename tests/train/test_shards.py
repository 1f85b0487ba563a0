"""Simulations in other processes against the same ones in this process, bit for bit."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from mjcollect.envs.batch import BatchedFlightEnv
from mjcollect.envs.course import Course
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.trainer import make_simulations
from mjcollect.scene.scene import Scene
from train.jobs.shards import LocalCrew, RayCrew, ShardedSimulations
from train.jobs.workers import connect_ray
from train.support.run_folder import RunError

COUNTS = (3, 2)


def simulations(course, count, seed):
    """Disturbed ones, of which some soon end."""
    level = Disturbance(wind=4.0, gusts=2.0, gain=0.2, delay=0.1, noise=0.3, mover=5.0)
    disturbances = Disturbances(level, count, np.random.default_rng(seed), vary=True)
    config = LearnConfig(envs=count, observation="robust", reward="careful")
    return make_simulations([course], config, seed, disturbances)


def test_more_shards_than_the_cluster_has_cores_are_refused():
    """They would wait for ever."""
    ray = pytest.importorskip("ray")
    with pytest.raises(RunError, match="--shards: 100000: the cluster at local has"):
        connect_ray("local", cpus=100_000)
    assert not ray.is_initialized()


@pytest.fixture(scope="module")
def makes(scene_file):
    course = Course.segment(Scene.load(scene_file), (0, 1), 1)
    return [partial(simulations, course, count, seed) for seed, count in enumerate(COUNTS)]


@pytest.fixture(params=["local", pytest.param("ray", marks=pytest.mark.slow)])
def crew(request):
    if request.param == "ray":
        ray = pytest.importorskip("ray")
        here = {"env_vars": {"PYTHONPATH": str(Path(__file__).parent)}}
        ray.init(num_cpus=2, log_to_driver=False, include_dashboard=False, runtime_env=here)
        made = RayCrew(2)
    else:
        made = LocalCrew(2)
    yield made
    made.close()


def fly(env, steps, rng, now):
    """Steps with resets; everything that came back."""
    seen = []
    for _ in range(steps):
        step = now.copy()
        step["action"] = torch.from_numpy(rng.uniform(-1, 1, (5, 3))).float()
        step, now = env.step_and_maybe_reset(step)
        names = ("observation", "reward", "terminated", "truncated", "success", "crashed")
        seen.append([step["next"][name].numpy() for name in (*names, "shielded")])
        seen[-1] += [now["observation"].numpy(), env.simulations.law()]
    return seen, now


def test_are_those_of_this_process_bit_for_bit(crew, makes):
    sharded = ShardedSimulations(crew, makes, COUNTS)
    env = BatchedFlightEnv(sharded)
    begun = env.reset()
    whole, now = fly(env, 240, np.random.default_rng(0), begun)
    saved = sharded.state_dict()
    ends = sum(int((row[2] | row[3]).sum()) for row in whole)
    assert ends > 3
    assert sum(int(row[6].sum()) for row in whole) > 3  # the shield acts over there too

    for part, (make, count) in enumerate(zip(makes, COUNTS, strict=True)):
        rows = slice(sum(COUNTS[:part]), sum(COUNTS[:part]) + count)
        own = BatchedFlightEnv(make())
        first = own.reset()
        np.testing.assert_array_equal(first["observation"], begun["observation"][rows])
        alone = _alone(own, 240, np.random.default_rng(0), first, rows)
        for one, other in zip(alone, whole, strict=True):
            for a, b in zip(one, other, strict=True):
                np.testing.assert_array_equal(a, b[rows])
        own.close()

    on, _ = fly(env, 5, np.random.default_rng(1), now)
    sharded.load_state_dict(saved)
    again, _ = fly(env, 5, np.random.default_rng(1), now)
    for one, other in zip(on, again, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def _alone(env, steps, rng, now, rows):
    """As `fly`, with the rows of the same actions."""

    class Rows:
        def uniform(self, low, high, size):
            return rng.uniform(low, high, size)[rows]

    return fly(env, steps, Rows(), now)[0]


def test_an_error_over_there_is_one_here():
    crew = LocalCrew(1)
    with pytest.raises(ValueError, match="invalid literal"):
        crew.ask("make", [(partial(int, "no number"),)])
    crew.close()
