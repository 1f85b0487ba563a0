"""Single decisions in plain NumPy equal the torch actor's."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from mjcollect.envs.batch import Simulations
from mjcollect.envs.episode import Rules
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import PlainActor, TrainedPolicy, policy_digest
from train.support.run_folder import RunError
from train.support.starting_policy import check_size, start_from


@pytest.fixture
def actor():
    """A network whose every parameter matters, as after learning."""
    torch.manual_seed(0)
    actor = make_actor(45, 128)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return actor


def by_torch(actor, observations):
    with torch.no_grad():
        batch = TensorDict({"observation": torch.from_numpy(observations)}, len(observations))
        return actor(batch)["action"].numpy()


def test_single_decisions_equal_the_torch_actor(actor):
    policy = TrainedPolicy(actor, "guided")
    observations = np.random.default_rng(0).normal(size=(200, 45)).astype(np.float32)
    observations *= np.logspace(-2, 1, 200, dtype=np.float32)[:, None]
    single = np.concatenate([policy(observation[None]) for observation in observations])
    expected = by_torch(actor, observations)
    assert single.shape == (200, 3)
    assert single.dtype == np.float32
    assert np.abs(expected).std() > 0.1
    assert np.allclose(single, expected, rtol=0, atol=1e-5)
    assert np.array_equal(policy(observations), expected)


def test_inputs_stay_as_they_are(actor):
    observation = np.random.default_rng(0).normal(size=(1, 45)).astype(np.float32)
    before, policy = observation.copy(), TrainedPolicy(actor, "guided")
    first = policy(observation)
    assert np.array_equal(observation, before)
    assert np.array_equal(policy(observation), first)


@pytest.mark.parametrize("name", ["policy.pt", "policy.safetensors"])
def test_a_loaded_policy_decides_the_same(tmp_path, name):
    policy = TrainedPolicy(make_actor(45, 16), "guided")
    policy.save(tmp_path / name)
    observation = np.random.default_rng(0).normal(size=(1, 45)).astype(np.float32)
    loaded = TrainedPolicy.load(tmp_path / name)
    assert np.array_equal(loaded(observation), policy(observation))
    assert (loaded.observation, loaded.width) == ("guided", 16)


def test_learning_goes_on_from_a_policy_of_the_same_shape(tmp_path):
    path = tmp_path / "policy.safetensors"
    TrainedPolicy(make_actor(45, 16), "robust").save(path)
    policy, learn = start_from(path, LearnConfig(updates=5))
    assert (learn.observation, learn.width, learn.updates) == ("robust", 16, 5)
    assert learn.least_updates == 0
    asked = LearnConfig(least_updates=7)
    assert start_from(path, asked)[1].least_updates == 7
    assert policy.observation == "robust"
    for field, value in (("width", 32), ("observation", "paper")):
        with pytest.raises(RunError, match=f"--{field}: {value}"):
            start_from(path, LearnConfig(**{field: value}))


def test_the_same_weights_give_the_same_file(tmp_path):
    policy = TrainedPolicy(make_actor(45, 16), "robust")
    files = [tmp_path / f"{k}.safetensors" for k in range(4)]
    for file in files:
        policy.save(file)
    assert len({policy_digest(file) for file in files}) == 1


def test_a_policy_for_other_observations_is_refused(free_course):
    """As one of the observation `robust` is that was saved before that grew."""
    simulations = Simulations([free_course], 1, rules=Rules("robust"), threads=1)
    size = simulations.observe().shape[1]
    simulations.close()
    check_size(TrainedPolicy(make_actor(size, 16), "robust"), free_course)
    message = f"--policy: a policy of {size - 20} inputs, .* robust has {size} here"
    with pytest.raises(RunError, match=message):
        check_size(TrainedPolicy(make_actor(size - 20, 16), "robust"), free_course)


@pytest.mark.parametrize(
    "name",
    ["none.pt", "text.pt", "text.safetensors", "empty.pt", "other.pt", "flat.pt", "strange.pt"],
)
def test_a_file_that_is_no_policy_is_refused(tmp_path, name):
    for text in ("text.pt", "text.safetensors"):
        (tmp_path / text).write_text("no policy")
    (tmp_path / "empty.pt").touch()
    torch.save({"actor": {}}, tmp_path / "other.pt")
    torch.save({"actor": torch.zeros(3)}, tmp_path / "flat.pt")
    TrainedPolicy(make_actor(45, 16), "strange").save(tmp_path / "strange.pt")
    with pytest.raises(RunError, match=f"--policy: .*{name}: holds no policy"):
        start_from(tmp_path / name, LearnConfig())


def test_a_new_policy_sees_what_was_learned_since(actor):
    observation = np.ones((1, 45), dtype=np.float32)
    before = TrainedPolicy(actor, "guided")(observation)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(0.5)
    after = TrainedPolicy(actor, "guided")(observation)
    assert not np.allclose(after, before, atol=1e-3)
    assert np.allclose(after, by_torch(actor, observation), atol=1e-5)


def test_other_networks_are_refused(actor):
    with pytest.raises(ValueError, match="Softplus"):
        PlainActor(nn.Sequential(nn.Linear(4, 3), nn.Softplus()))
    with pytest.raises(ValueError, match="tanh"):
        PlainActor(nn.Sequential(nn.Linear(4, 3), nn.ReLU()))


def test_a_wider_observation_does_not_change_the_policy_at_first():
    """Of `path` in `robust`: actions are the same whatever the new numbers are."""
    narrow = TrainedPolicy(make_actor(4, 8), "path")
    wide = TrainedPolicy(make_actor(7, 8), "robust")
    wide.actor.load_state_dict(narrow.widened(7))
    seen = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    np.testing.assert_allclose(wide(seen), narrow(seen[:, :4]), atol=1e-6)
    with pytest.raises(ValueError, match="policy: takes 7 numbers"):
        wide.widened(4)
