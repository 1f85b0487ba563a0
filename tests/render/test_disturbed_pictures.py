"""Pictures of disturbed flights: the tracks of all, the wind and moving boxes of one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from PIL import Image

from mjcollect.envs.disturbed import DisturbedFlight, DisturbedFlights
from mjcollect.envs.recording import Flight
from mjcollect.render.camera import View
from mjcollect.render.film.overview import draw_moving_box
from mjcollect.render.overlay import MOVING, WIND, Hud
from mjcollect.render.settings import VideoSettings
from mjcollect.render.time_figures import BLUE, RED
from mjcollect.render.track_figures import plot_tracks
from mjcollect.scene.air import Air
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

BOX = MovingBox((20.0, 20.0, 20.0), ((300.0, 100.0, 60.0), (300.0, 250.0, 60.0)), 5.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    boxes = [[[100, 200, 0], [180, 260, 90]], [[300, 100, 50], [360, 220, 100]]]
    bounds = [[0, 0, 0], [600, 400, 120]]
    return Scene("tracks", 0, bounds, [0, 0, 0], [[500, 300, 60]], boxes)  # type: ignore[arg-type]


def flown(scene: Scene, ends: list[str]) -> DisturbedFlights:
    flights = []
    for number, end in enumerate(ends):
        beside = np.array([0, number, 0])
        x = np.linspace(scene.depot + beside, scene.items[0] + beside, 101)
        v = np.diff(x, axis=0, prepend=x[:1]) / 0.02
        trajectory = Trajectory(np.arange(101) * 0.02, x, v, np.zeros_like(v))
        wind = 3.0 * np.array([np.cos(number), np.sin(number), 0.0])
        air = Air(number, wind, 1.0, 0.0, (BOX,), 0.2, np.tile(wind, (10, 1)))
        flight = Flight(trajectory, end == "home", 0, (), (), 0.2)
        flights.append(DisturbedFlight(flight, end, air))
    return DisturbedFlights(tuple(flights))


def test_tracks_show_every_flight_in_both_views_and_where_it_failed(scene, tmp_path: Path) -> None:
    path = tmp_path / "tracks.png"
    all_flights = flown(scene, ["moving box", "home", "home", "too late"])
    figure = plot_tracks(path, scene, [0], all_flights)
    for axes, up in zip(figure.axes[:2], (1, 2), strict=True):
        lines = {
            tuple(c.get_colors()[0][:3]): c.get_segments()
            for c in axes.collections
            if isinstance(c, LineCollection)
        }
        home, failed = lines[to_rgb(BLUE)], lines[to_rgb(RED)]
        assert (len(home), len(failed)) == (2, 2)
        x = all_flights.flights[1].flight.trajectory.x[::10, [0, up]]
        np.testing.assert_allclose(home[0], x)
    assert "1 moving box" in figure._suptitle.get_text()
    with Image.open(path) as image:
        assert image.size == (1920, 960)
        pixels = np.asarray(image.convert("RGB"))
    for edge in (pixels[:4], pixels[-4:], pixels[:, :4], pixels[:, -4:]):
        assert np.all(edge == 255)


def test_calm_tracks_and_those_without_any_arrival_can_be_drawn(scene, tmp_path: Path) -> None:
    calm = flown(scene, ["out of bounds"])
    calm = DisturbedFlights((replace(calm.flights[0], air=None),))
    figure = plot_tracks(tmp_path / "tracks.png", scene, [0], calm)
    assert len(figure.axes) == 2  # no rose of winds


def test_the_arrow_points_up_where_the_wind_blows_ahead_of_the_camera() -> None:
    settings = VideoSettings((640, 360))
    scene = Scene("wind", 0, [[0] * 3, [9] * 3], [1] * 3, [[5] * 3], [])  # type: ignore[arg-type]
    view = View(np.array([0.0, 0.0, 5.0]), np.array([0.0, 10.0, 0.0]), 55.0, (640, 360))
    heads = []
    for push in ([0, 6, 0], [0, -6, 0], [6, 0, 0], [-6, 0, 0]):
        image = Image.new("RGB", (640, 360))
        Hud(scene, settings).push(image, np.array(push, float), view)
        rows, columns = np.nonzero(np.all(np.asarray(image) == WIND, axis=-1))
        middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
        heads.append(np.array([columns.mean(), rows.mean()]) - middle)
    up, down, right, left = heads  # The head is wider than the shaft, so the mean lies towards it.
    assert up[1] < -1 < 1 < down[1]
    assert left[0] < -1 < 1 < right[0]


def test_a_moving_box_is_drawn_where_it_is() -> None:
    image = Image.new("RGB", (640, 360))
    view = View(np.array([300.0, -300.0, 60.0]), np.array([300.0, 100.0, 60.0]), 30.0, (640, 360))
    draw_moving_box(image, view, BOX.box_at(0.0), 1.0)
    rows, columns = np.nonzero(np.all(np.asarray(image) == MOVING, axis=-1))
    focal = 180 / np.tan(np.radians(15.0))
    reach = 10 / 390 * focal  # half the near face
    assert (columns.min(), columns.max()) == pytest.approx((320 - reach, 320 + reach), abs=1.5)
    assert (rows.min(), rows.max()) == pytest.approx((180 - reach, 180 + reach), abs=1.5)
