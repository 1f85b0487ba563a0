"""The program `python -m train.segment`, mostly in this process and with a tiny budget."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.envs.recording import fly, fly_law
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.scene.bounds import segment_bound
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory, load_shield
from mjcollect.verify import verify
from train.segment import main

TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 40 --extra-updates 0 --envs 8 --batch 16 --buffer 1000 --width 8 "
    "--demonstrations 64 --eval-every 20 --eval-episodes 2 --threads 1 --no-video"
).split()
FILES = {
    "config.json", "command.txt", "scene.json", "segment.json", "trajectory.csv", "path_3d.png",
    "path_top.png", "learning.png", "metrics.csv", "policy.pt", "checkpoint", "shield.csv",
    "replay.html",
}  # fmt: skip
KEYS = {
    "scene", "segment", "order", "from", "to", "time", "lower_bound", "ratio", "detour_time",
    "success", "success_rate", "contacts", "violations", "train_seconds", "env_steps", "updates",
    "seed", "versions", "shield_share", "law_time", "mpc_time", "best_mean_time",
    "last_mean_time", "last_success_rate",
}  # fmt: skip


def run(scene_file, out, *more):
    return main(["--scene", str(scene_file), "--out", str(out), *TINY, *more])


@pytest.fixture(scope="module")
def finished(scene_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "one"
    code = run(scene_file, out)
    return out, code


def test_leaves_the_files_of_the_contract(finished):
    out, code = finished
    assert {path.name for path in out.iterdir()} == FILES
    result = json.loads((out / "segment.json").read_text())
    assert set(result) == KEYS
    assert code == (0 if result["success"] else 1)
    assert (result["success"] is True) == (result["violations"] == [])
    assert Scene.load(out / "scene.json").name == "hop"


def test_default_segment_is_the_first_blocked_one(finished):
    result = json.loads((finished[0] / "segment.json").read_text())
    assert (result["order"], result["segment"]) == ([0, 1], 1)
    assert (result["from"], result["to"]) == (0, 1)


def test_result_agrees_with_its_trajectory(finished, scene_file):
    out, _ = finished
    result = json.loads((out / "segment.json").read_text())
    scene, flown = Scene.load(scene_file), Trajectory.load(out / "trajectory.csv")
    found = verify(scene, flown, result["order"], segment=result["segment"])
    assert [violation.to_dict() for violation in found] == result["violations"]
    assert result["lower_bound"] == pytest.approx(segment_bound(scene, 0, 1))
    if result["success"]:
        assert result["time"] == pytest.approx(flown.duration)
        assert result["ratio"] == pytest.approx(flown.duration / result["lower_bound"])
    else:
        assert result["time"] is None
        assert result["ratio"] is None


def test_same_seed_same_trajectory(finished, scene_file, tmp_path):
    run(scene_file, tmp_path / "again")
    run(scene_file, tmp_path / "other", "--seed", "1")
    again, other, first = (
        (folder / "trajectory.csv").read_bytes()
        for folder in (tmp_path / "again", tmp_path / "other", finished[0])
    )
    assert again == first != other


def test_starts_from_a_policy_and_stops_at_once_if_it_is_good_enough(
    pupil_file, scene_file, tmp_path
):
    weights = ["--policy", str(pupil_file), "--width", "64", "--gap", "60"]
    out = tmp_path / "out"
    assert run(scene_file, out, *weights) == 0
    result = json.loads((out / "segment.json").read_text())
    assert (result["updates"], result["env_steps"]) == (0, 0)
    course = Course.segment(Scene.load(scene_file), (0, 1), 1)
    policy = TrainedPolicy.load(pupil_file)
    own = fly(course, [policy], policy.observation)
    flown = Trajectory.load(out / "trajectory.csv")
    for name in ("t", "x", "v", "a"):
        np.testing.assert_array_equal(getattr(flown, name), getattr(own.trajectory, name))
    assert result["time"] == own.trajectory.duration
    # The only evaluation is the best and the last; it beats nothing.
    assert result["best_mean_time"] == result["last_mean_time"]
    assert (result["success_rate"], result["last_success_rate"]) == (1.0, 1.0)
    assert result["law_time"] == fly_law(course).trajectory.duration
    assert result["law_time"] <= result["time"]
    assert 0.0 < result["mpc_time"] <= result["law_time"] + 0.2
    assert run(scene_file, out, *weights, "--resume") == 0
    assert run(scene_file, out, "--resume") == 2  # other weights: none


def test_without_plots_the_mpc_does_not_fly(scene_file, tmp_path, monkeypatch):
    monkeypatch.setattr("train.segment.Mpc", lambda _: 1 / 0)
    run(scene_file, tmp_path / "out", "--no-plots")
    result = json.loads((tmp_path / "out" / "segment.json").read_text())
    assert result["mpc_time"] is None
    assert result["law_time"] > 0.0


def test_the_share_of_slots_is_that_of_the_recorded_flight(finished, scene_file, tmp_path):
    """Against the flight flown again; without the shield there is none, and it may crash."""
    course = Course.segment(Scene.load(scene_file), (0, 1), 1)
    for name, shield in (("with", True), ("without", False)):
        out = tmp_path / name
        run(scene_file, out, *([] if shield else ["--no-shield"]), "--no-plots")
        policy = TrainedPolicy.load(out / "policy.pt")
        own = fly(course, [policy], policy.observation, shield=shield)
        result = json.loads((out / "segment.json").read_text())
        assert result["shield_share"] == own.shield_share == np.mean(own.shielded)
        assert (result["shield_share"] > 0.0) == shield
        when = load_shield(out / "shield.csv")
        assert np.ptp(when, axis=1).sum() == pytest.approx(sum(own.shielded) * 0.2)
        config = json.loads((out / "config.json").read_text())
        assert config["learn"]["shield"] is shield


def test_resume_of_a_finished_run_prints_its_result(finished, scene_file, capsys):
    out, code = finished
    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    assert run(scene_file, out, "--resume") == code
    assert "success" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in out.iterdir()}


def test_full_folder_is_refused_then_overwritten(finished, scene_file, tmp_path, capsys):
    out = tmp_path / "run"
    run(scene_file, out)
    stamp = (out / "segment.json").stat().st_mtime_ns
    assert run(scene_file, out) == 2
    assert "not empty" in capsys.readouterr().err
    assert (out / "segment.json").stat().st_mtime_ns == stamp
    assert run(scene_file, out, "--overwrite") == finished[1]
    assert (out / "segment.json").stat().st_mtime_ns > stamp


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--segment", "3"], "segment: 3: must be 0 to 2"),
        (["--segment", "-1"], "segment: -1: must be 0 to 2"),
        (["--order", "0,0"], "order"),
        (["--order", "best"], "order"),
        (["--seed", "-1"], "seed: -1"),
        (["--noise-max", "0.001"], "noise_max"),
        (["--noise-max", "nan"], "noise_max"),
        (["--alpha-actor", "nan"], "alpha_actor"),
        (["--alpha-critic", "-1"], "alpha_critic"),
        (["--alpha-target", "2"], "alpha_target"),
        (["--demonstrations", "1001"], "buffer"),
        (["--device", "cuda"], "cuda"),
    ],
)
def test_bad_arguments_name_the_field_and_write_nothing(
    scene_file, tmp_path, capsys, more, message
):
    import torch

    if "cuda" in more and torch.cuda.is_available():
        pytest.skip("there is a CUDA device here")
    assert run(scene_file, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"name": "x"}'])
def test_bad_scene_exits_2(tmp_path, capsys, text):
    scene = tmp_path / "bad.json"
    scene.write_text(text)
    assert run(scene, tmp_path / "out") == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not (tmp_path / "out").exists()


def start(scene_file, out, *more, environment=None):
    return subprocess.Popen(
        [sys.executable, "-m", "train.segment", "--scene", scene_file, "--out", out, *TINY, *more],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )


def wait_for(path, process):
    while not path.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def test_ctrl_c_saves_and_resume_equals_one_go(scene_file, tmp_path):
    """Stopped by Ctrl-C, then killed, then resumed: the same flight as without."""
    budget = ["--updates", "400", "--checkpoint-every", "40"]
    whole, out = tmp_path / "whole", tmp_path / "out"
    run(scene_file, whole, *budget)
    process = start(scene_file, out, *budget)
    wait_for(out / "metrics.csv", process)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=120)
    if process.returncode == 130:  # not already through
        assert "--resume" in error
        assert "Traceback" not in error
        assert not (out / "segment.json").exists()
        process = start(scene_file, out, *budget, "--resume")
        time.sleep(2.0)
        process.kill()
        process.communicate()
    run(scene_file, out, *budget, "--resume")
    for name in ("trajectory.csv", "metrics.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name


def test_needs_no_display_and_no_gl(scene_file, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MUJOCO_GL")}
    process = start(scene_file, tmp_path / "out", environment=environment)
    output, error = process.communicate(timeout=120)
    assert process.returncode in (0, 1), error
    assert re.match(r"(no )?success", output)
    assert "Warning" not in error


@pytest.mark.slow
def test_default_run_is_near_the_detour_time(tmp_path):
    """What `make run` does, without its video."""
    assert main(["--out", str(tmp_path / "run"), "--no-video"]) == 0
    result = json.loads((tmp_path / "run" / "segment.json").read_text())
    assert result["success_rate"] == 1.0
    assert result["time"] <= 1.15 * result["detour_time"]
    flown = Trajectory.load(tmp_path / "run" / "trajectory.csv")
    assert np.max(np.linalg.norm(flown.v, axis=1)) <= 50.0 + 1e-6
