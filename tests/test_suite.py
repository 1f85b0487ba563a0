"""Rules that every registered task keeps, with every observation, reward and kind of start.

In the manner of dm_control's `suite/suite_test.py`. The scene has four boxes, so that no part of an
observation is padding.
"""

from __future__ import annotations

import numpy as np
import pytest
from dm_control.rl import control
from dm_env import StepType
from torchrl.envs import DMControlWrapper
from torchrl.envs.utils import check_env_specs

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import START_KINDS
from mjcollect.envs.dm_env import load, make_environment, task_names
from mjcollect.envs.episode import Rules
from mjcollect.envs.observation import OBSERVATIONS, SHOW_DISTURBANCES, SHOW_OTHERS
from mjcollect.envs.reward import CAREFUL_CRASH, CRASH, PRESETS, R2, R5, R6
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.scene.mjcf import ACTUATORS, HIT_SENSOR, JOINTS, UAV_BODY, UAV_GEOM

TURN = 10.0  # seconds, more than it takes to turn round from full speed
DIAGONAL = 410.0  # metres, of the scene
RANGES = {
    "time": (-TURN, TURN),
    "lost": (-TURN, TURN),
    "careful": (min(CAREFUL_CRASH, -TURN), TURN),
    "paper": (R5 + R6 - DIAGONAL, R2),
}
DISTURBED = Disturbance(
    wind=5.0, gusts=2.5, gain=0.25, delay=0.1, noise=0.5, mover=10.0, boxes=2, turned=30.0
)
# Elements that no flight changes, and why:
ONLY_DISTURBED = ("push", "doubts", "movers", "met")  # calm air; see the disturbed flights below
ONLY_AMONG_OTHERS = ("others",)  # one UAV alone; tests/fleet looks at several
# A segment has one target: the way on from there is always the same, which `path` sees turn with
# its frame, and other items are not collected.
OF_ONE_TARGET = {("guided", "next_direction"): [1, 1, 1], ("paper", "p"): [0, 1]}


@pytest.fixture(scope="module")
def courses(corridor):
    """What `load` makes of each task's name alone."""
    made = {}
    for task in task_names():
        environment = load(task, corridor, order="0,1")
        made[task] = environment.task.course
        environment.close()
    return made


@pytest.fixture
def make(courses, request):
    """Makes environments of a task, without building its guidance again."""

    def environment(task, **options) -> control.Environment:
        made = make_environment(courses[task], **options)
        request.addfinalizer(made.close)
        return made

    return environment


@pytest.fixture(scope="module", params=OBSERVATIONS)
def observation(request):
    return request.param


@pytest.fixture(scope="module", params=task_names())
def task(request):
    return request.param


@pytest.fixture(scope="module")
def environment(courses, task, observation):
    """One environment for all that leaves no trace in it."""
    made = make_environment(courses[task], observation=observation, start="spread", random=1)
    yield made
    made.close()


def play(environment, seed, episodes=6, most=20):
    """Time steps of random actions."""
    rng, timesteps = np.random.default_rng(seed), []
    for _ in range(episodes):
        timesteps.append(environment.reset())
        while not timesteps[-1].last() and environment.task.episodes.steps[0] < most:
            timesteps.append(environment.step(rng.uniform(-1.0, 1.0, 3)))
    return timesteps


def by_law(environment):
    """Time steps of an episode flown by the guidance law."""
    timesteps = [environment.reset()]
    while not timesteps[-1].last():
        action = environment.task.episodes.guidance_action()[0]
        timesteps.append(environment.step(action))
    return timesteps


def flat(timestep):
    return np.concatenate(list(timestep.observation.values()))


# Specs


def test_actions_are_three_numbers_from_minus_one_to_one(environment):
    spec = environment.action_spec()
    assert (spec.shape, spec.dtype) == ((3,), np.float64)
    np.testing.assert_array_equal(spec.minimum, -1.0)
    np.testing.assert_array_equal(spec.maximum, 1.0)


def test_observations_and_discounts_are_as_specified(environment):
    specs = environment.observation_spec()
    for timestep in play(environment, 0):
        assert list(timestep.observation) == list(specs)
        for name, array in timestep.observation.items():
            specs[name].validate(array)
            assert array.dtype == np.float64
            assert np.isfinite(array).all(), name
        if timestep.first():
            assert timestep.reward is timestep.discount is None
        else:
            assert (type(timestep.reward), type(timestep.discount)) == (float, float)
            environment.discount_spec().validate(timestep.discount)
            assert timestep.discount in ((0.0, 1.0) if timestep.last() else (1.0,))


@pytest.mark.parametrize("reward", PRESETS)
def test_rewards_are_finite_and_of_their_range(make, task, reward):
    environment = make(task, reward=reward, start="spread", random=1)
    low, high = RANGES[reward]
    paid = [step.reward for step in play(environment, 0, episodes=20) if not step.first()]
    paid += [step.reward for step in by_law(make(task, reward=reward))[1:]]
    for value in paid:
        environment.reward_spec().validate(value)
    assert low <= min(paid) < max(paid) <= high


def test_a_step_changes_neither_its_action_nor_the_specs(make, task, observation):
    environment = make(task, observation=observation)
    specs = environment.action_spec(), environment.observation_spec(), environment.reward_spec()
    environment.reset()
    for action in (np.array([0.3, -0.2, 0.9]), np.array([np.nan, 7.0, -1.0])):
        given = action.copy()
        environment.step(action)
        np.testing.assert_array_equal(action, given)
    after = environment.action_spec(), environment.observation_spec(), environment.reward_spec()
    assert after == specs


def test_a_slot_lasts_as_long_as_the_scene_says(environment):
    assert not environment.physics.legacy_step
    assert environment.control_timestep() == pytest.approx(0.2)
    environment.reset()
    environment.step(np.zeros(3))
    assert environment.physics.time() == pytest.approx(0.2)


def test_keywords_of_the_environment_reach_it(make, task):
    flattened = make(task, environment_kwargs={"flat_observation": True}).reset()
    assert set(flattened.observation) == {control.FLAT_OBSERVATION_KEY}
    np.testing.assert_array_equal(flat(flattened), flat(make(task).reset()))


# The model


def test_every_part_of_the_model_has_a_name_and_there_are_cameras(environment):
    model = environment.physics.model
    counts = {
        "body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "site": model.nsite,
        "camera": model.ncam, "light": model.nlight, "texture": model.ntex, "material": model.nmat,
        "actuator": model.nu, "sensor": model.nsensor, "mesh": model.nmesh,
        "hfield": model.nhfield, "equality": model.neq, "tendon": model.ntendon,
        "numeric": model.nnumeric, "text": model.ntext, "tuple": model.ntuple,
    }  # fmt: skip
    names = {kind: [model.id2name(k, kind) for k in range(n)] for kind, n in counts.items()}
    assert all(all(found) for found in names.values()), names
    assert len(names["camera"]) >= 2
    assert UAV_BODY in names["body"]
    assert UAV_GEOM in names["geom"]
    assert (names["joint"], names["actuator"]) == (list(JOINTS), list(ACTUATORS))
    assert names["sensor"] == [HIT_SENSOR]


# Observations


def test_observations_of_two_slots_share_no_memory(environment):
    first, second = environment.reset(), environment.step(np.zeros(3))
    for name, array in first.observation.items():
        assert not np.may_share_memory(array, second.observation[name]), name


def test_no_element_of_an_observation_is_constant(make, task, observation):
    """Over random play from all over the scene and a flight to the end."""
    strewn = make(task, observation=observation, start="spread", random=1)
    timesteps = play(strewn, 2, episodes=20) + by_law(make(task, observation=observation))
    for name in timesteps[0].observation:
        found = np.ptp([step.observation[name] for step in timesteps], axis=0) < 1e-6
        expected = OF_ONE_TARGET.get((observation, name), 0) if task == "segment" else 0
        if observation in SHOW_DISTURBANCES and name in ONLY_DISTURBED:
            expected = 1
        if observation in SHOW_OTHERS and name in ONLY_AMONG_OTHERS:
            expected = 1
        assert (found == expected).all(), (name, found)


@pytest.mark.parametrize("shows", SHOW_DISTURBANCES)
def test_nor_where_it_tells_of_disturbances(courses, task, shows):
    rng, seen = np.random.default_rng(0), []
    level = Disturbances(DISTURBED, 8, np.random.default_rng(1))
    simulations = Simulations(
        [courses[task]], 8, rules=Rules(shows), start="spread", threads=1, disturbances=level,
        rng=np.random.default_rng(2),
    )  # fmt: skip
    simulations.reset()
    for _ in range(100):
        outcome = simulations.step(rng.uniform(-1.0, 1.0, (8, 3)))
        simulations.reset(np.flatnonzero(outcome.terminated | outcome.truncated))
        seen.append(simulations.episodes.observe())
    simulations.close()
    for name in ONLY_DISTURBED:
        found = np.ptp(np.concatenate([parts[name] for parts in seen]), axis=0) < 1e-6
        assert not found.any(), (name, found)


# Seeds and starts


def test_the_same_seed_and_actions_give_the_same_bits(make, task, observation):
    runs = []
    for seed in (7, 7, 8):
        environment = make(task, observation=observation, start="ball", random=seed)
        runs.append(play(environment, 3, episodes=2))
    one, two, other = runs
    for a, b in zip(one, two, strict=True):
        assert flat(a).tobytes() == flat(b).tobytes()
        assert (a.step_type, a.reward, a.discount) == (b.step_type, b.reward, b.discount)
    assert not np.array_equal(flat(one[0]), flat(other[0]))


@pytest.mark.parametrize("kind", START_KINDS)
def test_each_episode_and_each_seed_starts_elsewhere_unless_at_the_point(make, task, kind):
    starts = []
    for seed in (0, 1):
        environment = make(task, start=kind, random=seed)
        starts += [tuple(flat(environment.reset())) for _ in range(3)]
    assert len(set(starts)) == (1 if kind == "point" else 6)


# Ends


@pytest.mark.parametrize("reward", PRESETS)
def test_the_law_flies_to_the_end(make, task, reward):
    environment = make(task, reward=reward)
    timesteps = by_law(environment)
    assert environment.task.outcome.success[0]
    assert (timesteps[-1].step_type, timesteps[-1].discount) == (StepType.LAST, 0.0)
    assert environment.task.episodes.collected[0].any()
    assert environment.reset().first()
    assert not environment.task.episodes.collected[0].any()


@pytest.mark.parametrize("reward", PRESETS)
def test_who_hovers_is_stopped_at_the_step_limit(make, task, reward):
    environment = make(task, reward=reward)
    limit = environment.task.course.step_limit
    (*waiting, last) = play(environment, 0, episodes=1, most=0)
    for _ in range(limit):
        waiting, last = [*waiting, last], environment.step(np.zeros(3))
    assert not any(timestep.last() for timestep in waiting)
    assert (last.step_type, last.discount) == (StepType.LAST, 1.0)
    outcome = environment.task.outcome
    assert (outcome.truncated[0], outcome.terminated[0]) == (True, False)


@pytest.mark.parametrize("reward", PRESETS)
def test_a_crash_ends_the_episode_where_the_reward_says_so(make, task, reward):
    environment = make(task, reward=reward)
    environment.reset()
    wall = environment.task.course.scene.bounds[0] + [1.0, 30.0, 30.0]
    environment.task.place(environment.physics, wall, np.array([-30.0, 0.0, 0.0]))
    last = environment.step(np.zeros(3))
    assert environment.task.outcome.slot.crashed[0]
    if PRESETS[reward].crash_ends:
        assert (last.step_type, last.discount) == (StepType.LAST, 0.0)
        assert last.reward == (CAREFUL_CRASH if reward == "careful" else CRASH)
    else:
        assert (last.step_type, last.discount) == (StepType.MID, 1.0)


# Actions


def test_actions_out_of_the_spec_or_not_finite_are_flown_within_the_limits(environment):
    a_max = environment.task.course.scene.a_max
    for action in ([5.0, -7.0, 0.0], [np.nan, 1.0, np.inf], [1e308, 1e308, 1e308]):
        environment.reset()
        environment.step(np.array(action))
        assert np.linalg.norm(environment.task.acceleration) <= a_max * (1 + 1e-12)
        assert np.isfinite(environment.physics.velocity()).all()


# Others' tools


def test_torchrl_accepts_it(make, task, observation):
    environment = make(task, observation=observation, random=1)
    wrapped = DMControlWrapper(environment)
    check_env_specs(wrapped)
    tensordict = wrapped.reset()
    tensordict["action"] = wrapped.action_spec.rand()
    after = wrapped.step(tensordict)["next"]
    assert after["reward"].shape == (1,)
    assert not after["truncated"].any()
    assert set(environment.observation_spec()) <= set(after.keys())
