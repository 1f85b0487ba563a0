"""Importing real places: every building becomes boxes where it stands, and nothing gets lost."""

from __future__ import annotations

import json

import numpy as np
import osmium
import pytest
import shapely
from pyproj import Geod

from mjcollect.generate import buildings
from mjcollect.generate.import_place import main
from mjcollect.generate.place import BESIDE
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.scene.place import Frame
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify_run
from train import fly

LAT, LON = 48.8584, 2.2945


def degrees(points):
    """Longitudes and latitudes of points (n, 2), metres east and north of the centre."""
    out = []
    for x, y in points:
        far, bearing = float(np.hypot(x, y)), float(np.degrees(np.arctan2(x, y)))
        lon, lat, _ = Geod(ellps="WGS84").fwd(LON, LAT, bearing, far)
        out.append([lon, lat])
    return out


def feature(rings, number=0, kind="Polygon", **properties):
    coordinates = [degrees([*ring, ring[0]]) for ring in rings]
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "id": f"b{number}", "properties": properties, "geometry": geometry}


def square(x, y, half, turn=0.0):
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    angle = np.radians(turn)
    turned = corners @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return (turned + np.array([x, y])).tolist()


L_SHAPE = [[-80.0, -80], [-40, -80], [-40, -65], [-60, -65], [-60, -40], [-80, -40]]
FEATURES = [
    feature([square(40, 40, 15, 30.0)], 0, height=25),
    feature([L_SHAPE], 1, **{"building:levels": "4"}),
    feature([square(60, -60, 20), square(60, -60, 10)[::-1]], 2, height="12.5 m", min_height=2),
    feature([[[-50.0, 40], [-30, 60], [-30, 40], [-50, 60]]], 3, height=9),  # a bow tie
    feature([square(0, 90, 8)], 4),  # no height; half outside of the square
    feature([square(300, 0, 8)], 5, height=9),
    {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [LON, LAT]}},
]


def collection(features=FEATURES, **more):
    return {"type": "FeatureCollection", "features": features} | more


@pytest.fixture
def run(tmp_path, capsys):
    """Imports a document or text; returns exit code, scene or None, and what was said."""

    def imported(document=None, *flags, name="map.geojson"):
        if not isinstance(document, bytes):
            text = document if isinstance(document, str) else json.dumps(document or collection())
            document = text.encode()
        (tmp_path / name).write_bytes(document)
        out = tmp_path / "scene.json"
        given = [str(tmp_path / name), "--center", str(LAT), str(LON), "--size", "180"]
        code = main([*given, "--random-items", "6", "--out", str(out), "--overwrite", *flags])
        said = capsys.readouterr()
        return code, Scene.load(out) if out.exists() else None, said.out + said.err

    return imported


def test_every_building_is_covered_where_it_stands(run):
    code, scene, said = run()
    assert code == 0
    assert "5 buildings in the square, 1 outside of it" in said
    assert "1 features are no areas" in said
    assert "repaired: b3" in said
    assert "1 without a height; they count as 10 m high" in said
    assert (scene.origin.latitude, scene.origin.longitude) == (LAT, LON)
    rng, frame = np.random.default_rng(0), Frame(scene.origin)
    heights = [(0, 25.0), (0, 12.0), (2.0, 12.5), (0, 9.0), (0, 10.0)]
    for each, (base, top) in zip(FEATURES[:5], heights, strict=True):
        shape = shapely.make_valid(shapely.from_geojson(json.dumps(each["geometry"])))
        low, high = np.array(shape.bounds).reshape(2, 2)
        for lon, lat in rng.uniform(low, high, (300, 2)):
            place = frame.local([lat, lon, 0.0])
            if not shape.contains(shapely.Point(lon, lat)) or abs(place[:2]).max() > 89.9:
                continue
            for z, inside in ((base + 0.01, True), (top - 0.01, True), (top + 0.5, False)):
                place[2] = z
                gap = point_box_distance(place, scene.boxes).min()
                assert (gap < 0.05) == inside
    yard = np.array([60.0, -60, 5])
    assert point_box_distance(yard, scene.boxes).min() > 5.0
    assert point_box_distance(np.array([60.0, -75, 1]), scene.boxes).min() > 0.5  # below its base


def test_items_lie_by_walls_roofs_and_ground_and_the_depot_is_free(run):
    _, scene, _ = run()
    gaps = [float(point_box_distance(item, scene.boxes).min()) for item in scene.items]
    for k, gap in enumerate(gaps):
        near = min(gap, scene.items[k, 2]) if k % 3 == 2 else gap
        assert BESIDE[0] / 2 <= near <= BESIDE[1] + 1e-3
    assert point_box_distance(scene.depot, scene.boxes).min() >= scene.uav_radius + 1.9
    assert (scene.v_max, scene.a_max) == (15.0, 5.0)  # the delivery drone
    again, other = run()[1], run(None, "--seed", "1")[1]
    assert again == scene
    assert not np.array_equal(other.items, scene.items)


def test_depot_items_ceiling_and_vehicle_are_as_given(run, tmp_path):
    (lon, lat), (item_lon, item_lat) = degrees([[-10.0, 5]])[0], degrees([[10.0, -20]])[0]
    items = tmp_path / "items.csv"
    items.write_text(f"lat,lon,height\n{item_lat},{item_lon},3.5\n")
    flags = ["--depot", str(lat), str(lon), "2", "--items", str(items), "--random-items", "0"]
    more = ["--altitude", "35", "--ceiling", "20", "--vehicle", "crazyflie"]
    code, scene, said = run(None, *flags, *more)
    assert code == 0
    np.testing.assert_allclose(scene.depot, [-10, 5, 2], atol=2e-3)
    np.testing.assert_allclose(scene.items, [[10, -20, 3.5]], atol=2e-3)
    assert scene.bounds[1, 2] == scene.obstacles[:, 1, 2].max() == 20.0
    assert "1 higher than the ceiling" in said
    assert scene.v_max == 1.5
    items.write_text("lat,lon,height\nhere,there,1\n")
    code, _, said = run(None, *flags)
    assert code == 2
    assert "row 2" in said


def test_no_fly_zones_are_boxes_of_their_own_kind(run, tmp_path):
    zones = [feature([square(0, 0, 12, 20.0)], 0, min_height=5, height=30)]
    zones += [feature([square(-70, 70, 9)], 1), feature([square(500, 0, 9)], 2)]
    (tmp_path / "zones.geojson").write_text(json.dumps(collection(zones)))
    _, without, _ = run()
    code, scene, said = run(None, "--no-fly", str(tmp_path / "zones.geojson"))
    assert code == 0
    assert "2 no-fly zones, 2 boxes" in said
    count = len(without.obstacles)
    assert scene.no_fly == (count, count + 1)
    np.testing.assert_array_equal(scene.obstacles[:count], without.obstacles)
    np.testing.assert_allclose(scene.obstacles[count:, :, 2], [[5, 30], [0, 120]])
    walls = [item for k, item in enumerate(scene.items) if k % 3 < 2]
    for item in walls:  # by buildings, not by zones
        assert point_box_distance(item, scene.boxes[:count]).min() <= BESIDE[1] + 1e-3
    assert Scene.from_json(json.dumps(scene.to_dict())) == scene
    bow_tie = [[-50.0, 40], [-30, 60], [-30, 40], [-50, 60]]
    crossing = collection([feature([bow_tie], "zone7")])
    (tmp_path / "zones.geojson").write_text(json.dumps(crossing))
    assert "repaired: bzone7" in run(None, "--no-fly", str(tmp_path / "zones.geojson"))[2]
    (tmp_path / "zones.geojson").write_text("[")
    assert run(None, "--no-fly", str(tmp_path / "zones.geojson"))[0] == 2


def test_extracts_of_openstreetmap_are_read(run, tmp_path):
    points = [(1, -20.0, -10.0), (2, 20, -10), (3, 20, 10), (4, -20, 10)]
    nodes = "".join(
        f'<node id="{number}" lat="{lat}" lon="{lon}" version="1"/>'
        for number, (lon, lat) in zip(
            [p[0] for p in points], degrees([p[1:] for p in points]), strict=True
        )
    )
    way = '<nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/>'
    tags = '<tag k="building" v="yes"/><tag k="building:levels" v="5"/>'
    text = f'<osm version="0.6">{nodes}<way id="9" version="1">{way}{tags}</way></osm>'
    code, scene, said = run(text, name="map.osm")
    assert code == 0, said
    (box,) = scene.obstacles
    assert sorted((box[1] - box[0]).tolist()) == pytest.approx([15.0, 20.0, 40.0], abs=0.05)
    (tmp_path / "small.osm").write_text(text)
    with osmium.SimpleWriter(str(tmp_path / "small.osm.pbf")) as binary:
        for thing in osmium.FileProcessor(str(tmp_path / "small.osm")):
            binary.add(thing)
    code, packed, said = run((tmp_path / "small.osm.pbf").read_bytes(), name="map.osm.pbf")
    assert code == 0, said
    np.testing.assert_allclose(packed.obstacles, scene.obstacles, atol=0.02)
    assert run("<osm", name="map.osm")[0] == 2


def in_metres(each):
    shape = json.loads(json.dumps(each))
    rings = shape["geometry"]["coordinates"]
    shape["geometry"]["coordinates"] = [
        [[4.5e5 + 1e4 * a, 5.4e6 + b] for a, b in ring] for ring in rings
    ]
    return shape


def swapped(each):
    shape = json.loads(json.dumps(each))
    rings = shape["geometry"]["coordinates"]
    shape["geometry"]["coordinates"] = [[[b, a] for a, b in ring] for ring in rings]
    return shape


UTM = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
BAD = {
    "another system": (collection(crs=UTM), "32631"),
    "metres": (collection([in_metres(FEATURES[0])]), "not in degrees"),
    "swapped": (collection([swapped(FEATURES[0])]), "the other way round"),
    "elsewhere": (collection([FEATURES[5]]), "no building within 90 m"),
    "points only": (collection(FEATURES[6:]), "no area"),
    "no features": (collection([]), "no area"),
    "cut off": (json.dumps(collection())[:-40], "cut off"),
    "empty": ("", "is empty"),
    "a list": ([1], "FeatureCollection"),
    "no list": (collection({"a": 1}), "features"),
    "no height": (collection([feature([square(0, 0, 5)], height="tall")]), "b0"),
    "no ring": (collection([feature([[[0.0, 0]]], height=3)]), "b0"),
    "upside down": (collection([feature([square(0, 0, 5)], height=3, min_height=4)]), "min_height"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_and_nothing_is_written(run, name):
    document, told = BAD[name]
    code, scene, said = run(document)
    assert (code, scene) == (2, None)
    assert told in said
    assert said.startswith("error: ")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--size", "1"], "--size"),
        (["--ceiling", "0"], "--ceiling"),
        (["--random-items", "0"], "--items"),
        (["--items", "missing.csv"], "missing.csv"),
        (["--depot", str(LAT), str(LON + 1), "1"], "depot"),
        (["--center", "91", "0"], "latitude"),
    ],
)
def test_bad_flags_are_refused_and_nothing_is_written(run, flags, told):
    code, scene, said = run(None, *flags)
    assert (code, scene) == (2, None)
    assert told in said


def test_large_and_missing_files_are_refused_and_none_is_overwritten(
    run, tmp_path, monkeypatch, capsys
):
    given = ["--center", str(LAT), str(LON), "--random-items", "1", "--out"]
    assert main([str(tmp_path / "none.geojson"), *given, str(tmp_path / "a.json")]) == 2
    assert main([str(tmp_path), *given, str(tmp_path / "a.json")]) == 2
    monkeypatch.setattr(buildings, "MOST_BYTES", 1000)
    capsys.readouterr()
    code, scene, said = run()
    assert (code, scene) == (2, None)
    assert "cut the place out" in said
    monkeypatch.undo()
    run()
    assert main([str(tmp_path / "map.geojson"), *given, str(tmp_path / "scene.json")]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_from_map_to_plan_without_touching_anything(run, tmp_path):
    code, _, _ = run(None, "--random-items", "3")
    assert code == 0
    flags = ["--planner", "guidance", "--no-video", "--no-plots", "--out", str(tmp_path / "run")]
    assert fly.main(["--scene", str(tmp_path / "scene.json"), *flags]) == 0
    assert not verify_run(tmp_path / "run")
    assert (tmp_path / "run" / "mission.plan").is_file()
