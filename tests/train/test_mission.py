"""`python -m train.mission` and `python -m train.fly`, with tiny budgets."""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

from mjcollect.learning.policy import NO_POLICY, SHIPPED, TrainedPolicy, policy_digest
from mjcollect.scene.bounds import mission_bound
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify
from train.fly import main as fly
from train.jobs.workers import Job
from train.mission import _from_policy, _keep_best
from train.mission import main as mission
from train.support.run_folder import RunFolder

TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 24 --extra-updates 0 --envs 8 --batch 16 --buffer 1000 --width 8 --u2 4 "
    "--demonstrations 64 --eval-every 8 --eval-episodes 2 --threads 1 --no-video "
    "--checkpoint-every 8 --policy none"
).split()
KEYS = {
    "scene", "order", "order_method", "success", "mission_time", "lower_bound", "bound_method",
    "ratio", "detour_time", "contacts", "violations", "segments", "train_seconds", "seed",
    "shield_share", "versions",
}  # fmt: skip
SEGMENT_KEYS = {
    "from", "to", "time", "lower_bound", "detour_time", "success", "success_rate",
    "train_seconds", "env_steps", "updates", "shield_share",
}  # fmt: skip
FILES = {
    "config.json", "command.txt", "scene.json", "mission.json", "trajectory.csv", "path_3d.png",
    "path_top.png", "learning.png", "speed.png", "segments", "report.md",
    "shield.csv", "replay.html",
}  # fmt: skip


def run(scene_file, out, *more):
    arguments = ["--scene", str(scene_file), "--out", str(out), *TINY, "--retries", "0", *more]
    return mission(arguments)


@pytest.fixture(scope="module")
def finished(scene_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "mission"
    return out, run(scene_file, out)


def test_leaves_the_files_of_the_contract(finished):
    out, code = finished
    result = json.loads((out / "mission.json").read_text())
    assert {path.name for path in out.iterdir()} == FILES
    assert set(result) == KEYS
    assert all(set(entry) == SEGMENT_KEYS for entry in result["segments"])
    assert [(e["from"], e["to"]) for e in result["segments"]] == [(-1, 0), (0, 1), (1, -1)]
    assert code == (0 if result["success"] else 1)
    assert 0.0 <= result["shield_share"] <= 1.0
    assert result["segments"][0]["shield_share"] is not None  # begun in any case
    assert {path.name for path in (out / "segments").iterdir()} == {"0", "1", "2"}


def test_result_agrees_with_its_trajectory(finished, scene_file):
    out, _ = finished
    result = json.loads((out / "mission.json").read_text())
    scene, flown = Scene.load(scene_file), Trajectory.load(out / "trajectory.csv")
    found = verify(scene, flown, result["order"])
    assert [violation.to_dict() for violation in found] == result["violations"]
    assert result["lower_bound"] == pytest.approx(mission_bound(scene)[0])
    assert result["success"] == (not found)


def test_same_result_with_other_workers_and_after_kills(finished, scene_file, tmp_path):
    """One worker, killed again and again with SIGKILL, flies what two undisturbed ones did."""
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "train.mission", "--scene", scene_file, "--out", out, *TINY]
    command += ["--retries", "0", "--workers", "1", "--resume"]
    for pause in (5.0, 9.0):
        process = subprocess.Popen(
            [str(part) for part in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(pause)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert run(scene_file, out, "--workers", "1", "--resume") == finished[1]
    for name in ("trajectory.csv", "segments/1/metrics.csv", "segments/2/trajectory.csv"):
        assert (out / name).read_bytes() == (finished[0] / name).read_bytes(), name


def test_ctrl_c_exits_130_after_saving(scene_file, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "train.mission", "--scene", scene_file, "--out", out, *TINY]
    process = subprocess.Popen(
        [str(part) for part in (*command, "--updates", "100000")],
        stderr=subprocess.PIPE,
        text=True,
    )
    while not list(out.glob("segments/*/metrics.csv")):
        assert process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert "--resume" in error
    assert "Traceback" not in error
    assert list(out.glob("segments/*/checkpoint"))


def test_an_imperfect_segment_is_trained_again(scene_file, tmp_path):
    out = tmp_path / "out"
    untaught = ("--updates", "4", "--demonstrations", "0")
    run(scene_file, out, "--retries", "1", *untaught)
    tried = sorted((out / "attempts").iterdir())
    assert tried[0].name == "0-0"  # four updates teach next to nothing
    for path in tried:
        result = json.loads((path / "segment.json").read_text())
        assert not result["success"] or result["success_rate"] < 1.0
    seeds = [json.loads(p.read_text())["seed"] for p in out.glob("*/0*/config.json")]
    assert len(set(seeds)) == 2
    assert json.loads((out / "mission.json").read_text())["success"] is False


def test_the_best_training_is_kept_however_often_it_is_asked(tmp_path):
    """Also where none is better than another, and after a stop between the two renames."""
    for name in ("segments/0", "attempts/0-0", "attempts/0-1"):
        (tmp_path / name).mkdir(parents=True)
        result = {"success": False, "success_rate": 0.0, "time": None, "name": name}
        (tmp_path / name / "segment.json").write_text(json.dumps(result))
    folder = RunFolder(tmp_path)

    def kept():
        _keep_best(folder, 0)
        return json.loads((tmp_path / "segments/0/segment.json").read_text())["name"]

    assert [kept(), kept()] == ["segments/0"] * 2
    better = {"success": True, "success_rate": 0.5, "time": 3.0, "name": "better"}
    (tmp_path / "attempts/0-1/segment.json").write_text(json.dumps(better))
    (tmp_path / "segments/0").rename(tmp_path / "attempts/0-2")
    assert [kept(), kept()] == ["better"] * 2


def test_a_training_without_a_result_is_not_repeated(scene_file, tmp_path, capsys, monkeypatch):
    """Python's exit code of an unforeseen error is 1 too."""
    monkeypatch.setattr("train.mission.Job", partial(Job, program="no_such_module"))
    assert run(scene_file, tmp_path / "out") == 1
    assert re.search(r"segment [01]: exit code 1", capsys.readouterr().err)  # whichever ended first


def test_items_within_reach_of_the_depot_have_no_ratio(tmp_path):
    scene = tmp_path / "near.json"
    Scene(
        name="near",
        seed=0,
        bounds=[[0, 0, 0], [20, 20, 20]],
        depot=[5, 5, 5],
        items=[[6, 5, 5]],
        obstacles=[],
    ).save(scene)
    law = ["--planner", "guidance", "--scene", str(scene), "--no-video"]
    assert fly([*law, "--out", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "mission.json").read_text())
    assert (result["lower_bound"], result["ratio"]) == (0.0, None)
    assert result["mission_time"] == pytest.approx(0.4)


def test_no_plots_if_not_wanted(scene_file, tmp_path):
    out = tmp_path / "out"
    law = ["--planner", "guidance", "--scene", str(scene_file), "--out", str(out), "--no-video"]
    fly([*law, "--no-plots"])
    assert not list(out.glob("*.png"))
    assert ".png" not in (out / "report.md").read_text()
    fly([*law, "--overwrite"])
    assert {path.name for path in out.glob("*.png")} == {"path_3d.png", "path_top.png", "speed.png"}
    assert "speed.png" in (out / "report.md").read_text()


@pytest.mark.parametrize(
    ("planner", "more", "shield"),
    [("guidance", [], True), ("guidance", ["--no-shield"], False), ("mpc", [], False)],
)
def test_planners_that_fly_without_the_shield_say_so(scene_file, tmp_path, planner, more, shield):
    out = tmp_path / "out"
    arguments = ["--planner", planner, "--scene", str(scene_file), "--out", str(out), *more]
    assert fly([*arguments, "--no-video", "--no-plots"]) == 0
    result = json.loads((out / "mission.json").read_text())
    assert json.loads((out / "config.json").read_text())["shield"] is shield
    assert result["shield_share"] == 0.0  # neither leaves it anything to do
    assert [entry["shield_share"] for entry in result["segments"]] == [0.0] * 3
    assert (out / "shield.csv").read_text() == "begin,end\n"


@pytest.mark.parametrize("shield", [True, False])
def test_a_run_learned_without_the_shield_is_flown_without(finished, tmp_path, shield):
    changed, out = tmp_path / "run", tmp_path / "out"
    shutil.copytree(finished[0], changed)
    config = json.loads((changed / "config.json").read_text())
    assert config["learn"]["shield"] is True
    config["learn"]["shield"] = shield
    (changed / "config.json").write_text(json.dumps(config))
    fly(["--run", str(changed), "--out", str(out), "--no-video", "--no-plots"])
    assert json.loads((out / "config.json").read_text())["shield"] is shield
    result = json.loads((out / "mission.json").read_text())
    assert (result["shield_share"] > 0.0) <= shield


def test_the_law_takes_no_credit_for_the_training(finished, tmp_path):
    fly(
        [
            "--run",
            str(finished[0]),
            "--planner",
            "guidance",
            "--out",
            str(tmp_path / "o"),
            "--no-video",
        ]
    )
    result = json.loads((tmp_path / "o" / "mission.json").read_text())
    assert result["train_seconds"] is None
    assert {entry["success_rate"] for entry in result["segments"]} == {None}


def test_fly_repeats_the_mission_exactly(finished, tmp_path):
    out, code = finished
    assert fly(["--run", str(out), "--out", str(tmp_path / "again"), "--no-video"]) == code
    again = tmp_path / "again"
    assert (again / "trajectory.csv").read_bytes() == (out / "trajectory.csv").read_bytes()
    result = json.loads((again / "mission.json").read_text())
    assert result.pop("planner") == "policy"
    assert result == json.loads((out / "mission.json").read_text())


def test_fly_refuses_another_scene_and_names_the_difference(finished, tmp_path, capsys):
    changed = tmp_path / "run"
    shutil.copytree(finished[0], changed)
    document = json.loads((changed / "scene.json").read_text())
    document["items"][1][0] = 121.0
    (changed / "scene.json").write_text(json.dumps(document))
    assert fly(["--run", str(changed), "--out", str(tmp_path / "out"), "--no-video"]) == 2
    error = capsys.readouterr().err
    assert "items[1]" in error
    assert "121.0" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("option", "value"), [("--order", "1,0"), ("--seed", "1")])
def test_fly_refuses_another_order_or_seed_than_the_run(finished, tmp_path, capsys, option, value):
    out = str(tmp_path / "out")
    assert fly(["--run", str(finished[0]), option, value, "--out", out]) == 2
    assert f"{option}: {value}: the run's is" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_difference_of_scenes_names_each_field():
    scene = Scene.find("scenario_1")
    assert scene.difference(Scene.find("scenario_1")) is None
    document = scene.to_dict()
    for field, value in document.items():
        if isinstance(value, int | float):
            other = Scene(**_arguments(document | {field: value * 1 + 1}, field))
            assert scene.difference(other).startswith(field)
            assert scene.difference(other, document.keys() - {field}) is None
    for key, value in (
        ("clearance", 0.5),
        ("separation", 3.0),
        ("more_depots", [[500.0, 0.0, 0.0]]),
    ):
        more = dataclasses.replace(scene, **{key: value})
        assert scene.difference(more).startswith(f"{key} is {value}, not left out")
        assert more.difference(scene) == f"{key} is left out, not {value}"


def _arguments(document, field):
    box = [document["bounds"]["min"], document["bounds"]["max"]]
    boxes = [[b["min"], b["max"]] for b in document["obstacles"]]
    if field == "slot":
        document["physics_step"] = 0.02
    if field == "physics_step":
        document["physics_step"] = 0.1
    return document | {"bounds": box, "obstacles": boxes}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--run"),
        (["--run", "nowhere"], "mission.json"),
        (["--scene", "nowhere.json", "--planner", "guidance"], "does not exist"),
    ],
)
def test_fly_says_what_is_missing(arguments, message, tmp_path, capsys):
    assert fly([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_guidance_law_flies_a_whole_mission(tmp_path):
    out = tmp_path / "out"
    code = fly(["--scene", "scenario_1", "--planner", "guidance", "--out", str(out), "--no-video"])
    result = json.loads((out / "mission.json").read_text())
    assert (code, result["success"], result["planner"]) == (0, True, "guidance")
    assert 1.0 <= result["ratio"] < 1.15
    assert np.isclose(sum(e["time"] for e in result["segments"]), result["mission_time"])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--workers", "0"], "workers"),
        (["--retries", "-1"], "retries"),
        (["--order", "exactly"], "order"),
        (["--updates", "0"], "updates"),
        (["--ray", "nonsense"], "ray"),
    ],
)
def test_bad_arguments_write_nothing(scene_file, tmp_path, capsys, more, message):
    assert run(scene_file, tmp_path / "out", *more) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_ray_gives_the_same_as_local_workers(finished, scene_file, tmp_path):
    pytest.importorskip("ray", reason="Ray is an optional extra")
    out = tmp_path / "out"
    assert run(scene_file, out, "--ray", "local") == finished[1]
    assert (out / "trajectory.csv").read_bytes() == (finished[0] / "trajectory.csv").read_bytes()


def begun(scene_file, out, *words):
    """Exit code, and the weights that a mission and its first segment began from."""
    arguments = ["--scene", str(scene_file), "--out", str(out), "--no-video", "--no-plots"]
    code = mission([*arguments, "--retries", "0", *words])
    config = json.loads((out / "config.json").read_text())
    segment = out / "segments" / "0" / "config.json"
    assert json.loads(segment.read_text())["policy"] == config["policy"]
    return code, config["policy"]


@pytest.mark.parametrize("pupil_file", ["robust"], indirect=True)
def test_starts_from_a_policy_if_one_is_given(scene_file, pupil_file, tmp_path):
    out = tmp_path / "out"
    few = ("--updates", "8", "--extra-updates", "0", "--eval-every", "8")
    own = ("--policy", str(pupil_file), "--observation", "robust", "--width", "64")
    code, weights = begun(scene_file, out, *few, *own)
    assert (code, weights) == (0, policy_digest(pupil_file))
    policies = [TrainedPolicy.load(path / "policy.pt") for path in (out / "segments").iterdir()]
    assert {(policy.observation, policy.width) for policy in policies} == {("robust", 64)}
    assert begun(scene_file, tmp_path / "scratch", *TINY)[1] is None


def test_starts_from_the_shipped_policy_unless_told_not_to(scene_file, tmp_path, capsys):
    """`--width 8` of TINY asks for another network, which says so and learns from nothing."""
    tiny = [word for word in TINY if word not in ("--policy", "none")]
    assert begun(scene_file, tmp_path / "tiny", *tiny)[1] is None
    assert "--width: 8: the policy of --policy shipped has 192" in capsys.readouterr().err
    few = ("--updates", "8", "--extra-updates", "0", "--eval-every", "8")
    out = tmp_path / "shipped"
    code, weights = begun(scene_file, out, *few, "--width", "192")
    assert (code, weights) == (0, policy_digest(SHIPPED))
    assert "from scratch" not in capsys.readouterr().err
    policies = [TrainedPolicy.load(path / "policy.pt") for path in (out / "segments").iterdir()]
    assert {(policy.observation, policy.width) for policy in policies} == {("path", 192)}


def test_a_cluster_has_the_shipped_policy_only(tmp_path, capsys):
    out = tmp_path / "out"
    assert mission(["--policy", "some.pt", "--out", str(out), "--ray", "local"]) == 2
    assert "--policy: some.pt: the nodes of --ray" in capsys.readouterr().err
    assert not out.exists()


def test_what_fails_with_the_policy_is_learned_anew():
    assert _from_policy(SHIPPED, 0) == ["--policy", str(SHIPPED)]
    assert _from_policy(SHIPPED, 1) == _from_policy(NO_POLICY, 0) == []
