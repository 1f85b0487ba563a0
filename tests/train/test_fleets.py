"""`python -m train.fly` and `train.mission` with several UAVs, in a narrow hall."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from traffic import pair_gaps

from mjcollect.planners.fleet_bound import fleet_bound
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify_fleet, verify_run
from mjcollect.verify.__main__ import main as verify_main
from train.fly import main as fly
from train.mission import main as mission

BOUNDS = [[0.0, 0, 0], [200, 24, 24]]
DEPOT = [100.0, 12, 12]
ITEMS = [[20.0, 6, 6], [180, 6, 18], [40, 18, 18]]
BOXES = [[[60.0, 0, 0], [64, 14, 24]], [[140.0, 10, 0], [144, 24, 24]]]
MOVER = {"size": [4, 4, 4], "path": [[30, 2, 3], [30, 20, 3]], "speed": 2.0}
KEYS = {
    "scene", "uavs", "order_method", "success", "makespan", "lower_bound", "bound_method", "ratio",
    "separation", "separation_limit", "violations", "planner", "missions", "seed", "versions",
}  # fmt: skip
MISSION_KEYS = {
    "uav", "folder", "items", "success", "mission_time", "lower_bound", "shield_share",
    "made_room_share", "ended",
}  # fmt: skip
QUIET = ["--no-video", "--no-plots"]
TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 4 --extra-updates 0 --envs 4 --batch 16 --buffer 1000 --width 8 --u2 2 "
    "--demonstrations 16 --eval-every 4 --eval-episodes 1 --threads 1 --checkpoint-every 4 "
    "--policy none --retries 0"
).split()


def made(**fields) -> Scene:
    whole = {"items": ITEMS, "obstacles": BOXES} | fields
    return Scene(name="hall", seed=0, bounds=BOUNDS, depot=DEPOT, **whole)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def hall_file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("scene") / "hall.json"
    made().save(path)
    return str(path)


@pytest.fixture(scope="module")
def flown(hall_file, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("flown") / "run"
    arguments = ["--scene", hall_file, "--uavs", "2", "--planner", "guidance", *QUIET]
    assert fly([*arguments, "--out", str(out)]) == 0
    return out


def result_of(run: Path) -> dict:
    return json.loads((run / "fleet.json").read_text())


def tracks_of(run: Path) -> list[Trajectory]:
    return [
        Trajectory.load(run / entry["folder"] / "trajectory.csv")
        for entry in result_of(run)["missions"]
    ]


def check_result(run: Path, uavs: int = 2) -> dict:
    """fleet.json has every key, and agrees with the recorded flights."""
    result, tracks = result_of(run), tracks_of(run)
    assert set(result) == KEYS
    assert [set(entry) for entry in result["missions"]] == [MISSION_KEYS] * uavs
    scene = Scene.load(run / "scene.json")
    gaps = []
    for one, other in combinations([track.x for track in tracks], 2):
        rows = max(len(one), len(other))
        rest = (np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)]) for x in (one, other))
        gaps.append(pair_gaps(*rest).min())
    assert result["separation"] == pytest.approx(min(gaps), abs=1e-9)
    assert result["separation_limit"] == scene.apart
    bound, method = fleet_bound(scene, result["uavs"])
    assert (result["lower_bound"], result["bound_method"]) == (pytest.approx(bound), method)
    visited = [item for entry in result["missions"] for item in entry["items"]]
    assert sorted(visited) == list(range(len(scene.items)))
    found = verify_fleet(run)
    kinds = [entry["kind"] for entry in result["violations"]]
    assert sorted(kinds) == sorted(str(each.to_dict()["kind"]) for each in found)
    assert result["success"] == (not found)
    if result["success"]:
        assert result["makespan"] == max(track.duration for track in tracks)
        assert result["ratio"] == pytest.approx(result["makespan"] / bound)
        assert result["ratio"] >= 1.0
        for entry, track in zip(result["missions"], tracks, strict=True):
            assert (entry["success"], entry["ended"]) == (True, "home")
            assert entry["mission_time"] == track.duration
            assert verify_run(run / entry["folder"]) == []
            assert 0.0 <= entry["made_room_share"] < 1.0
            assert 0.0 <= entry["shield_share"] < 1.0
    return result


# Flights


def test_a_fleet_flies_by_the_law(flown, capsys):
    result = check_result(flown)
    assert result["success"]
    assert (result["scene"], result["uavs"], result["planner"]) == ("hall", 2, "guidance")
    assert sorted(tuple(sorted(entry["items"])) for entry in result["missions"]) == [(0, 2), (1,)]
    places = [Scene.load(flown / "uavs" / str(uav) / "scene.json").depot for uav in (0, 1)]
    np.testing.assert_array_equal([track.x[0] for track in tracks_of(flown)], places)
    assert {path.name for path in flown.iterdir()} == {
        "command.txt", "config.json", "fleet.json", "replay.html", "report.md", "scene.json",
        "uavs",
    }  # fmt: skip
    report = (flown / "report.md").read_text()
    assert f"**{result['makespan']:.1f} s**" in report
    assert "uavs/1/mission.json" in report
    assert ".png" not in report
    assert verify_main([str(flown)]) == 0
    assert capsys.readouterr().out == "no rule is broken\n"


def test_a_run_flies_again_alike_and_is_drawn(flown, tmp_path, capsys):
    again = ["--run", str(flown), "--planner", "guidance", "--no-video"]
    assert fly([*again, "--out", str(tmp_path / "again")]) == 0
    assert "success: 3 items by 2 UAVs in" in capsys.readouterr().out
    for name in ("uavs/0/trajectory.csv", "uavs/1/trajectory.csv", "uavs/0/scene.json"):
        assert (tmp_path / "again" / name).read_bytes() == (flown / name).read_bytes(), name
    ours, theirs = result_of(tmp_path / "again"), result_of(flown)
    assert ours == theirs
    drawn = [f"{kind}.png" for kind in ("path_3d", "path_top", "schedule")]
    mine = [f"uavs/{uav}/{kind}.png" for uav in (0, 1) for kind in ("path_3d", "path_top", "speed")]
    for name in drawn + mine:
        with Image.open(tmp_path / "again" / name) as image:
            assert np.asarray(image.convert("RGB")).std() > 10, name
    report = (tmp_path / "again" / "report.md").read_text()
    assert all(f"({name})" in report for name in drawn)


@pytest.mark.parametrize("planner", ["mpc", "policy"])
def test_a_fleet_flies_by_other_planners(hall_file, tmp_path, planner):
    arguments = ["--scene", hall_file, "--uavs", "2", "--planner", planner, "--finetune", "0"]
    assert fly([*arguments, *QUIET, "--out", str(tmp_path / "run")]) == 0
    result = check_result(tmp_path / "run")
    assert (result["success"], result["planner"]) == (True, planner)


def test_uavs_without_items_stay_at_home(tmp_path, capsys):
    """Two items are for two UAVs at most."""
    made(items=ITEMS[:2], obstacles=[]).save(tmp_path / "two.json")
    arguments = ["--scene", str(tmp_path / "two.json"), "--uavs", "5", "--planner", "guidance"]
    assert fly([*arguments, *QUIET, "--out", str(tmp_path / "run")]) == 0
    assert check_result(tmp_path / "run")["uavs"] == 5
    assert "2 items by 2 UAVs" in capsys.readouterr().out


@pytest.fixture(scope="module")
def hostile(tmp_path_factory) -> str:
    """Two UAVs have to be at two items at the same time that are nearer than they keep apart."""
    scene = made(items=[[180.0, 12, 12], [20, 12, 12]], obstacles=[], separation=6.0)
    items = DEPOT + np.array([[40.0, 0, 0], [39.9, 3, 0]])
    path = tmp_path_factory.mktemp("hostile") / "hostile.json"
    replace(scene, items=items, epsilon=0.5).save(path)
    return str(path)


@pytest.fixture(scope="module")
def crashed(hostile, tmp_path_factory) -> tuple[Path, int]:
    out = tmp_path_factory.mktemp("crashed") / "run"
    arguments = ["--scene", hostile, "--uavs", "2", "--planner", "guidance", "--no-shield", *QUIET]
    return out, fly([*arguments, "--out", str(out)])


def test_a_crash_without_the_shield_is_code_1_and_says_why(crashed, capsys):
    run, code = crashed
    assert code == 1
    result = check_result(run)
    assert (result["success"], result["makespan"], result["ratio"]) == (False, None, None)
    assert result["separation"] < result["separation_limit"]
    (met,) = [entry for entry in result["violations"] if entry["kind"] == "separation"]
    assert met["uavs"] == [0, 1]
    report = (run / "report.md").read_text()
    assert "**No success.**" in report
    assert "separation of UAV 0 and UAV 1 at" in report
    assert verify_main([str(run)]) == 1
    assert "of UAVs 0 and 1, limit 6" in capsys.readouterr().out


def test_no_moving_box_is_blamed_where_there_is_none(crashed):
    ended = {entry["ended"] for entry in result_of(crashed[0])["missions"]}
    assert "moving box" not in ended


def test_with_the_shield_the_same_fleet_comes_home(hostile, tmp_path):
    arguments = ["--scene", hostile, "--uavs", "2", "--planner", "guidance", *QUIET]
    assert fly([*arguments, "--out", str(tmp_path / "run")]) == 0
    result = check_result(tmp_path / "run")
    assert result["separation"] >= 2.0 - 1e-6
    assert max(entry["shield_share"] for entry in result["missions"]) > 0


# Refusals


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--uavs", "0"], "--uavs: 0: must be at least 1"),
        (["--uavs", "-2"], "--uavs: -2: must be at least 1"),
        (["--wind", "3"], "--wind: 3.0: is for one UAV"),
        (["--mover", "3"], "--mover: 3.0: is for one UAV"),
        (["--flights", "5"], "--flights: 5: is for one UAV"),
        (["--guidance-cache", "there"], "--guidance-cache: there: is for one UAV"),
        (["--planner", "reference"], "--planner: reference: its plan is made for one UAV"),
        (["--order", "random"], "--order: random: several UAVs share the items"),
        (["--seed", "-1"], "--seed: -1: must not be negative"),
        (["--policy", "shipped", "--planner", "mpc"], "--policy: shipped"),
        (["--policy", "nowhere.pt"], "nowhere.pt"),
        (["--scene", "nowhere.json"], "nowhere.json"),
    ],
)
def test_what_several_cannot_have_is_refused(hall_file, tmp_path, capsys, arguments, message):
    whole = ["--scene", hall_file, "--uavs", "2", *arguments, *QUIET]
    assert fly([*whole, "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_boxes_that_move_are_refused(tmp_path, capsys):
    made(moving=[MOVER]).save(tmp_path / "moving.json")
    arguments = ["--scene", str(tmp_path / "moving.json"), "--uavs", "2", *QUIET]
    assert fly([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert "--uavs: 2: moving: 1 boxes" in capsys.readouterr().err
    assert mission([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert "moving: 1 boxes" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("program", [fly, mission])
def test_more_than_the_depot_has_room_for_are_refused(tmp_path, capsys, program):
    items = [[x, 12.0, z] for x in (20, 60, 140, 180) for z in (4, 20)]
    made(items=items, obstacles=[], return_tolerance=1.2).save(tmp_path / "small.json")
    arguments = ["--scene", str(tmp_path / "small.json"), "--uavs", "30", *QUIET]
    assert program([*arguments, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert re.search(r"return_tolerance: 1\.2: \d UAVs that keep 2 m apart find no room", error)
    assert "take fewer UAVs" in error
    assert not (tmp_path / "run").exists()


def test_a_folder_with_a_flight_is_not_overwritten_unasked(hall_file, flown, capsys):
    arguments = ["--scene", hall_file, "--uavs", "2", "--planner", "guidance", *QUIET]
    before = (flown / "fleet.json").read_bytes()
    assert fly([*arguments, "--out", str(flown)]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert (flown / "fleet.json").read_bytes() == before


def test_a_run_that_does_not_fit_is_refused(flown, tmp_path, capsys):
    """It has no policies; and one mission is no fleet."""
    assert fly(["--run", str(flown), *QUIET, "--out", str(tmp_path / "run")]) == 2
    assert "policy.pt: is missing" in capsys.readouterr().err
    single = flown / "uavs" / "0"
    assert fly(["--run", str(single), "--uavs", "2", *QUIET, "--out", str(tmp_path / "run")]) == 2
    assert "holds no fleet.json" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("flag", "value"), [("--uavs", "3"), ("--scene", "scenario_1")])
def test_flags_that_contradict_the_run_are_refused(flown, tmp_path, capsys, flag, value):
    again = ["--run", str(flown), "--planner", "guidance", *QUIET, flag, value]
    assert fly([*again, "--out", str(tmp_path / "run")]) == 2
    assert flag in capsys.readouterr().err


# Training


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, list[str], int]:
    folder = tmp_path_factory.mktemp("trained")
    made(items=ITEMS[:2], obstacles=[]).save(folder / "two.json")
    arguments = ["--scene", str(folder / "two.json"), "--uavs", "2", *TINY, *QUIET]
    arguments += ["--out", str(folder / "run")]
    return folder / "run", arguments, mission(arguments)


def test_every_segment_of_every_uav_is_learned_and_all_fly(trained):
    run, _, code = trained
    result = check_result(run)
    assert code == (0 if result["success"] else 1)
    assert result["planner"] == "policy"
    seeds = set()
    for uav in (0, 1):
        for segment in (0, 1):
            own = run / "uavs" / str(uav) / "segments" / str(segment)
            assert (own / "policy.pt").is_file()
            seeds.add(json.loads((own / "config.json").read_text())["seed"])
    assert len(seeds) == 4
    assert not list(run.glob("**/guidance"))


def test_a_finished_training_resumes_to_the_same_result(trained, capsys):
    run, arguments, code = trained
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert mission([*arguments, "--resume"]) == code
    after = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert after == before
    assert str(run.name) in capsys.readouterr().out
    assert mission([*arguments, "--resume", "--seed", "5"]) == 2
    assert "seed" in capsys.readouterr().err


def test_its_policies_fly_again_alike(trained, tmp_path):
    run, _, code = trained
    assert fly(["--run", str(run), *QUIET, "--out", str(tmp_path / "again")]) == code
    for uav in (0, 1):
        name = f"uavs/{uav}/trajectory.csv"
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--uavs", "0"], "--uavs: 0: must be at least 1"),
        (["--uavs", "2", "--order", "exact"], "--order: exact: several UAVs share the items"),
    ],
)
def test_training_refuses_what_several_cannot_have(hall_file, tmp_path, capsys, arguments, message):
    whole = ["--scene", hall_file, *arguments, *TINY, *QUIET, "--out", str(tmp_path / "run")]
    assert mission(whole) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
