"""What a replay's page holds, and which runs are refused."""

from __future__ import annotations

import json
import os
import re
import shutil

import numpy as np
import pytest
from fleet_runs import TOURS
from replay_runs import scene_with, write_mission

from mjcollect.render.runs import UnreadableRun, load_run
from mjcollect.replay.__main__ import main
from mjcollect.replay.page import distinct_names, write_replay
from mjcollect.replay.payload import COLUMNS, decoded
from mjcollect.scene.air import Air
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from train.__main__ import main as mjcollect_main


def shown(*folders, tmp_path) -> dict:
    """The document inside a written page, read as a browser reads it."""
    write_replay(folders, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    start = '<script id="data" type="application/json">'
    assert text.count(start) == 1
    return json.loads(text.split(start)[1].split("</script>")[0])


def test_the_flight_comes_back_from_the_page(mission, tmp_path):
    (run,) = shown(mission, tmp_path=tmp_path)["runs"]
    (flight,) = run["flights"]
    rows = decoded(flight["rows"], COLUMNS).astype(float)
    truth = Trajectory.load(mission / "trajectory.csv")
    assert np.diff(rows[:, 0]).max() <= 0.05 + 1e-6
    assert len(rows) < 0.6 * len(truth)
    np.testing.assert_allclose(rows[[0, -1], 0], truth.t[[0, -1]], atol=1e-5)
    for axis in range(3):
        # At any time, by straight lines between the rows: far below what can be seen.
        again = np.interp(truth.t, rows[:, 0], rows[:, 1 + axis])
        np.testing.assert_allclose(again, truth.x[:, axis], atol=0.01)
        speeds = np.interp(truth.t, rows[:, 0], rows[:, 4 + axis])
        np.testing.assert_allclose(speeds, truth.v[:, axis], atol=0.3)
    assert rows[-1, 7] == pytest.approx(truth.length, rel=1e-6)
    assert flight["length"] == pytest.approx(truth.length)


def test_stops_have_the_times_of_the_flight(mission, tmp_path):
    (flight,) = shown(mission, tmp_path=tmp_path)["runs"][0]["flights"]
    truth, scene = Trajectory.load(mission / "trajectory.csv"), Scene.load(mission / "scene.json")
    assert [stop["node"] for stop in flight["stops"]] == [0, 1, -1]
    for stop in flight["stops"]:
        row = np.searchsorted(truth.t, stop["t"] - 1e-9)
        np.testing.assert_allclose(truth.x[row], scene.point(stop["node"]), atol=1e-6)
        assert not truth.v[row].any()
    assert flight["shield"] == [[1.0, 1.4]]
    assert flight["duration"] == flight["stops"][-1]["t"]  # exactly: it has come home then


def test_boxes_come_back_from_the_page(mission, tmp_path):
    part = shown(mission, tmp_path=tmp_path)["scene"]
    scene, rows = Scene.load(mission / "scene.json"), decoded(part["boxes"], 7)
    np.testing.assert_allclose(rows[:, :3] - rows[:, 3:6] / 2, scene.obstacles[:, 0])
    np.testing.assert_allclose(rows[:, :3] + rows[:, 3:6] / 2, scene.obstacles[:, 1])
    assert rows[:, 6].tolist() == [0.0, 30.0]
    assert part["noFly"] == [1]


def test_a_segment_says_what_was_collected_before(tmp_path):
    folder = write_mission(tmp_path / "leg", (1, 0), segment=1)
    (run,) = shown(folder, tmp_path=tmp_path)["runs"]
    assert run["kind"] == "segment"
    assert run["flights"][0]["before"] == [1]
    assert [stop["node"] for stop in run["flights"][0]["stops"]] == [0]


def test_a_fleet_has_every_uav_with_the_numbers_of_the_whole_scene(fleet, tmp_path):
    (run,) = shown(fleet, tmp_path=tmp_path)["runs"]
    assert [flight["name"] for flight in run["flights"]] == ["UAV 0", "UAV 1", "UAV 2"]
    tours = [[*tour, -1] for tour in TOURS]
    assert [[s["node"] for s in flight["stops"]] for flight in run["flights"]] == tours
    assert len({flight["colour"] for flight in run["flights"]}) == 3


def test_what_moved_in_disturbed_air_is_shown(moving, tmp_path):
    folder = write_mission(tmp_path / "windy")
    Air(0, np.array([3.0, 0, 4]), 1.0, 0.0, (moving,), 0.2, np.zeros((0, 3))).save(
        folder / "air.json"
    )
    (run,) = shown(folder, tmp_path=tmp_path)["runs"]
    assert run["moving"] == [json.loads(json.dumps(moving.to_dict()))]
    assert run["wind"] == [3.0, 0.0, 4.0]


def test_two_runs_in_one_page(mission, other, tmp_path):
    runs = shown(mission, other, tmp_path=tmp_path)["runs"]
    assert [run["name"] for run in runs] == ["first", "second"]
    assert [run["success"] for run in runs] == [True, False]
    assert runs[1]["caption"] == "CONTACT at 2.50 s"
    assert runs[1]["violations"] == [{"t": 2.5, "text": "CONTACT at 2.50 s"}]
    assert runs[0]["colour"] != runs[1]["colour"]


def test_no_name_ends_the_script_that_it_stands_in(tmp_path):
    folder = write_mission(tmp_path / "@@data@@<!--<script>")
    document = shown(folder, tmp_path=tmp_path)
    assert document["runs"][0]["name"] == "@@data@@<!--<script>"
    assert document["scene"]["name"] == "yard </script>"
    text = (tmp_path / "page.html").read_text()
    assert len(re.findall("<script", text)) == 3
    assert len(re.findall("</script>", text)) == 3
    assert "<title>@@data@@&lt;!--&lt;script&gt; · yard &lt;/script&gt;</title>" in text


def test_the_page_is_whole_and_carries_the_licence(mission, tmp_path):
    shown(mission, tmp_path=tmp_path)
    text = (tmp_path / "page.html").read_text()
    assert "three.js authors" in text
    assert "Permission is hereby granted" in text
    assert not re.search(r"""(src|href)=["'](?!data:)""", text)
    assert "@@" not in text
    assert not list(tmp_path.glob(".part-*"))


def test_names_tell_folders_apart(tmp_path):
    folders = [tmp_path / "a" / "run", tmp_path / "b" / "run", tmp_path / "b" / "other"]
    assert distinct_names(folders) == ["a/run", "b/run", "b/other"]


# The command


def test_the_command_writes_beside_the_run_and_never_over(mission, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(mission, folder)
    assert mjcollect_main(["replay", str(folder)]) == 0
    page = folder / "replay.html"
    assert capsys.readouterr().out.strip() == str(page)
    page.write_text("mine")
    assert main([str(folder)]) == 2
    assert "exists; add --overwrite" in capsys.readouterr().err
    assert page.read_text() == "mine"
    assert main([str(folder), "--overwrite"]) == 0
    assert page.read_text() != "mine"


def test_several_runs_need_a_file(mission, other, tmp_path, capsys):
    assert main([str(mission), str(other)]) == 2
    assert "error: --out: is missing" in capsys.readouterr().err
    assert main([str(mission), str(other), "--out", str(tmp_path / "new" / "two.html")]) == 0
    assert (tmp_path / "new" / "two.html").is_file()
    assert main([str(mission), str(mission), "--out", str(tmp_path / "same.html")]) == 2
    assert "first: is given twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"items": [[180.0, 20.0, 40.0]]}, "items has 1 entries, not 2"),
        ({"yaw": [0.0, 31.0]}, r"obstacles\[1\] is .*'yaw': 31.0.*, not .*'yaw': 30.0.*"),
        ({"no_fly": []}, r"obstacles\[\d\] is .*, not .*'no_fly': True.*"),
    ],
)
def test_runs_of_different_scenes_are_refused(mission, tmp_path, capsys, fields, said):
    scene = scene_with(**fields)
    folder = write_mission(tmp_path / "there", range(len(scene.items)), scene)
    assert main([str(mission), str(folder), "--out", str(tmp_path / "two.html")]) == 2
    error = capsys.readouterr().err
    assert re.match(f"error: there: was flown in another scene than first: {said}; only", error)
    assert not (tmp_path / "two.html").exists()


def test_other_limits_are_no_other_scene(mission, tmp_path):
    folder = write_mission(tmp_path / "slow", scene=scene_with(v_max=51.0, epsilon=4.0))
    assert main([str(mission), str(folder), "--out", str(tmp_path / "two.html")]) == 0


def test_what_is_no_run_is_refused_with_what_is_missing(mission, tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "holds neither segment.json nor mission.json nor fleet.json" in capsys.readouterr().err
    folder = tmp_path / "run"
    shutil.copytree(mission, folder)
    (folder / "trajectory.csv").unlink()
    assert main([str(folder), "--overwrite"]) == 2
    assert "trajectory.csv" in capsys.readouterr().err
    with pytest.raises(UnreadableRun, match="FileNotFoundError"):
        load_run(folder)


@pytest.mark.parametrize(
    "field",
    [
        '"violations": null', '"violations": {"t": 1}', '"violations": [{"t": 1.0}]',
        '"lower_bound": NaN', '"lower_bound": Infinity',
    ],
)  # fmt: skip
def test_a_damaged_result_is_refused(mission, tmp_path, capsys, field):
    folder = tmp_path / "run"
    shutil.copytree(mission, folder)
    text = (folder / "mission.json").read_text().rstrip().removesuffix("}")
    (folder / "mission.json").write_text(text + f", {field}}}")
    assert main([str(folder), "--overwrite"]) == 2
    assert "not a readable run" in capsys.readouterr().err


def test_a_folder_whose_name_is_no_text_has_a_replay(mission, tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    shutil.copytree(mission, folder)
    assert main([str(folder), "--overwrite"]) == 0
    assert "caf\ufffd" in (folder / "replay.html").read_text(encoding="utf-8")
