"""Damaged files are refused with their name, or right all the same; nothing in them is run."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

from mjcollect.envs.recording import fly_law
from mjcollect.guidance import cache
from mjcollect.learning.ddpg import make_actor, make_buffer
from mjcollect.learning.policy import SUMS, PolicyError, TrainedPolicy
from mjcollect.scene.assets import asset_path
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify
from mjcollect.verify.__main__ import main as verify_main
from train.support.run_folder import RunError, RunFolder

DAMAGES = 200  # flips of a byte, and cuts, of every kind of file


def damaged(data, rng):
    """A file's bytes with one byte flipped, or cut, or with a stretch of zeros as after a crash."""
    kind, where = int(rng.integers(4)), int(rng.integers(len(data)))
    if kind == 0:
        return data[:where]
    if kind == 1:
        return data[:where] + bytes(min(512, len(data) - where)) + data[where + 512 :]
    return data[:where] + bytes([data[where] ^ int(rng.integers(1, 256))]) + data[where + 1 :]


def damages(data, seed):
    """So many different damages of a file, each of which changes it."""
    rng = np.random.default_rng(seed)
    for _ in range(DAMAGES):
        new = data
        while new == data:
            new = damaged(data, rng)
        yield new


class Payload:
    """Makes a file where it is unpickled."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return open, (str(self.trace), "w")


@pytest.fixture
def trace(tmp_path):
    """A file that is there only if something was unpickled."""
    path = tmp_path / "trace"
    pickle.loads(pickle.dumps(Payload(path)))
    assert path.exists()  # so it would work
    path.unlink()
    return path


def policy():
    torch.manual_seed(0)
    return TrainedPolicy(make_actor(45, 8), "guided")


def weights(one):
    return {name: value.numpy().tobytes() for name, value in one.actor.state_dict().items()}


@pytest.mark.parametrize("name", ["policy.pt", "policy.safetensors"])
def test_damaged_policies(tmp_path, name):
    path, right = tmp_path / name, policy()
    right.save(path)
    refused = fine = 0
    for data in damages(path.read_bytes(), 0):
        path.write_bytes(data)
        try:
            loaded = TrainedPolicy.load(path)
        except PolicyError as error:
            refused += str(path) in str(error)
        else:
            assert weights(loaded) == weights(right)
            assert loaded.observation == right.observation
            fine += 1
    assert refused + fine == DAMAGES
    assert refused > DAMAGES / 2


def test_policies_of_earlier_versions_load(tmp_path):
    path, right = tmp_path / "policy.safetensors", policy()
    about = json.dumps({"observation": "guided"})
    path.write_bytes(safetensors.torch.save(right.actor.state_dict(), {"policy": about}))
    assert weights(TrainedPolicy.load(path)) == weights(right)


@pytest.mark.parametrize("name", ["generalist", "disturbed"])
def test_shipped_policies_have_a_digest_beside_them(tmp_path, name):
    for each in (SUMS, f"{name}.safetensors"):
        shutil.copy(asset_path("policies", each), tmp_path / each)
    path = tmp_path / f"{name}.safetensors"
    TrainedPolicy.load(path)
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)
    with pytest.raises(PolicyError, match=SUMS):
        TrainedPolicy.load(path)


@pytest.mark.parametrize("name", ["policy.pt", "policy.safetensors"])
@pytest.mark.parametrize("how", ["torch", "legacy", "pickle"])
def test_policies_are_not_unpickled(tmp_path, trace, name, how):
    path, content = tmp_path / name, {"actor": Payload(trace), "observation": "guided"}
    if how == "pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=how == "torch")
    with pytest.raises(PolicyError, match=str(path)):
        TrainedPolicy.load(path)
    assert not trace.exists()


def parts(seed):
    """What a checkpoint holds: a network with its optimizer's state, and a filled buffer."""
    torch.manual_seed(seed)
    net = torch.nn.Linear(3, 2)
    adam = torch.optim.Adam(net.parameters())
    net(torch.randn(4, 3)).sum().backward()
    adam.step()
    buffer = make_buffer(16, 4, seed)
    buffer.extend(TensorDict({"observation": torch.randn(8, 3), "next": {"r": torch.rand(8)}}, 8))
    return {"net": net, "adam": adam, "buffer": buffer}


def state(components):
    """All numbers of components, as text, with what the buffer would sample next."""
    return repr([value.state_dict() for value in components.values()])


@pytest.fixture
def saved(tmp_path):
    """A run folder with a checkpoint, and the state that is in it."""
    folder, right = RunFolder(tmp_path / "run"), parts(0)
    folder.path.mkdir()
    folder.save_checkpoint(**right)
    return folder, state(right)


def test_checkpoints_give_back_what_was_saved(saved):
    folder, right = saved
    other = parts(1)
    assert state(other) != right
    assert folder.load_checkpoint(**other)
    assert state(other) == right
    again = parts(2)
    folder.load_checkpoint(**again)
    samples = [each["buffer"].sample()["observation"] for each in (other, again)]
    assert torch.equal(*samples)


def test_damaged_checkpoints(saved):
    folder, right = saved
    files = sorted(path for path in (folder.path / "checkpoint").rglob("*") if path.is_file())
    assert len(files) == 8
    rng, refused, fine = np.random.default_rng(0), 0, 0
    other = parts(1)
    before = state(other)
    for _ in range(DAMAGES):
        path = files[int(rng.integers(len(files)))]
        data = path.read_bytes()
        path.write_bytes(damaged(data, rng))
        try:
            folder.load_checkpoint(**other)
        except RunError as error:
            # Nothing is loaded by half.
            refused += str(path) in str(error) and state(other) == before
        else:
            assert state(other) == right
            other = parts(1)
            fine += 1
        path.write_bytes(data)
    assert refused + fine == DAMAGES
    assert refused > DAMAGES * 0.9


@pytest.mark.parametrize("change", ["less", "more"])
def test_checkpoints_with_files_missing_or_beside_them(saved, change):
    folder, _ = saved
    path = folder.path / "checkpoint/components/0001-buffer/tensors.safetensors"
    if change == "more":
        path = path.with_name("prefetch.pkl")
        path.write_bytes(b"")
    else:
        path.unlink()
    with pytest.raises(RunError, match=str(path)):
        folder.load_checkpoint(**parts(1))


def sign(folder):
    """Gives a checkpoint the digests of what is in it, as an attacker would."""
    names = sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / SUMS)
    digests = [
        f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder)}\n" for p in names
    ]
    text = "".join(digests)
    (folder / SUMS).write_text(f"# {hashlib.sha256(text.encode()).hexdigest()}\n{text}")


@pytest.mark.parametrize("signed", [False, True])
def test_checkpoints_are_not_unpickled(tmp_path, trace, signed):
    """TorchRL's own loader would unpickle this one."""
    folder, components = RunFolder(tmp_path), {"buffer": parts(0)["buffer"]}
    Checkpoint(**components).save(tmp_path / "checkpoint")
    crafted = tmp_path / "checkpoint/components/0000-buffer/prefetch.pkl"
    assert crafted.is_file()
    crafted.write_bytes(pickle.dumps(Payload(trace)))
    if signed:
        sign(tmp_path / "checkpoint")
    with pytest.raises(RunError, match=str(tmp_path / "checkpoint")):
        folder.load_checkpoint(**components)
    assert not trace.exists()


def test_pickles_slipped_into_a_checkpoint_are_not_run(saved, trace):
    folder, _ = saved
    path = folder.path / "checkpoint"
    for name in ("prefetch.pkl", "state.pt", "other.pickle"):
        (path / "components/0001-buffer" / name).write_bytes(pickle.dumps(Payload(trace)))
    (path / "components/0002-net/tensors.safetensors").write_bytes(pickle.dumps(Payload(trace)))
    sign(path)
    with pytest.raises(RunError, match=str(path)):
        folder.load_checkpoint(**parts(1))
    assert not trace.exists()


def test_damaged_guidance_is_built_anew(free_course, tmp_path):
    built = free_course.guidance[0]
    path = cache.save(built, tmp_path)
    arguments = (tmp_path, built.scene, built.node, built.start, built.next_goal)
    gone = 0
    for data in damages(path.read_bytes(), 1):
        path.write_bytes(data)
        loaded = cache.load(*arguments)
        gone += loaded is None
        if loaded is not None:
            assert np.array_equal(loaded.path, built.path)
            for name, value in built.way._asdict().items():
                if name != "tree":
                    np.testing.assert_array_equal(getattr(loaded.way, name), value)
    assert gone > DAMAGES / 2


def test_guidance_is_not_unpickled(free_course, tmp_path, trace):
    built = free_course.guidance[0]
    path = cache.save(built, tmp_path)
    with np.load(path) as file:
        numbers = dict(file)
    numbers["path"] = np.array([Payload(trace)], dtype=object)
    np.savez(path, **numbers)
    assert cache.load(tmp_path, built.scene, built.node, built.start, built.next_goal) is None
    assert not trace.exists()


def test_damaged_flights_are_refused_or_break_a_rule(free_mission, tmp_path):
    """Every number of a flight hangs on those before and after it."""
    scene, path, right = free_mission.scene, tmp_path / "trajectory.csv", fly_law(free_mission)
    right.trajectory.save(path)
    assert verify(scene, right.trajectory, (0, 1)) == []
    found = fine = 0
    for data in damages(path.read_bytes(), 2):
        path.write_bytes(data)
        try:
            flown = Trajectory.load(path)
        except ValueError as error:
            found += str(path) in str(error)
            continue
        if verify(scene, flown, (0, 1)):
            found += 1
        else:
            for name in ("t", "x", "v", "a"):
                same = getattr(flown, name), getattr(right.trajectory, name)
                np.testing.assert_allclose(*same, rtol=0.0, atol=1e-4)
            fine += 1
    assert found + fine == DAMAGES
    assert found > DAMAGES / 2


@pytest.mark.parametrize("name", ["scene.json", "trajectory.csv", "segment.json"])
def test_run_folders_are_not_unpickled(free_mission, tmp_path, trace, capsys, name):
    free_mission.scene.save(tmp_path / "scene.json")
    fly_law(free_mission).trajectory.save(tmp_path / "trajectory.csv")
    (tmp_path / "segment.json").write_text('{"order": [0, 1], "segment": 0}')
    (tmp_path / name).write_bytes(pickle.dumps(Payload(trace)))
    assert verify_main([str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert not trace.exists()


def test_damaged_scenes_are_refused_or_other_scenes(tmp_path, corridor):
    """What a flip leaves a scene is one: nothing can tell a digit that was changed."""
    path = tmp_path / "scene.json"
    corridor.save(path)
    refused = 0
    for data in damages(path.read_bytes(), 3):
        path.write_bytes(data)
        try:
            Scene.load(path)
        except ValueError:
            refused += 1
    assert refused > DAMAGES / 2
