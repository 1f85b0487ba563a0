"""The program that shares items among UAVs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mjcollect.generate.place import VEHICLES
from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners.assignment import tour_time
from mjcollect.scene.bounds import leg_time
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


def test_items_nearer_to_a_wall_than_the_body_can_be_are_shared_too(tmp_path, capsys):
    """It comes to rest beside them, within epsilon."""
    wall = [[[40.0, 0.0, 0.0], [44.0, 60.0, 50.0]]]
    beside = 44.0 + 0.3  # behind the wall, seen from the depot; a body of 0.6 m
    made = Scene(
        "beside", 0, np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 60.0]]), [10.0, 20.0, 5.0],
        [[beside, 20.0, 5.0], [beside, 30.0, 5.0], [20.0, 90.0, 5.0]], wall,
        **VEHICLES["delivery"].limits,
    )  # fmt: skip
    made.save(tmp_path / "beside.json")
    assert assign.main(["--scene", str(tmp_path / "beside.json"), "--uavs", "2", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert sorted(map(sorted, said["tours"])) == [[0, 1], [2]]
    cost = travel_times(made)
    # Round the wall's end at y = 60, or over its top at z = 50: no shorter than the first.
    ways = [np.hypot(34.3, 40.0) + 40.0, np.hypot(30.0, 45.0) + 45.0]
    assert cost[0, 1] > leg_time(min(ways) - 2 * 1.5 - 2.0, 15.0, 5.0)
    assert cost[0, 1] < leg_time(min(ways) + 8.0, 15.0, 5.0)


def test_it_prints_each_uav_s_depot(tmp_path, capsys):
    scene = replace(Scene.find("city_6"), more_depots=[[1000.0, 1000.0, 0.0]])
    scene.save(tmp_path / "two.json")
    assert assign.main(["--scene", str(tmp_path / "two.json"), "--uavs", "3", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["depots"] == [0, 1, 0]
    cost = travel_times(scene, 2)
    pairs = zip(said["tours"], said["depots"], strict=True)
    assert said["times"] == pytest.approx([tour_time(cost, tour, home, 2) for tour, home in pairs])
    assert said["lower_bound"] <= said["makespan"] == max(said["times"])
    assert assign.main(["--scene", str(tmp_path / "two.json"), "--uavs", "3"]) == 0
    table = capsys.readouterr().out
    assert "| depot |" in table.splitlines()[0]
    assert table.splitlines()[3].endswith("| 1 |")
