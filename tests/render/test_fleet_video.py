"""Frames of fleets: names, plates and overview; the video, by GL in a child process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mediapy
import numpy as np
from fleet_runs import scene_of, write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from PIL import Image
from straight_flights import fly

from mjcollect.render import overlay
from mjcollect.render.arrivals import progress
from mjcollect.render.camera import View, framing
from mjcollect.render.film.overview import Overview
from mjcollect.render.fleet import FleetProgress, load_fleet
from mjcollect.render.labels import name_all
from mjcollect.render.overlay import Hud, speed_colours
from mjcollect.render.settings import VideoSettings


@settings(max_examples=40, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-1.2, 1.2), st.integers(0, 10**6))
def test_names_of_uavs_stay_in_the_picture_and_out_of_the_plates(
    azimuth: float, elevation: float, seed: int
) -> None:
    """Wherever eight UAVs are, far and near, together and apart."""
    rng, scene = np.random.default_rng(seed), scene_of()
    rest = fly([scene.depot, *scene.items, scene.depot])
    flown = progress(scene, rest, range(5))
    eight = FleetProgress(scene, (flown,) * 8, (np.empty((0, 2)),) * 8, tuple(range(8)), 8)
    x = np.array([100.0, 100, 100])
    aim = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
                    np.sin(elevation)])  # fmt: skip
    view = View(x - 24 * aim, x, 55.0, (640, 360))
    xs = x + rng.normal(size=(8, 3)) * rng.choice([3.0, 10.0, 80.0])
    xs[0] = x
    blocked = [(460.0, 0.0, 640.0, 200.0), (0.0, 260.0, 200.0, 360.0), (0.0, 0.0, 230.0, 55.0)]
    image = Image.new("RGB", (640, 360))
    name_all(image, eight, (0,) * 8, view, xs, blocked)
    pixels = np.asarray(image)
    # Plates and letters are neither black, nor the target's ring, nor the white of lines.
    plate = np.all(np.abs(pixels.astype(int) - [13, 18, 24]) < 6, axis=2)
    assert not plate[:, [0, -1]].any()
    for left, top, right, bottom in blocked:
        assert not plate[int(top) : int(bottom), int(left) : int(right)].any()


def test_every_uav_in_sight_is_named_in_its_colour(fleet: FleetProgress) -> None:
    x = np.array([100.0, 100, 150])
    view = View(x - [24.0, 0, 0], x, 55.0, (1280, 720))
    for apart in (20.0, 1.0):  # one by one, and in one plate
        xs = np.array([[160.0, 100 - apart, 150], x, [160.0, 100 + apart, 150]])
        image = Image.new("RGB", view.size)
        name_all(image, fleet, (0, 0, 0), view, xs, [])
        pixels = np.asarray(image)
        for m in (0, 2):
            colour = np.round(np.multiply(to_rgb(fleet.colour(m)), 255))
            assert np.sum(np.all(pixels == colour, axis=2)) > 100


def overview(fleet: FleetProgress) -> tuple[Overview, View]:
    view = framing(fleet.scene.bounds, np.array([1.0, 0.82, -0.72]), 30.0, (1280, 720))
    trails = []
    for m, flown in enumerate(fleet.flights):
        x = flown.trajectory.x[::10]
        speed = np.linalg.norm(flown.trajectory.v[::10], axis=1)
        colours = speed_colours(speed, fleet.scene.v_max)
        if not fleet.is_alone:
            colours = np.tile(to_rgb(fleet.colour(m)), (len(x), 1))
        trails.append((x, colours))
    return Overview(fleet, view, trails), view


def test_the_overview_shows_all_paths_and_all_uavs(fleet: FleetProgress) -> None:
    drawn, view = overview(fleet)
    image = Image.new("RGB", view.size, "white")
    drawn.paths(image, [len(flown.trajectory.x[::10]) - 1 for flown in fleet.flights], 4.0)
    xs = np.array([flown.trajectory.x[250] for flown in fleet.flights])
    pixels = np.asarray(image)
    for m, flown in enumerate(fleet.flights):
        colour = np.multiply(to_rgb(fleet.colour(m)), 255)
        at = view.project(flown.trajectory.x[::50])[0].round().astype(int)
        like = np.abs(pixels[at[:, 1], at[:, 0]] - colour).max(axis=1) < 70
        assert like.mean() > 0.7  # elsewhere another path or a faint one is there
    drawn.uavs(image, xs, 7.0)
    pixels = np.asarray(image)
    for m, (u, v) in enumerate(view.project(xs)[0].round().astype(int)):
        np.testing.assert_allclose(pixels[v, u], np.multiply(to_rgb(fleet.colour(m)), 255), atol=1)


def test_a_single_flight_is_drawn_as_ever() -> None:
    """Its path shows speed, items show what they are, and no plate names UAVs."""
    scene = scene_of()
    flown = progress(scene, fly([scene.depot, *scene.items, scene.depot]), range(5))
    alone = FleetProgress.alone(flown)
    assert alone.uav_scale == 8.0
    drawn, view = overview(alone)
    image = Image.new("RGB", view.size, "white")
    drawn.nodes(image, (2,), 11.0)
    at = view.project(np.array([scene.point(node) for node in range(-1, 5)]))[0].round().astype(int)
    states = ["depot", "collected", "collected", "target", "item", "item"]
    for (u, v), state in zip(at, states, strict=True):
        assert image.getpixel((int(u) - 8, int(v))) == overlay.NODES[state]
    drawn.uavs(image, flown.trajectory.x[[300]], 7.0)
    u, v = view.project(flown.trajectory.x[300])[0].round().astype(int)
    assert image.getpixel((int(u), int(v))) == overlay.UAV


def test_the_plate_of_many_uavs_keeps_below_the_inset() -> None:
    hud = Hud(scene_of(), VideoSettings())
    for count in (1, 2, 8, 11, 30):
        left, top, row = hud.fleet_place(count)
        assert top >= 400
        image = Image.new("RGB", (1280, 720))
        rows = [overlay.FleetRow((0, 114, 178), f"UAV {m}", "to item 3", "1 / 4", False, False)
                for m in range(count)]  # fmt: skip
        hud.fleet(image, rows, 3.0 if count > 1 else np.inf)
        pixels = np.asarray(image).any(axis=2)
        assert not pixels[:, : int(left)].any()
        assert not pixels[: int(top)].any()
        assert not pixels[-15:].any()
        assert row > 7


# The video


FILM = """
import sys
from mjcollect.render import VideoSettings, render_run
for folder in sys.argv[1:]:
    render_run(folder, VideoSettings(fps=3, size=(640, 360)))
"""


def test_a_video_shows_all_uavs(folder: Path, tmp_path: Path, egl: dict[str, str]) -> None:
    failed = write_run(tmp_path / "failed", ended={0: 60, 1: 50, 2: 40})
    folders = [str(folder), str(failed)]
    subprocess.run([sys.executable, "-c", FILM, *folders], env=egl, check=True)

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    video = mediapy.read_video(folder / "fleet.mp4")
    fleet = load_fleet(folder)
    flown = int(np.ceil(round(fleet.duration * 3, 6))) + 1
    assert video.shape == (4 + flown + 5, 360, 640, 3)
    frames = np.asarray(video).astype(int)
    colours = [np.multiply(to_rgb(fleet.colour(m)), 255) for m in range(3)]

    def count(picture: np.ndarray, colour: np.ndarray) -> int:
        return int(np.sum(np.abs(picture - colour).max(axis=-1) < 40))

    inset = np.s_[10:190, 457:630]
    middle, start = frames[4 + flown // 2], frames[4 + 2 : 4 + 6].copy()
    for colour in colours:
        assert count(middle[inset], colour) > count(frames[2][inset], colour)
        assert count(frames[-1], colour) > 100  # whole paths
    # Within two seconds each is in sight with name and trail, beside inset and plates.
    start[:, *inset] = start[:, 290:] = 0
    for colour in colours:
        assert max(count(picture, colour) for picture in start) > 15
    assert len(mediapy.read_video(failed / "fleet.mp4")) == 4 + 4 + 1 + 5
    assert not list(folder.glob(".*"))
