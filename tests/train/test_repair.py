"""`python -m train.fly` in unseen scenes: by the policy shipped or another, and what fails."""

import hashlib
import json
import re

import numpy as np
import pytest
import torch

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import fly as fly_policies
from mjcollect.envs.recording import fly_law
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.generate import LAYOUTS
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.scene.assets import asset_path
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify
from train.fly import main as fly
from train.generalist import HELD_OUT
from train.jobs.segment_pool import draw_segment
from train.support import repair
from train.support.command_line import INTERRUPTED
from train.support.run_folder import RunFolder


@pytest.fixture
def weights(pupil_file):
    """Folder of `pupil.safetensors`, which arrives, and `wild.safetensors`, which always climbs."""
    wild = pupil_file.with_name("wild.safetensors")
    if not wild.exists():
        actor = make_actor(TrainedPolicy.load(pupil_file).inputs, 8)
        bias = [p for n, p in actor.named_parameters() if n.endswith("bias")][-1]
        bias.data = torch.tensor([0.0, 0.0, 20.0])
        TrainedPolicy(actor, "path").save(wild)
    return pupil_file.parent


def run(scene_file, out, policy, *more):
    arguments = ["--scene", str(scene_file), "--policy", str(policy), "--out", str(out)]
    code = fly([*arguments, "--order", "0,1", "--no-video", "--no-plots", *more])
    return code, json.loads((out / "mission.json").read_text())


def verified(scene_file, out):
    return verify(Scene.load(scene_file), Trajectory.load(out / "trajectory.csv"), (0, 1)) == []


def test_flies_a_scene_without_training(scene_file, weights, tmp_path):
    code, result = run(scene_file, tmp_path / "out", weights / "pupil.safetensors")
    assert code == 0
    assert (result["planner"], result["train_seconds"]) == ("policy", None)
    assert verified(scene_file, tmp_path / "out")
    pupil = TrainedPolicy.load(weights / "pupil.safetensors")
    own = fly_policies(Course.mission(Scene.load(scene_file), (0, 1)), [pupil] * 3, "path")
    assert result["mission_time"] == own.trajectory.duration
    assert not (tmp_path / "out" / "segments").exists()


def test_the_shipped_policy_flies_by_default(scene_file, pupil_file, tmp_path, monkeypatch):
    """Whichever it is: here another stands in its place."""
    for place in ("mjcollect.learning.policy", "train.support.starting_policy"):
        monkeypatch.setattr(f"{place}.weights_file", lambda path: {SHIPPED: pupil_file}[path])
    out = tmp_path / "out"
    arguments = ["--scene", str(scene_file), "--out", str(out), "--no-video", "--no-plots"]
    fields = tmp_path / "fields"
    assert fly([*arguments, "--finetune", "0", "--guidance-cache", str(fields)]) == 0
    result = json.loads((out / "mission.json").read_text())
    assert (result["planner"], result["train_seconds"]) == ("policy", None)
    config = json.loads((out / "config.json").read_text())
    assert config["policy"] == hashlib.sha256(pupil_file.read_bytes()).hexdigest()[:16]
    first = (out / "trajectory.csv").read_bytes()
    # With the guidance of the first flight it is the same.
    assert len(list(fields.glob("guidance-*.npz"))) == len(result["segments"])
    assert fly([*arguments, "--finetune", "0", "--guidance-cache", str(fields), "--overwrite"]) == 0
    assert (out / "trajectory.csv").read_bytes() == first


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_shipped_policy_arrives_in_scenes_it_was_not_trained_on(layout):
    """Each segment twice, calm and in wind with weak actuators."""
    policy = TrainedPolicy.load(weights_file(SHIPPED))
    level = Disturbance(wind=2.0, gain=0.1)
    for number in range(HELD_OUT + 50_000, HELD_OUT + 50_003):
        course = Course.segment(*draw_segment(0, number, layout))
        calm = np.array([True, False])
        disturbances = Disturbances(level, 2, np.random.default_rng(number), calm=calm)
        sims = Simulations([course], 2, rules=Rules(policy.observation), threads=1,
                           disturbances=disturbances)  # fmt: skip
        sims.place(np.arange(2), *course.starts("point", 2, np.random.default_rng(0)))
        done = np.zeros(2, dtype=bool)
        for _ in range(course.step_limit):
            outcome = sims.step(policy(sims.observe().astype(np.float32)))
            assert not (outcome.slot.crashed & ~done).any()
            done |= outcome.success
            if done.all():
                break
        assert done.all()
        sims.close()


def test_the_shipped_policy_is_small_and_the_one_that_its_card_describes():
    file = asset_path("policies", "generalist.safetensors")
    assert file.stat().st_size < 2e6
    assert policy_digest(SHIPPED) in file.with_name("README.md").read_text()


def test_the_shield_acts_unless_told_not_to(scene_file, weights, tmp_path):
    """`wild` flies into the ceiling without it, and hovers below it with it."""
    out, wild = tmp_path / "out", weights / "wild.safetensors"
    run(scene_file, out, wild, "--finetune", "4")
    assert json.loads((out / "config.json").read_text())["shield"] is True
    learned = json.loads((out / "segments/0/segment.json").read_text())
    assert learned["shield_share"] > 0.5
    assert json.loads((out / "segments/0/config.json").read_text())["learn"]["shield"] is True
    out = tmp_path / "without"
    code, result = run(scene_file, out, wild, "--finetune", "4", "--no-shield")
    assert (code, result["planner"], result["shield_share"]) == (0, "reference", 0.0)
    assert json.loads((out / "config.json").read_text())["shield"] is False
    assert json.loads((out / "segments/0/config.json").read_text())["learn"]["shield"] is False
    own = json.loads((out / "segments/0/segment.json").read_text())
    assert own["shield_share"] == 0.0
    assert "bounds" in {violation["kind"] for violation in own["violations"]}


def test_what_fails_and_is_not_trained_is_flown_by_the_reference(scene_file, weights, tmp_path):
    out = tmp_path / "out"
    code, result = run(scene_file, out, weights / "wild.safetensors", "--finetune", "0")
    assert code == 0
    assert result["planner"] == "reference"
    assert verified(scene_file, out)


def test_failing_segments_are_trained_one_after_another(scene_file, weights, tmp_path, monkeypatch):
    """The trainings find one that arrives; that they begin from the given one is seen below."""
    asked = []

    def train(args, course, order, folder, seed, shield, index):
        asked.append((index, args.finetune, args.policy.name))
        assert shield
        result = {"success_rate": 1.0, "train_seconds": 1.0, "env_steps": 2}
        return TrainedPolicy.load(weights / "pupil.safetensors"), result | {
            "updates": args.finetune
        }

    monkeypatch.setattr("train.fly._train", train)
    out = tmp_path / "out"
    code, result = run(scene_file, out, weights / "wild.safetensors", "--finetune", "7")
    assert code == 0
    assert result["planner"] == "policy"
    assert asked == [(k, 7, "wild.safetensors") for k in range(3)]
    assert [entry["updates"] for entry in result["segments"]] == [7, 7, 7]


def test_a_training_that_does_not_help_is_not_repeated(scene_file, weights, tmp_path):
    """Four updates from a policy that always climbs: for real, and drawn."""
    out, wild = tmp_path / "out", weights / "wild.safetensors"
    code, result = run(scene_file, out, wild, "--finetune", "4", "--plots")
    pictures = re.findall(r"\]\((\w+\.png)\)", (out / "report.md").read_text())
    assert {"path_3d.png", "learning.png"} <= set(pictures)
    assert all((out / name).is_file() for name in pictures)
    assert code == 0
    assert result["planner"] == "reference"
    own = json.loads((out / "segments/0/segment.json").read_text())
    assert own["updates"] == 4
    config = json.loads((out / "segments/0/config.json").read_text())
    assert config["policy"] is not None
    assert (config["learn"]["observation"], config["learn"]["width"]) == ("path", 8)
    assert all(entry["updates"] is None for entry in result["segments"])


def test_the_first_failure_is_found(scene_file):
    scene = Scene.load(scene_file)
    course = Course.mission(scene, (0, 1))
    whole = fly_law(course)
    assert repair.first_failure(course, (0, 1), whole) is None
    for segments in (0, 1, 2):
        cut = Course.mission(scene, (0, 1))
        object.__setattr__(cut, "step_limit", round((whole.arrivals[segments] - 0.4) / scene.slot))
        assert repair.first_failure(cut, (0, 1), fly_law(cut)) == segments


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--scene", "scenario_1", "--policy", "README.md"], "README.md: holds no policy"),
        (["--scene", "scenario_1", "--policy", "none.pt"], "none.pt: holds no policy"),
        (["--scene", "scenario_1", "--policy", "x", "--planner", "mpc"], "--policy: x"),
        (["--scene", "scenario_1", "--planner", "mpc", "--finetune", "-1"], "--finetune: -1"),
    ],
)
def test_bad_arguments_write_nothing(arguments, named, tmp_path, capsys):
    assert fly([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_ctrl_c_in_a_training_ends_with_130(scene_file, weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("train.fly.segment.train_segment", lambda _: INTERRUPTED)
    arguments = ["--scene", str(scene_file), "--policy", str(weights / "wild.safetensors")]
    assert fly([*arguments, "--out", str(tmp_path / "out"), "--no-video"]) == 130
    assert RunFolder(tmp_path / "out").read_json("mission.json") is None
    assert "start again with --overwrite" in capsys.readouterr().err


def test_a_folder_in_use_is_not_to_be_resumed(tmp_path, capsys):
    (tmp_path / "letter.txt").write_text("dear")
    assert fly(["--scene", "scenario_1", "--out", str(tmp_path)]) == 2
    assert "give --overwrite to start anew, or another folder" in capsys.readouterr().err


def test_guidance_that_cannot_be_kept_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    arguments = ["--scene", "scenario_1", "--guidance-cache", str(tmp_path / "file")]
    assert fly([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert "--guidance-cache: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_policy_of_another_size_writes_nothing(scene_file, tmp_path, capsys):
    TrainedPolicy(make_actor(45, 8), "path").save(tmp_path / "old.pt")
    arguments = ["--scene", str(scene_file), "--policy", str(tmp_path / "old.pt")]
    assert fly([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert "--policy: a policy of 45 inputs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
