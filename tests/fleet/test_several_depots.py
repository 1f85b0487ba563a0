"""Fleets from several depots: places of their own, flights, verdicts."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from fleet_yard import YARD

import mjcollect
from mjcollect.fleet.episode import courses
from mjcollect.fleet.share import parts
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import TourError
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify_fleet
from train import fly
from train.fleets.fly import finished_fleet, share_scene

TWO = replace(YARD, name="two", more_depots=[[180, 20, 30]])


def test_each_uav_has_a_place_at_its_own_depot():
    found = parts(TWO, [(0,), (1,), (2,), (3,)])
    for uav, part in enumerate(found):
        away = float(np.linalg.norm(part.depot - TWO.depots[uav % 2]))
        assert 0 < away <= TWO.return_tolerance - part.return_tolerance + 1e-9
        assert "more_depots" not in part.to_dict()
        assert Scene.from_json(json.dumps(part.to_dict())) == part
    for one in (0, 1):
        gap = np.linalg.norm(found[one].depot - found[one + 2].depot)
        assert gap >= TWO.apart + 2 * found[one].return_tolerance - 1e-9
    single = parts(TWO, [(0, 1), (2, 3)])
    assert [part.depot.tolist() for part in single] == TWO.depots.tolist()
    assert {part.return_tolerance for part in single} == {TWO.return_tolerance}
    other = parts(TWO, [(0, 1), (2, 3)], [1, 0])
    assert [part.depot.tolist() for part in other] == TWO.depots[::-1].tolist()


def test_without_more_depots_places_are_as_ever():
    alone, empty = parts(YARD, [(0,), (1,)]), parts(YARD, [(0,), (1,)], [0, 0])
    assert [part.to_dict() for part in alone] == [part.to_dict() for part in empty]


def test_a_uav_without_items_keeps_its_depot_from_the_others():
    flown = courses(TWO, [(), (0, 1), (), (2, 3)])
    for course in flown:
        assert np.linalg.norm(course.scene.depot - TWO.depots[1]) <= TWO.return_tolerance
    named = mjcollect.fleet_courses(TWO, 3, [(2, 3), (), (0, 1)])
    for course in named:
        assert np.linalg.norm(course.scene.depot - TWO.depots[0]) <= TWO.return_tolerance


def test_depots_whose_uavs_could_meet_at_rest_are_refused():
    near = replace(TWO, more_depots=[[60, 40, 41.9]])
    with pytest.raises(SceneError, match=r"more_depots\[0\]: .* 11.9 m from one at depot.*move it"):
        parts(near, [(0, 1), (2, 3)])
    parts(near, [(0, 1, 2, 3)])  # A single UAV meets none.
    parts(replace(TWO, more_depots=[[60, 40, 42.0]]), [(0, 1), (2, 3)])
    narrow = replace(TWO, separation=9.0)
    with pytest.raises(SceneError, match=r"6 UAVs .* find no room within it at more_depots\[0\]"):
        parts(replace(narrow, items=[[160, 60, 30]] * 6), [(item,) for item in range(6)], [1] * 6)


@pytest.mark.parametrize("depots", [[0], [0, 2], [0, -1]])
def test_depots_that_are_not_there_are_refused(depots):
    with pytest.raises(TourError, match=r"depots: .*: must be 2, one for each tour, from 0 to 1"):
        courses(TWO, [(0, 1), (2, 3)], depots)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two UAVs fly from two depots by the law."""
    folder = tmp_path_factory.mktemp("depots")
    TWO.save(folder / "two.json")
    args = ["--scene", str(folder / "two.json"), "--planner", "guidance", "--uavs", "2"]
    assert fly.main([*args, "--no-video", "--out", str(folder / "run")]) == 0
    return folder / "run"


def test_a_fleet_from_two_depots_flies_and_is_verified(run):
    result = json.loads((run / "fleet.json").read_text())
    assert result["success"]
    assert verify_fleet(run) == []
    assert result["lower_bound"] <= result["makespan"]
    assert [mission["depot"] for mission in result["missions"]] == [0, 1]
    for mission in result["missions"]:
        part = Scene.load(run / mission["folder"] / "scene.json")
        assert part.depot.tolist() == TWO.depots[mission["depot"]].tolist()
    assert "| depot |" in (run / "report.md").read_text()
    again, _ = finished_fleet(run, TWO)
    assert again.depots == (0, 1)
    assert [c.scene.to_dict() for c in again.courses] == [
        c.scene.to_dict() for c in share_scene(TWO, 2, 0).courses
    ]


def test_those_at_home_take_their_depot_with_them():
    """Both items are beside the second depot: UAV 0 does not fly, and UAV 1 is the only one."""
    scene = replace(TWO, items=[[175, 25, 30], [185, 15, 30]])
    sharing = share_scene(scene, 2, 0)
    assert (len(sharing.tours), sharing.depots) == (1, (1,))
    assert sharing.courses[0].scene.depot.tolist() == scene.depots[1].tolist()


@pytest.mark.parametrize(
    ("depot", "told"), [([60, 40, 33], 0), ([180, 20, 30], 0), ([120, 60, 20], None), (None, 7)]
)
def test_a_part_at_a_wrong_depot_is_refused(run, tmp_path, depot, told):
    broken = tmp_path / "run"
    shutil.copytree(run, broken)
    own = broken / "uavs/0/scene.json"
    document, result = json.loads(own.read_text()), json.loads((broken / "fleet.json").read_text())
    document["depot"] = depot or document["depot"]
    result["missions"][0]["depot"] = told
    own.write_text(json.dumps(document))
    (broken / "fleet.json").write_text(json.dumps(result))
    with pytest.raises(ValueError, match="is no part of"):
        verify_fleet(broken)


def test_a_part_has_no_further_depots(run, tmp_path):
    broken = tmp_path / "run"
    shutil.copytree(run, broken)
    own = broken / "uavs/0/scene.json"
    document = json.loads(own.read_text()) | {"more_depots": TWO.more_depots.tolist()}
    own.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="is no part of"):
        verify_fleet(broken)
