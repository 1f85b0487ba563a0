"""The program that shares items among UAVs."""

from __future__ import annotations

import json

import pytest

from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners.assignment import tour_time
from mjcollect.scene.scene import Scene
from train import assign


def test_it_prints_who_collects_what(capsys):
    assert assign.main(["--scene", "city_6", "--uavs", "2", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    scene = Scene.find("city_6")
    cost = travel_times(scene)
    assert sorted(item for tour in said["tours"] for item in tour) == list(range(len(scene.items)))
    assert said["times"] == pytest.approx([tour_time(cost, tour) for tour in said["tours"]])
    assert said["lower_bound"] <= said["makespan"] == max(said["times"])
    assert said["makespan"] < said["one_uav"] <= sum(said["times"]) + 1e-9
    assert assign.main(["--scene", "city_6", "--uavs", "2"]) == 0
    table = capsys.readouterr().out
    assert " ".join(map(str, said["tours"][0])) in table
    assert f"home after {said['makespan']:.1f} s" in table


def test_what_cannot_be_shared_is_refused(capsys):
    assert assign.main(["--scene", "city_6", "--uavs", "0"]) == 2
    assert "uavs: 0: must be at least 1" in capsys.readouterr().err
    assert assign.main(["--scene", "nowhere.json"]) == 2
    assert "nowhere.json" in capsys.readouterr().err
