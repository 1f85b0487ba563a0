"""Places on Earth against geodesics, and what is refused."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod

from mjcollect.scene.file_format import SceneError
from mjcollect.scene.place import Frame, Origin, check_place
from mjcollect.scene.scene import Scene


@settings(deadline=None)
@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-180, 180), st.floats(1, 5000))
def test_distances_and_bearings_from_the_origin_are_those_of_geodesics(lat, lon, bearing, far):
    there_lon, there_lat, _ = Geod(ellps="WGS84").fwd(lon, lat, bearing, far)
    frame = Frame(Origin(lat, lon, 10.0))
    east, north, up = frame.local([there_lat, there_lon, 30.0])
    angle = np.radians(bearing)
    np.testing.assert_allclose([east, north], [far * np.sin(angle), far * np.cos(angle)], atol=1e-3)
    assert up == 20.0
    latitude, longitude, altitude = frame.geographic([east, north, up])
    assert latitude == pytest.approx(there_lat, abs=1e-9)
    assert (longitude - there_lon + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert altitude == 30.0


def test_a_scene_keeps_its_origin(free_scene):
    for origin in (Origin(31.3, 120.6), Origin(31.3, 120.6, 4.0, "EPSG:32651")):
        scene = dataclasses.replace(free_scene, origin=origin)
        assert dataclasses.replace(scene).origin == origin
        assert Scene.from_json(json.dumps(scene.to_dict())) == scene
        assert scene != free_scene
    assert "origin" not in free_scene.to_dict()


@pytest.mark.parametrize(
    ("origin", "field"),
    [
        ({"latitude": 120.6, "longitude": 31.3}, "origin.latitude"),
        ({"latitude": 31.3, "longitude": 190.0}, "origin.longitude"),
        ({"latitude": float("nan"), "longitude": 0.0}, "origin.latitude"),
        ({"latitude": 31.3}, "origin"),
        ({"lat": 31.3, "lon": 120.6}, "origin"),
        ("Suzhou", "origin"),
    ],
)
def test_what_is_no_place_on_earth_is_refused(free_scene, origin, field):
    with pytest.raises(SceneError) as refused:
        dataclasses.replace(free_scene, origin=origin)
    assert refused.value.field == field


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "EPSG:999999", "nowhere"])
def test_systems_that_are_no_plane_in_metres_are_refused(crs):
    with pytest.raises(SceneError, match=r"origin\.crs"):
        check_place(Origin(31.3, 120.6, crs=crs))
