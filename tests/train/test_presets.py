"""Presets and `--slot` of train.segment and train.mission."""

import dataclasses
import json

import numpy as np
import pytest
import torch
import tyro

from mjcollect.envs.course import Course
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.evaluation import Evaluator
from mjcollect.learning.trainer import segment_trainer
from mjcollect.scene.scene import Scene
from train import mission, segment
from train.jobs.workers import settings_arguments
from train.support.presets import PAPER, PRESETS, with_preset, with_slot
from train.support.run_folder import RunError

TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 16 --envs 2 --u1 4 --batch 8 --buffer 500 --width 8 --eval-every 8 "
    "--eval-episodes 2 --no-video"
).split()


def parse(program, *argv):
    return tyro.cli(program.Args, args=argv, default=with_preset(program.Args, argv))


@pytest.fixture(scope="module")
def scene():
    return Scene(
        name="hop",
        seed=0,
        bounds=[[0, 0, 0], [150, 150, 30]],
        depot=[75, 20, 15],
        items=[[75, 120, 15]],
        obstacles=[],
    )


@pytest.fixture(scope="module")
def scene_file(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "hop.json"
    scene.save(path)
    return path


@pytest.mark.parametrize("program", [segment, mission])
def test_the_paper_preset_is_what_the_paper_says(program):
    """Written out here a second time, from the paper."""
    args = parse(program, "--preset", "paper")
    learn = args.learn
    assert (learn.reward, learn.observation) == ("paper", "paper")
    assert learn.shield is False  # contact and bounds are penalties, r5 and r6
    assert (learn.demonstrations, learn.guided_share, learn.average_rate) == (0, 0.0, 0.0)
    assert (learn.optimizer, learn.final_rate, learn.actor_delay) == ("sgd", 1.0, 0)
    assert (learn.envs, learn.flown, learn.extra_updates) == (1, "last", 0)
    assert learn.noise_min == learn.noise_max
    assert min(learn.least_updates, learn.patience) > 1e8
    assert args.preset == "paper"
    if program is mission:
        assert args.retries == 0


@pytest.mark.parametrize("program", [segment, mission])
def test_the_paper_preset_leaves_the_rest_alone(program):
    with_it, without = parse(program, "--preset", "paper"), parse(program)
    assert without == program.Args()
    for field in dataclasses.fields(LearnConfig):
        if field.name not in PAPER:
            assert getattr(with_it.learn, field.name) == getattr(without.learn, field.name)


def test_every_entry_is_a_setting():
    fields = {field.name for field in dataclasses.fields(LearnConfig)}
    fields |= {field.name for field in dataclasses.fields(mission.Args)}
    for preset in PRESETS.values():
        assert set(preset) <= fields


@pytest.mark.parametrize(
    "argv",
    [
        ["--preset", "paper", "--average-rate", "0.25", "--flown", "best"],
        ["--average-rate", "0.25", "--flown=best", "--preset=paper"],
    ],
)
@pytest.mark.parametrize("program", [segment, mission])
def test_flags_beside_a_preset_win(program, argv):
    learn = parse(program, *argv).learn
    assert (learn.average_rate, learn.flown) == (0.25, "best")
    assert learn == dataclasses.replace(
        parse(program, "--preset", "paper").learn, average_rate=0.25, flown="best"
    )


def test_a_flag_that_repeats_the_default_wins_too():
    assert parse(segment, "--preset", "paper", "--reward", "time").learn.reward == "time"
    assert parse(mission, "--preset", "paper", "--retries", "2").retries == 2


@pytest.mark.parametrize("more", [["--envs", "8", "--reward", "time"], ["--shield"]])
def test_the_segments_of_a_mission_learn_with_its_settings(more):
    learn = parse(mission, "--preset", "paper", *more).learn
    assert learn.shield == ("--shield" in more)
    assert (
        parse(segment, *settings_arguments(dataclasses.asdict(learn)), "--preset", "paper").learn
        == learn
    )


@pytest.mark.parametrize("program", [segment, mission])
def test_unknown_preset_is_refused_by_name(program, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        program.main(["--preset", "papyrus", "--out", str(tmp_path / "run")])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert "--preset" in error
    assert "paper" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("slot", [0.25, 0.01, 0.0, -0.2, float("nan"), float("inf"), 30.0])
def test_a_slot_must_be_a_multiple_of_the_physics_step(scene, slot):
    with pytest.raises(RunError, match=r"--slot: .*physics_step = 0\.02"):
        with_slot(scene, slot)


def test_another_slot_changes_nothing_else(scene):
    assert with_slot(scene, None) is scene
    changed = with_slot(scene, 1.0)
    assert changed.slot == 1.0
    assert changed.substeps == 50
    assert dataclasses.replace(changed, slot=scene.slot) == scene


@pytest.mark.parametrize("program", [segment, mission])
def test_a_bad_slot_exits_2_and_writes_nothing(program, scene_file, tmp_path, capsys):
    out = tmp_path / "run"
    assert program.main(["--scene", str(scene_file), "--slot", "0.03", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "--slot: 0.03" in error
    assert "physics_step" in error
    assert not out.exists()


def test_a_run_records_and_flies_preset_and_slot(scene_file, tmp_path, capsys):
    out = tmp_path / "run"
    arguments = ["--scene", str(scene_file), "--segment", "0", "--out", str(out), *TINY]
    assert segment.main([*arguments, "--preset", "paper", "--slot", "0.5"]) in (0, 1)
    config = json.loads((out / "config.json").read_text())
    assert (config["preset"], config["slot"]) == ("paper", 0.5)
    assert (config["learn"]["reward"], config["learn"]["envs"]) == ("paper", 2)
    assert json.loads((out / "scene.json").read_text())["slot"] == 0.5
    flown = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    whole = (len(flown) - 1) // 25 * 25  # physics steps of whole slots
    pieces = flown[:whole, 7:].reshape(-1, 25, 3)
    assert np.ptp(pieces, axis=1).max() < 1e-9  # the acceleration is held for 0.5 s
    assert segment.main([*arguments, "--preset", "paper", "--resume"]) == 2
    assert "slot" in capsys.readouterr().err


def test_without_demonstrations_the_law_never_flies(scene, monkeypatch):
    """Under the preset all transitions, from the first on, are the policy's with noise."""
    course = Course.segment(scene, (0,), 0)
    config = parse(segment, "--preset", "paper", *TINY).learn
    trainer = segment_trainer(course, config, 0)
    monkeypatch.setattr(trainer.env.simulations.episodes, "guidance_action", lambda: 1 / 0)
    for _ in trainer.run():
        pass
    trainer.close()
    assert trainer.learner.updates == config.updates


def test_the_last_policy_is_flown_if_wanted(scene, monkeypatch):
    """Whatever its evaluation; the average of past actors is not evaluated at rate 0."""
    course = Course.segment(scene, (0,), 0)
    last = {"flown": "last", "average_rate": 0.0}
    small = LearnConfig(
        updates=24, extra_updates=0, envs=4, batch=8, width=8, demonstrations=64, eval_every=8,
        eval_episodes=2, actor_delay=0,
    )  # fmt: skip
    trainer = segment_trainer(course, dataclasses.replace(small, **last), 0)
    evaluated = []
    evaluate = Evaluator.__call__

    def record(self, policy):
        evaluated.append(policy.actor)
        return evaluate(self, policy)

    monkeypatch.setattr(Evaluator, "__call__", record)
    for _ in trainer.run():
        pass
    trainer.close()
    assert trainer.best_update == 24
    assert evaluated == [trainer.learner.actor] * 3  # none before learning
    for name, value in trainer.learner.actor.state_dict().items():
        assert torch.equal(trainer.best_policy[name], value)
