"""CityJSON in a national grid becomes boxes where the buildings stand on Earth."""

from __future__ import annotations

import copy
import json

import numpy as np
import pyproj
import pytest

from mjcollect.generate.import_place import main
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.scene.place import Frame
from mjcollect.scene.scene import Scene

# Delft in the Dutch grid; on the ground, 3 m above the sea, heights count from a building's foot.
EAST, NORTH, GROUND = 84_500.0, 447_500.0, 3.0
GRID = pyproj.Transformer.from_crs("EPSG:28992", "EPSG:4326", always_xy=True)
SCALE = 0.001


def corners(x, y, wide, deep, high):
    """The corners (8, 3) of a box in the grid, z changing fastest."""
    return [
        [EAST + x + i * wide, NORTH + y + j * deep, GROUND + k * high]
        for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]  # fmt: skip


FACES = [[0, 2, 6, 4], [1, 5, 7, 3], [0, 4, 5, 1], [2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5]]


def surfaces(first):
    return [[[first + corner for corner in face]] for face in FACES]


def city():
    points = corners(-60, -40, 20, 30, 12.0) + corners(30, 20, 40, 10, 25.0)
    # A hipped roof of triangles over a square, without walls.
    top = [[EAST + 50, NORTH - 50, GROUND], [EAST + 70, NORTH - 50, GROUND]]
    top += [[EAST + 70, NORTH - 30, GROUND], [EAST + 50, NORTH - 30, GROUND]]
    top += [[EAST + 60, NORTH - 40, GROUND + 9.0]]
    roof = [[[16, 17, 20]], [[17, 18, 20]], [[18, 19, 20]], [[19, 16, 20]]]
    origin = [EAST, NORTH, 0.0]
    return {
        "type": "CityJSON",
        "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "transform": {"scale": [SCALE] * 3, "translate": origin},
        "vertices": np.rint((np.array(points + top) - origin) / SCALE).astype(int).tolist(),
        "CityObjects": {
            "hall": {
                "type": "Building",
                "geometry": [{"type": "Solid", "lod": "1", "boundaries": [surfaces(0)]}],
            },
            "tower": {
                "type": "BuildingPart",
                "geometry": [
                    {"type": "MultiSurface", "lod": "2.2", "boundaries": [[[0, 99, 1]]]},
                    {"type": "MultiSolid", "lod": "1.2", "boundaries": [[surfaces(8)]]},
                ],
            },
            "shed": {
                "type": "Building",
                "geometry": [{"type": "MultiSurface", "lod": "2", "boundaries": roof}],
            },
            "parent": {"type": "Building", "children": ["tower"]},
            "bridge": {
                "type": "Bridge",
                "geometry": [{"type": "Solid", "lod": "1", "boundaries": [surfaces(0)]}],
            },
        },
    }


def imported(document, folder):
    longitude, latitude = GRID.transform(EAST, NORTH)
    (folder / "city.json").write_text(json.dumps(document))
    out = folder / "out.json"
    code = main(
        [
            str(folder / "city.json"), "--center", str(latitude), str(longitude),
            "--size", "300", "--random-items", "3", "--out", str(out), "--overwrite",
        ]
    )  # fmt: skip
    return code, out


def test_buildings_stand_where_the_grid_says(tmp_path, capsys):
    code, out = imported(city(), tmp_path)
    assert code == 0
    assert "3 buildings in the square" in capsys.readouterr().out
    scene = Scene.load(out)
    frame = Frame(scene.origin)
    assert len(scene.boxes) == 3
    assert sorted(np.diff(scene.obstacles, axis=1)[:, 0, 2]) == pytest.approx([9, 12, 25])
    for x, y, height in ((-50, -25, 12.0), (50, 25, 25.0), (60, -40, 9.0)):
        longitude, latitude = GRID.transform(EAST + x, NORTH + y)
        middle = frame.local([latitude, longitude, height / 2])
        assert point_box_distance(middle, scene.boxes).min() == 0.0
    # Corners of the hall, to a centimetre: the grid is turned against the scene's north.
    for x, y in ((-60, -40), (-40, -40), (-40, -10), (-60, -10)):
        longitude, latitude = GRID.transform(EAST + x, NORTH + y)
        at = frame.local([latitude, longitude, 1.0])
        assert point_box_distance(at, scene.boxes).min() < 0.02
        outside = at + 0.1 * np.sign([x + 50, y + 25, 0])
        assert 0.05 < point_box_distance(outside, scene.boxes).min() < 0.2


def without_system(document):
    del document["metadata"]


def unknown_system(document):
    document["metadata"]["referenceSystem"] = "urn:ogc:def:crs:EPSG::999999"


def missing_corner(document):
    document["vertices"] = document["vertices"][:10]


def crooked_vertices(document):
    document["vertices"] = [[1, 2]]


def boundary_of_text(document):
    document["CityObjects"]["hall"]["geometry"][0]["boundaries"] = [[[["a", "b", "c"]]]]


def list_of_objects(document):
    document["CityObjects"] = [1, 2]


def text_for_metadata(document):
    document["metadata"] = "none"


def test_flat_buildings_get_the_height_of_those_without_one(tmp_path, capsys):
    document = city()
    for vertex in document["vertices"][:8]:
        vertex[2] = 3000
    document["CityObjects"]["hall"]["geometry"].append(None)
    code, out = imported(document, tmp_path)
    assert code == 0
    assert "1 without a height" in capsys.readouterr().out
    heights = np.diff(Scene.load(out).obstacles, axis=1)[:, 0, 2]
    assert sorted(heights) == pytest.approx([9, 10, 25])


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (list_of_objects, "CityObjects"),
        (text_for_metadata, "referenceSystem"),
        (without_system, "referenceSystem"),
        (unknown_system, "999999"),
        (missing_corner, "tower"),
        (crooked_vertices, "vertices"),
        (boundary_of_text, "hall"),
    ],
)
def test_a_broken_city_is_refused_by_name(spoil, named, tmp_path, capsys):
    document = copy.deepcopy(city())
    spoil(document)
    code, out = imported(document, tmp_path)
    assert code == 2
    assert not out.exists()
    assert named in capsys.readouterr().err
