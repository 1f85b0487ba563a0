"""Exports are read back: places on Earth, free straight legs, and formats as published."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod

from mjcollect.envs.recording import fly_law
from mjcollect.export.__main__ import main
from mjcollect.export.formats import FORMATS
from mjcollect.export.maps import CSV_HEADER, GX, KML
from mjcollect.export.mission import ExportError, FlownMission
from mjcollect.export.plan import plan
from mjcollect.export.waypoints import thin
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.scene.place import Origin
from mjcollect.verify import verify
from train import fly
from train.support.mission_report import mission_result

HOME = Origin(31.3, 120.6, 4.0)


@pytest.fixture(scope="module")
def mission(mission_course):
    flight = fly_law(mission_course)
    order = (0, 1)
    result = mission_result(mission_course, order, "given", flight, [None] * 3, 0, None)
    assert not verify(mission_course.scene, flight.trajectory, order)
    scene = dataclasses.replace(mission_course.scene, origin=HOME)
    return FlownMission.of(scene, flight.trajectory, result)


def metres(places):
    """Places (n, 3) as metres east, north and up of HOME, by geodesics: no projection is asked."""
    out = []
    for latitude, longitude, altitude in places:
        bearing, _, far = Geod(ellps="WGS84").inv(
            HOME.longitude, HOME.latitude, longitude, latitude
        )
        angle = np.radians(bearing)
        out.append([far * np.sin(angle), far * np.cos(angle), altitude - HOME.altitude])
    return np.array(out)


def legs_are_free(points, scene, clear):
    for start, end in itertools.pairwise(points):
        steps = np.linspace(0, 1, 2 + int(np.linalg.norm(end - start) / 0.05))[:, None]
        for point in start + steps * (end - start):
            if np.any(point_box_distance(point, scene.obstacles) < clear):
                return False
    return True


def test_the_plan_read_back_flies_free_through_all_items_and_home(mission):
    document = json.loads(FORMATS["plan"](mission))
    items = document["mission"]["items"]
    home = document["mission"]["plannedHomePosition"]
    places = [
        [item["params"][4], item["params"][5], item["params"][6] + home[2]]
        for item in items
        if item["frame"] == 3
    ]
    points, scene = metres(places), mission.scene
    assert legs_are_free(points, scene, scene.uav_radius - 1e-3)
    for node in range(len(scene.items)):
        near = np.linalg.norm(points - scene.items[node], axis=1) <= scene.epsilon + 1e-3
        assert near.any()
    np.testing.assert_allclose(points[[0, -1], :2], [scene.depot[:2]] * 2, atol=1e-3)
    assert points[0, 2] == pytest.approx(scene.depot[2] + 2.5)  # it climbs at take-off
    assert points[-1, 2] == pytest.approx(scene.depot[2])
    held = [item for item in items if item["command"] == 16 and item["params"][0] > 0]
    assert len(held) == len(scene.items)
    # The flown path is nowhere farther from the legs than what is stated.
    for point in mission.trajectory.x[:: scene.substeps]:
        legs = [(scene.depot, points[1]), *itertools.pairwise(points)]
        assert min(distance(point, a, b) for a, b in legs) <= 0.5 + 1e-3
    assert len(items) < len(mission.trajectory) / 20


def distance(point, start, end):
    share = np.clip(
        (point - start) @ (end - start) / max((end - start) @ (end - start), 1e-9), 0, 1
    )
    return float(np.linalg.norm(point - start - share * (end - start)))


def test_the_plan_has_the_keys_and_types_that_qgroundcontrol_publishes(mission):
    document = json.loads(FORMATS["plan"](mission))
    assert (document["fileType"], document["version"]) == ("Plan", 1)
    assert document["groundStation"] == "QGroundControl"
    head = document["mission"]
    wanted = {"version", "firmwareType", "vehicleType", "cruiseSpeed", "hoverSpeed", "items"}
    assert wanted | {"plannedHomePosition", "globalPlanAltitudeMode"} == set(head)
    assert head["version"] == document["geoFence"]["version"] == 2
    assert document["rallyPoints"] == {"version": 2, "points": []}
    for number, item in enumerate(head["items"], start=1):
        assert (item["type"], item["doJumpId"]) == ("SimpleItem", number)
        assert len(item["params"]) == 7
        assert item["autoContinue"] is True
        if item["frame"] == 3:
            assert item["params"][6] == item["Altitude"]
    assert [item["command"] for item in head["items"]][:2] == [22, 178]
    assert head["items"][-1]["command"] == 21
    speeds = [item["params"][1] for item in head["items"] if item["command"] == 178]
    assert 1 <= min(speeds) < max(speeds) <= mission.scene.v_max
    (fence,) = document["geoFence"]["polygons"]
    assert fence["inclusion"] is True
    assert len(fence["polygon"]) == 4
    assert plan(mission, cross_track=5.0)["mission"]["items"] != head["items"]


def test_geojson_kml_and_csv_show_the_same_flight(mission):
    scene, rows = mission.scene, mission.rows
    flown = mission.trajectory.x[rows]
    features = json.loads(FORMATS["geojson"](mission))["features"]
    line = np.array(features[0]["geometry"]["coordinates"])[:, [1, 0, 2]]
    np.testing.assert_allclose(metres(line), flown, atol=1e-3)
    kinds = [feature["properties"]["kind"] for feature in features]
    assert kinds == ["flight", "depot", "item", "item"] + ["obstacle"] * len(scene.obstacles)
    for feature, box in zip(features[4:], scene.obstacles, strict=True):
        ring = np.array(feature["geometry"]["coordinates"][0])
        np.testing.assert_array_equal(ring[0], ring[-1])
        area = np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
        assert area > 0  # counterclockwise, RFC 7946
        corners = metres(np.c_[ring[:, [1, 0]], np.full(5, HOME.altitude)])[:, :2]
        np.testing.assert_allclose(corners.min(axis=0), box[0, :2], atol=1e-3)
        np.testing.assert_allclose(corners.max(axis=0), box[1, :2], atol=1e-3)
    root = ElementTree.fromstring(FORMATS["kml"](mission))
    track = root.find(f".//{{{GX}}}Track")
    coords = np.array([[float(n) for n in c.text.split()] for c in track.iter(f"{{{GX}}}coord")])
    np.testing.assert_allclose(metres(coords[:, [1, 0, 2]]), flown, atol=0.2)
    whens = [when.text for when in track.iter(f"{{{KML}}}when")]
    assert len(whens) == len(coords)
    assert whens == sorted(whens)
    assert len(list(root.iter(f"{{{KML}}}Polygon"))) == len(scene.obstacles)
    lines = list(csv.DictReader(FORMATS["csv"](mission).splitlines()))
    assert ",".join(lines[0]) == CSV_HEADER
    places = np.array([[float(row[k]) for k in CSV_HEADER.split(",")[1:4]] for row in lines])
    np.testing.assert_allclose(metres(places), flown, atol=1e-2)


@settings(deadline=None)
@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 3), min_size=2, max_size=40), st.floats(0.1, 20))
def test_thinned_paths_keep_their_ends_and_stay_as_near_as_asked(points, off):
    path = np.array(points)
    box = np.array([[[-5.0, -5, -5], [5, 5, 5]]])
    kept = thin(path, [len(path) // 2], box, 0.5, off)
    assert {0, len(path) // 2, len(path) - 1} <= set(kept.tolist())
    for first, last in itertools.pairwise(kept):
        if last - first > 1:
            for point in path[first + 1 : last]:
                assert distance(point, path[first], path[last]) <= off + 1e-9
            steps = np.linspace(0, 1, 200)[:, None]
            leg = path[first] + steps * (path[last] - path[first])
            assert np.all(np.linalg.norm(np.maximum(np.abs(leg) - 5, 0), axis=1) >= 0.5 - 1e-9)


def test_the_program_writes_files_and_refuses_what_is_no_mission_of_a_place(
    free_scene, tmp_path, capsys
):
    scene, run = tmp_path / "scene.json", tmp_path / "run"
    dataclasses.replace(free_scene, origin=HOME).save(scene)
    flags = ["--planner", "guidance", "--no-video", "--no-plots"]
    assert fly.main(["--scene", str(scene), "--out", str(run), *flags]) == 0
    assert {"mission.plan", "mission.kml", "mission.geojson"} <= {p.name for p in run.iterdir()}
    json.loads((run / "mission.plan").read_text())
    capsys.readouterr()
    export = ["--run", str(run), "--format", "csv"]
    assert main(export) == 0
    assert main(export) == 2  # never overwritten silently
    assert "--overwrite" in capsys.readouterr().err
    assert main(["--run", str(tmp_path), "--format", "kml"]) == 2
    assert "mission.json" in capsys.readouterr().err
    free_scene.save(run / "scene.json")
    assert main([*export, "--overwrite"]) == 2
    assert "origin" in capsys.readouterr().err


def test_a_flight_that_failed_becomes_no_plan(mission):
    with pytest.raises(ExportError, match="success"):
        FlownMission.of(mission.scene, mission.trajectory, {"success": False})
