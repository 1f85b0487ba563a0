"""`python -m train.fly` in disturbed air, in a small room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mjcollect.learning.policy import TrainedPolicy
from mjcollect.scene.air import Air
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify_run
from train.fly import main as fly
from train.mission import main as train_mission
from train.segment import main as train_segment

AIR = ["--wind", "3", "--gusts", "1", "--gain", "0.1", "--delay", "0.04", "--noise", "0.2"]
FILES = ("mission.json", "trajectory.csv", "shield.csv", "air.json", "tracks.png", "report.md")
MOVER = {"size": [10, 10, 10], "path": [[95, 10, 15], [95, 40, 15]], "speed": 5.0}


@pytest.fixture(scope="module")
def law(scene_file, tmp_path_factory) -> list[str]:
    cache = str(tmp_path_factory.mktemp("guidance"))
    return [
        "--scene", str(scene_file), "--planner", "guidance", "--order", "0,1", "--no-video",
        "--guidance-cache", cache,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def windy(law, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("windy") / "run"
    assert fly([*law, *AIR, "--flights", "8", "--out", str(out)]) == 0
    return out


def test_mission_json_says_how_all_flights_went(windy, capsys) -> None:
    result = json.loads((windy / "mission.json").read_text())
    assert result["flights"] == 8
    assert result["disturbance"]["wind"] == 3.0
    for name in ("success_rate", "contact_rate", "mean_time", "gave_way"):
        measure = result[name]
        assert measure["low"] <= measure["value"] <= measure["high"]
    assert list(result["ended"]) == [
        "home", "standing box", "moving box", "out of bounds", "too late",
    ]  # fmt: skip
    assert sum(result["ended"].values()) == 8
    assert result["success_rate"]["value"] == result["ended"]["home"] / 8
    assert result["success"]
    assert result["violations"] == []
    assert [s["success"] for s in result["segments"]] == [True] * 3
    assert Air.load(windy / "air.json").flight == result["shown_flight"]
    report = (windy / "report.md").read_text()
    assert "| came home with everything |" in report
    assert "(tracks.png)" in report
    with Image.open(windy / "tracks.png") as image:
        assert np.asarray(image.convert("RGB")).std() > 10


def test_the_same_seed_gives_the_same_bytes(law, windy, tmp_path) -> None:
    assert fly([*law, *AIR, "--flights", "8", "--out", str(tmp_path / "again")]) == 0
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (windy / name).read_bytes(), name


def test_the_run_is_accepted_and_one_shifted_into_a_box_is_not(windy, tmp_path) -> None:
    assert verify_run(windy) == []
    run = tmp_path / "run"
    run.mkdir()
    for name in ("mission.json", "scene.json", "trajectory.csv", "air.json"):
        (run / name).write_bytes((windy / name).read_bytes())
    assert verify_run(run) == []
    flown, air = Trajectory.load(run / "trajectory.csv"), Air.load(run / "air.json")
    x = flown.x.copy()
    x[len(x) // 2 :] += [95, 90, 15] - x[len(x) // 2]
    replace(flown, x=x).save(run / "trajectory.csv")
    assert "contact" in {violation.kind for violation in verify_run(run)}
    flown.save(run / "trajectory.csv")
    x, y, z = flown.x[len(flown) // 2]
    path = ((x + 3, y, z), (x - 3, y, z))
    replace(air, moving=(MovingBox((2, 2, 2), path, 1.0),)).save(run / "air.json")
    assert {violation.kind for violation in verify_run(run)} == {"contact"}


def test_moving_boxes_of_the_scene_file_are_flown_once_if_the_air_is_calm(
    scene_file, law, tmp_path
) -> None:
    moving = tmp_path / "moving.json"
    replace(Scene.load(scene_file), moving=[MOVER]).save(moving)
    code = fly([*law, "--scene", str(moving), "--out", str(tmp_path / "run"), "--no-plots"])
    result = json.loads((tmp_path / "run" / "mission.json").read_text())
    assert code == (0 if result["ended"]["home"] else 1)
    assert result["flights"] == 1
    assert [box.to_dict() for box in Air.load(tmp_path / "run" / "air.json").moving] == [MOVER]
    assert (verify_run(tmp_path / "run") == []) == result["success"]


def test_a_finished_run_flies_with_a_policy_for_each_segment(pupil_file, windy, tmp_path) -> None:
    run, out = tmp_path / "trained", tmp_path / "run"
    policy = TrainedPolicy.load(pupil_file)
    for segment in range(3):
        own = run / "segments" / str(segment)
        own.mkdir(parents=True)
        (own / "scene.json").write_bytes((windy / "scene.json").read_bytes())
        policy.save(own / "policy.pt")
    for name in ("mission.json", "scene.json"):
        (run / name).write_bytes((windy / name).read_bytes())
    (run / "config.json").write_text('{"learn": {"shield": true}}')
    arguments = ["--run", str(run), "--wind", "1", "--flights", "3", "--no-video", "--no-plots"]
    code = fly([*arguments, "--out", str(out)])
    result = json.loads((out / "mission.json").read_text())
    assert code == (0 if result["ended"]["home"] else 1)
    assert (result["flights"], result["planner"], result["order"]) == (3, "policy", [0, 1])
    assert not (out / "tracks.png").exists()


def test_mpc_flies_one_by_one(law, tmp_path) -> None:
    out = tmp_path / "run"
    arguments = ["--planner", "mpc", "--wind", "1", "--flights", "2", "--no-plots"]
    fly([*law, *arguments, "--out", str(out)])
    result = json.loads((out / "mission.json").read_text())
    assert (result["flights"], result["planner"]) == (2, "mpc")
    assert json.loads((out / "config.json").read_text())["shield"] is True


def test_no_flight_at_home_is_code_1(law, tmp_path, capsys) -> None:
    out = tmp_path / "run"
    assert fly([*law, "--wind", "60", "--flights", "2", "--out", str(out)]) == 1
    result = json.loads((out / "mission.json").read_text())
    assert result["mean_time"] == {"value": None, "low": None, "high": None}
    assert not result["success"]
    assert "0 of 2 flights came home" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--wind", "-1"], "wind: -1.0: must be 0 or more"),
        (["--gain", "1"], "gain: 1.0: must be from 0 to below 1"),
        (["--flights", "0"], "--flights: 0: must be at least 1"),
        (["--mover", "5", "--boxes", "0"], "boxes: 0"),
        (["--mover", "5"], "--mover: 5: no segment is 200 m long"),
        (["--planner", "reference", "--wind", "1"], "--planner: reference: its plan is flown"),
        (["--planner", "reference", "--flights", "3"], "--planner: reference: its plan is flown"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(
    law, tmp_path, capsys, arguments, message
) -> None:
    assert fly([*law, *arguments, "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("program", [train_mission, train_segment])
def test_learning_among_moving_boxes_is_refused(scene_file, tmp_path, capsys, program) -> None:
    moving = tmp_path / "moving.json"
    replace(Scene.load(scene_file), moving=[MOVER]).save(moving)
    assert program(["--scene", str(moving), "--out", str(tmp_path / "run")]) == 2
    assert "moving: 1 boxes: only train.fly flies among" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
