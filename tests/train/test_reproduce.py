"""`python -m train.reproduce`: resume, errors, outputs; mostly with a stub in place of flights."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from mjcollect.guidance.travel_times import travel_times
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import verify
from train import reproduce
from train.reproduction import prepare, running
from train.reproduction.plan import Sizes, first_items, random_scenes
from train.support.run_folder import RunFolder

STUB = """
import json, os, pathlib, sys
words = dict(zip(sys.argv[1::2], sys.argv[2::2]))
order = [int(item) for item in words["--order"].split(",")]
out = pathlib.Path(words["--out"])
out.mkdir(parents=True, exist_ok=True)
with open(os.environ["STUB_LOG"], "a") as log:
    log.write(out.name + "\\n")
if os.environ.get("STUB_FAILS", "none") in out.name:
    sys.exit("this one fails")
(out / "path_3d.png").write_bytes(b"")
segments = [{"lower_bound": 9.0, "time": 10.0, "updates": None}] * (len(order) + 1)
result = {"order": order, "success": True, "mission_time": 10.0 * len(segments),
          "lower_bound": 9.0 * len(segments), "bound_method": "b", "ratio": 10 / 9,
          "detour_time": 9.5 * len(segments), "contacts": 0, "violations": [],
          "segments": segments, "train_seconds": None, "versions": {}}
(out / "mission.json").write_text(json.dumps(result))
"""
CELLS = ["scenario_1-guidance-0.2.1.3", "scenario_1-guidance-2.3.0.1",
         "scenario_2-guidance-0.3.1.2", "scenario_2-guidance-1.3.2.0"]  # fmt: skip


def use_stub(folder):
    """Fly every cell by a stub that notes it in `folder`/log."""
    (folder / "flight_stub.py").write_text(STUB)
    sys.path.insert(0, str(folder))
    os.environ["STUB_LOG"] = str(folder / "log")

    def arguments_of(cell, scene, mission, keep):
        order = ",".join(map(str, cell.order))
        return "flight_stub", ("--scene", str(scene), "--order", order)

    running.arguments_of = arguments_of
    reproduce.QUICK = replace(reproduce.QUICK, instances=100)


@pytest.fixture
def stub(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("STUB_LOG", "")
    monkeypatch.setattr(running, "arguments_of", running.arguments_of)
    monkeypatch.setattr(reproduce, "QUICK", reproduce.QUICK)
    use_stub(tmp_path)
    return tmp_path


def arguments(out, *more):
    flown = ["--parts", "scenarios", "--planners", "guidance", "--workers", "1"]
    return ["--quick", "--out", str(out), *flown, *more]


def flown(folder):
    return sorted((folder / "log").read_text().split())


def test_flies_counts_and_tidies(stub):
    out = stub / "out"
    assert reproduce.main(arguments(out)) == 0
    assert flown(stub) == CELLS
    doc = json.loads((out / "results.json").read_text())
    assert sorted(doc["cells"]) == CELLS
    assert doc["tables"]["scenarios"]["scenario_1"][0]["time"]["mean"] == 50.0
    assert not any("path_3d.png" in names for _, _, names in os.walk(out / "cells"))
    assert str(out) not in doc["command"]
    assert "scenario_1" in (out / "reproduction.md").read_text()
    assert (out / "savings.png").stat().st_size > 10_000
    assert doc["machines"][0]["cpus"] == os.cpu_count()
    # A finished folder: refused, gone on with at no cost, or begun anew.
    assert reproduce.main(arguments(out)) == 2
    assert reproduce.main(arguments(out, "--resume")) == 0
    assert flown(stub) == CELLS
    assert reproduce.main(arguments(out, "--overwrite")) == 0
    assert flown(stub) == sorted(2 * CELLS)


def test_an_error_is_named_and_the_rest_flown(stub, monkeypatch, capsys):
    out = stub / "out"
    monkeypatch.setenv("STUB_FAILS", CELLS[1])
    assert reproduce.main(arguments(out)) == 1
    message = capsys.readouterr().err
    assert f"error: {CELLS[1]}: exit code 1: this one fails" in message
    doc = json.loads((out / "results.json").read_text())
    assert list(doc["errors"]) == [CELLS[1]]
    assert sorted(doc["cells"]) == [CELLS[0], *CELLS[2:]]
    assert CELLS[1] in (out / "reproduction.md").read_text()
    monkeypatch.delenv("STUB_FAILS")
    assert reproduce.main(arguments(out, "--resume")) == 0
    assert flown(stub) == sorted([*CELLS, CELLS[1]])


def test_ctrl_c_is_130_and_resumed(stub, monkeypatch):
    out, tidy = stub / "out", running.tidy

    def interrupt(*cell):
        tidy(*cell)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(running, "tidy", interrupt)
    assert reproduce.main(arguments(out)) == 130
    assert not (out / "results.json").exists()
    monkeypatch.setattr(running, "tidy", tidy)
    before = set(flown(stub))
    assert reproduce.main(arguments(out, "--resume")) == 0
    assert sorted(json.loads((out / "results.json").read_text())["cells"]) == CELLS
    assert len(before) < len(CELLS)


def test_killed_after_a_cell_goes_on_with_the_others(stub):
    """SIGKILL right after the first cell, before it is tidied: nothing is flown twice."""
    out = stub / "out"
    script = f"""
import os, pathlib, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_reproduce import arguments, reproduce, running, use_stub
use_stub(pathlib.Path({str(stub)!r}))
def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)
running.tidy = die
reproduce.main(arguments({str(out)!r}))
"""
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    (first,) = [path.parent.name for path in (out / "cells").glob("*/mission.json")]
    assert (out / "cells" / first / "path_3d.png").exists()
    assert reproduce.main(arguments(out, "--resume")) == 0
    log = (stub / "log").read_text().split()
    assert log.count(first) == 1
    assert set(log) == set(CELLS)
    assert not (out / "cells" / first / "path_3d.png").exists()
    assert sorted(json.loads((out / "results.json").read_text())["cells"]) == CELLS


def test_a_cell_alone_is_flown_and_judged(tmp_path, monkeypatch):
    """No stub: the first cell of the sweep by its name."""
    monkeypatch.setattr(reproduce, "QUICK", replace(reproduce.QUICK, instances=100))
    out = tmp_path / "out"
    name = "sweep_1-guidance-0"
    assert reproduce.main(["--quick", "--only", name, "--out", str(out)]) == 0
    doc = json.loads((out / "results.json").read_text())
    scene = first_items(Scene.find("sweep_8"), 1)
    flight = Trajectory.load(out / "cells" / name / "trajectory.csv")
    assert verify(scene, flight, (0,)) == []
    assert doc["cells"][name]["success"]
    assert doc["cells"][name]["mission_time"] == flight.duration
    assert list(doc["cells"]) == [name]
    assert doc["tables"]["sweep"][0]["items"] == 1
    assert (out / "sweep.png").stat().st_size > 10_000
    kept = {path.name for path in (out / "cells" / name).iterdir()}
    assert {"mission.json", "trajectory.csv"} <= kept <= set(running.KEPT)


def test_time_orders_are_computed_once(tmp_path, monkeypatch):
    monkeypatch.setattr(prepare, "importing_pool", ThreadPoolExecutor)
    folder, sizes = RunFolder(tmp_path), Sizes(floating=1, city=0, items=3)
    assert prepare.time_orders(folder, sizes, 1, compute=False) == {}
    found = prepare.time_orders(folder, sizes, 1, compute=True)
    ((label, scene),) = random_scenes(sizes).items()
    assert found == {label: plan_order(scene, "lkh", cost=travel_times(scene))}
    monkeypatch.setattr(prepare, "importing_pool", None)
    assert prepare.time_orders(folder, sizes, 1, compute=True) == found
    assert prepare.time_orders(folder, replace(sizes, items=2), 1, compute=False) == {}


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--workers", "0"], "--workers: 0"),
        (["--seed", "-1"], "--seed: -1"),
        (["--items", "13"], "--items: 13"),
        (["--training-seeds", "0"], "--training-seeds: 0"),
        (["--floating", "-1"], "--floating: -1"),
        (["--parts"], "--parts"),
        (["--only", "scenario_9-mpc-0"], "--only: scenario_9-mpc-0"),
        (["--only", "scenario_1-mpc-0.1.2"], "--only: scenario_1-mpc-0.1.2"),
        (["--only", "scenario_1-policy-0.1.2.3"], "--only: scenario_1-policy-0.1.2.3"),
        (["--only", "scenario_1-mpc-0.1.2.3-seed1"], "--only: scenario_1-mpc"),
        (["--resume", "--overwrite"], "--overwrite"),
        (["--mission-arguments", "it's"], "--mission-arguments: it's"),
        (["--against", "nowhere.json"], "--against: nowhere.json"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, capsys, more, named):
    out = tmp_path / "out"
    assert reproduce.main(["--quick", "--out", str(out), *more]) == 2
    assert named in capsys.readouterr().err
    assert not out.exists()


def test_flights_are_compared_with_another_run(stub, capsys):
    first, second = stub / "first", stub / "second"
    assert reproduce.main(arguments(first)) == 0
    results = first / "results.json"
    only = ["--quick", "--workers", "1", "--only", *CELLS[:2], "--out", str(second)]
    assert reproduce.main([*only, "--against", str(results)]) == 0
    assert "2 of 2 flights as in" in capsys.readouterr().out
    doc = json.loads(results.read_text())
    doc["cells"][CELLS[1]]["mission_time"] = 49.8
    results.write_text(json.dumps(doc))
    assert reproduce.main([*only, "--resume", "--against", str(results)]) == 1
    out = capsys.readouterr().out
    assert f"differs: {CELLS[1]}: mission_time 50.0, there 49.8" in out
    assert "1 of 2 flights as in" in out
    assert reproduce.main([*only, "--resume", "--against", str(stub / "log")]) == 2
    assert "--against" in capsys.readouterr().err


def test_another_training_is_not_resumed(stub, capsys):
    out = stub / "out"
    assert reproduce.main(arguments(out)) == 0
    other = arguments(out, "--resume", "--mission-arguments=--updates 200")
    assert reproduce.main(other) == 2
    assert "training" in capsys.readouterr().err
    assert flown(stub) == CELLS
