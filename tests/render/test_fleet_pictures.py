"""Pictures of fleets: who is where in which colour, in figures and in the video."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import imageio_ffmpeg
import mediapy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from straight_flights import fly

from mjcollect.fleet.share import parts
from mjcollect.render import overlay
from mjcollect.render.arrivals import progress
from mjcollect.render.camera import View, framing
from mjcollect.render.fleet import UAV_COLOURS, FleetProgress, load_fleet
from mjcollect.render.fleet_figures import plot_fleet_path_3d, plot_fleet_path_top, plot_schedule
from mjcollect.render.labels import name_all
from mjcollect.render.overlay import Hud, Overview, node_look, speed_colours
from mjcollect.render.settings import VideoSettings
from mjcollect.render.video import RenderError, render_run
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory, save_shield

TOURS = ((1,), (3, 2, 0), (4,))
ITEMS = [[120, 150, 60], [180, 30, 90], [40, 170, 120], [20, 90, 40], [150, 100, 30]]
BOXES = [[[60, 60, 0], [80, 80, 50]], [[100, 20, 0], [120, 60, 70]]]
BOUND, SHIELDED = 9.5, np.array([[1.0, 1.4]])


def scene_of(items: list = ITEMS) -> Scene:
    bounds = [[0, 0, 0], [200, 200, 200]]
    return Scene("fleet", 0, bounds, [10, 10, 5], items, BOXES)  # type: ignore[arg-type]


def write_run(folder: Path, tours=TOURS, uavs: int = 4, ended: dict | None = None) -> Path:
    """A run folder; `ended` cuts the flights of UAVs to so many rows."""
    scene, missions = scene_of(), []
    for uav, (part, tour) in enumerate(zip(parts(scene, tours), tours, strict=True)):
        own = folder / "uavs" / str(uav)
        own.mkdir(parents=True)
        flown = fly([part.depot, *part.items, part.depot])
        whole = (ended or {}).get(uav) is None
        if not whole:
            rows = (ended or {})[uav]
            flown = Trajectory(*(c[:rows] for c in (flown.t, flown.x, flown.v, flown.a)))
        part.save(own / "scene.json")
        flown.save(own / "trajectory.csv")
        save_shield(own / "shield.csv", SHIELDED if uav == 0 else np.empty((0, 2)))
        time = flown.duration if whole else None
        entry = {"uav": uav, "folder": f"uavs/{uav}", "items": list(tour), "success": whole}
        missions.append({**entry, "mission_time": time})
    scene.save(folder / "scene.json")
    times = [entry["mission_time"] for entry in missions]
    failed = {"kind": "contact", "t": 2.0, "uav": 1}
    document = {
        "scene": scene.name, "uavs": uavs, "success": None not in times, "lower_bound": BOUND,
        "makespan": None if None in times else max(times), "bound_method": "exact", "ratio": None,
        "separation": 2.0, "separation_limit": scene.apart, "planner": "law",
        "violations": [failed] if None in times else [], "missions": missions,
    }  # fmt: skip
    (folder / "fleet.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="module")
def fleet(folder: Path) -> FleetProgress:
    return load_fleet(folder)


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> FleetProgress:
    """UAV 1 does not come home from its second item."""
    return load_fleet(write_run(tmp_path_factory.mktemp("failed"), ended={1: 420}))


# What was flown


def test_a_fleet_s_nodes_have_the_numbers_of_the_whole_scene(fleet: FleetProgress) -> None:
    assert [flown.order for flown in fleet.flights] == list(TOURS)
    assert fleet.lead == 1
    assert fleet.idle == (3,)
    assert fleet.complete
    assert fleet.title == "3 of 4 UAVs, 5 items"
    assert fleet.makespan == fleet.duration
    start, under_way = (0, 0, 0), (1, 2, 0)
    assert fleet.collected(start) == 0
    assert fleet.collected(under_way) == 3
    assert fleet.collected(fleet.arrivals) == 5
    assert [fleet.state(node, under_way) for node in range(-1, 5)] == [
        ("depot", 1), ("target", 1), ("collected", 0), ("collected", 1), ("collected", 1),
        ("target", 2),
    ]  # fmt: skip
    assert (fleet.target(start), fleet.target((0, 3, 0)), fleet.target((0, 4, 0))) == (3, -1, None)
    for flown in fleet.flights:
        for node, row in zip(flown.targets, flown.rows, strict=True):
            away = np.linalg.norm(flown.trajectory.x[row] - flown.scene.point(node))
            assert away <= flown.scene.tolerance(node)
    assert len({tuple(flown.scene.depot) for flown in fleet.flights}) == 3


def test_gaps_are_the_least_distances_at_every_instant(fleet: FleetProgress) -> None:
    rows = np.arange(len(fleet.gaps))
    assert len(rows) == len(fleet.flights[fleet.lead].trajectory)
    fine = np.minimum(rows[:-1, None] + np.linspace(0, 1, 101), rows[-1])
    places = [
        np.stack([np.interp(fine, np.arange(len(x)), x[:, k]) for k in range(3)], axis=-1)
        for x in (flown.trajectory.x for flown in fleet.flights)
    ]
    pairs = [np.linalg.norm(a - b, axis=-1).min(axis=1) for a, b in combinations(places, 2)]
    np.testing.assert_allclose(fleet.gaps[:-1], np.min(pairs, axis=0), atol=2e-3)
    assert np.all(fleet.gaps[:-1] <= np.min(pairs, axis=0) + 1e-9)


def test_folders_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    document = json.loads((folder / "fleet.json").read_text())
    document["missions"][0]["items"] = [9]
    (folder / "fleet.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"must lie in 0\.\.4"):
        load_fleet(folder)
    with pytest.raises(RenderError, match="not a readable run"):
        render_run(folder)
    document["missions"] = []
    (folder / "fleet.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="no UAV flew"):
        load_fleet(folder)


# Colours


SEEN = {  # linear RGB as the colour-blind see it (Machado, Oliveira and Fernandes 2009)
    "all": np.eye(3),
    "no red": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "no green": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "no blue": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


@pytest.mark.parametrize("eyes", SEEN)
def test_the_colour_blind_can_tell_eight_uavs_apart(eyes: str) -> None:
    found = []
    for colour in UAV_COLOURS:
        rgb = np.array(to_rgb(colour))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        linear = np.clip(np.array(SEEN[eyes]) @ linear, 0, 1)
        x, y, z = (
            np.array([[0.412, 0.358, 0.180], [0.213, 0.715, 0.072], [0.019, 0.119, 0.950]])
            @ (linear)
            / [0.950, 1.0, 1.089]
        )
        found.append(
            [
                116 * np.cbrt(y),
                500 * (np.cbrt(x) - np.cbrt(y)),
                200 * np.cbrt(y / 1) - 200 * np.cbrt(z),
            ]
        )
    assert len(found) == 8
    # In CIELAB, where 2.3 is just noticeable.
    assert min(np.linalg.norm(np.subtract(a, b)) for a, b in combinations(found, 2)) > 14


def test_items_take_the_colour_of_the_uav_that_collects_them(fleet: FleetProgress) -> None:
    colours = [tuple(round(255 * part) for part in to_rgb(c)) for c in UAV_COLOURS[:3]]
    reached = (1, 2, 0)
    looks = {node: node_look(fleet, node, reached) for node in range(-1, 5)}
    assert [looks[node].fill for node in (1, 3, 2)] == [colours[0], colours[1], colours[1]]
    assert [looks[node].fill for node in (0, 4)] == [overlay.UNCOLLECTED] * 2
    assert [looks[node].rim for node in (0, 4)] == colours[1:]
    assert looks[DEPOT].fill == overlay.FLEET_DEPOT


# Figures


FIGURES = {"3d": plot_fleet_path_3d, "top": plot_fleet_path_top, "schedule": plot_schedule}


def boxes_of(figure: Figure) -> list:
    """Where the visible texts in a figure's axes are, and its title."""
    renderer = figure.canvas.get_renderer()
    texts = [text for axes in figure.axes for text in axes.texts] + [figure._suptitle]
    shown = [text for text in texts if text is not None and text.get_text()]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in shown]


@pytest.mark.parametrize("kind", FIGURES)
@pytest.mark.parametrize("which", ["fleet", "failed"])
def test_texts_are_on_the_page_and_names_do_not_overlap(
    kind: str, which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path, flown = tmp_path / "a.png", request.getfixturevalue(which)
    figure = FIGURES[kind](path, flown)
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape[1] == 1440
    assert kind == "schedule" or pixels.shape[0] == 1200
    for edge in (pixels[:4], pixels[-4:], pixels[:, :4], pixels[:, -4:]):
        assert np.all(edge == 255)  # nothing runs off the page
    found = boxes_of(figure)
    for text, box in found:
        assert box.x0 >= 0, text
        assert box.x1 <= figure.bbox.width, text
        assert box.y0 >= 0, text
        assert box.y1 <= figure.bbox.height, text
    for (one, a), (two, b) in combinations(found, 2):
        assert not (a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1), (one, two)
    said = "not completed" if which == "failed" else f"makespan {flown.makespan:.2f} s"
    assert said in figure.get_suptitle()


@pytest.mark.parametrize("kind", ["3d", "top"])
def test_paths_have_the_uavs_colours_and_a_legend(
    fleet: FleetProgress, kind: str, tmp_path: Path
) -> None:
    figure = FIGURES[kind](tmp_path / "a.png", fleet)
    axes, drawn = figure.axes[0], {}
    for line in axes.lines:
        if line.get_path_effects():
            x = line.get_data_3d() if kind == "3d" else line.get_data()
            drawn[line.get_color()] = np.array(x).T
    assert list(drawn) == list(UAV_COLOURS[:3])
    for m, x in enumerate(drawn.values()):
        flown = fleet.flights[m].trajectory
        np.testing.assert_allclose(x[[0, -1]], flown.x[[0, -1], : x.shape[1]])
        assert np.linalg.norm(np.diff(x, axis=0), axis=1).sum() == pytest.approx(
            np.linalg.norm(np.diff(flown.x[:, : x.shape[1]], axis=0), axis=1).sum(), rel=1e-3
        )
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    times = [flown.trajectory.duration for flown in fleet.flights]
    assert names[:3] == [f"UAV {m}, {time:.1f} s" for m, time in enumerate(times)]
    assert figure.legends[0].get_window_extent().x0 > axes.get_position().x0
    said = " | ".join(text.get_text() for text in axes.texts)
    for name in ("item 1 · stop 1", "item 0 · stop 3", "item 2 · stop 2", "depot"):
        assert name in said


def test_moving_boxes_and_items_nobody_collected_are_drawn(
    failed: FleetProgress, tmp_path: Path
) -> None:
    path = [[140.0, 130.0, 60.0], [140.0, 180.0, 60.0]]
    box = MovingBox.from_dict({"size": [10, 10, 10], "path": path, "speed": 8.0})
    for plot in (plot_fleet_path_3d, plot_fleet_path_top):
        figure = plot(tmp_path / "a.png", failed, [box])
        names = [text.get_text() for text in figure.legends[0].get_texts()]
        assert {"moving box", "not collected", "end of flight"} <= set(names)


def bars(axes, colour: str, alpha: float | None = None) -> list[tuple[float, float, float]]:
    """Row, begin and end of the bars of a colour."""
    found = [
        bar
        for bar in axes.patches
        if bar.get_facecolor()[:3] == to_rgb(colour) and bar.get_alpha() == alpha
    ]
    return [
        (bar.get_y() + bar.get_height() / 2, bar.get_x(), bar.get_x() + bar.get_width())
        for bar in found
    ]


def test_the_schedule_shows_segments_waits_shield_and_limits(
    fleet: FleetProgress, tmp_path: Path
) -> None:
    figure = plot_schedule(tmp_path / "a.png", fleet)
    upper, lower = figure.axes
    assert [text.get_text() for text in upper.get_yticklabels()] == [f"UAV {m}" for m in range(4)]
    for m, flown in enumerate(fleet.flights):
        times = [0.0, *flown.trajectory.t[list(flown.rows)]]
        expected = [(m, *pair) for pair in zip(times[:-1], times[1:], strict=True)]
        np.testing.assert_allclose(bars(upper, fleet.colour(m)), expected, atol=1e-9)
        waits = bars(upper, fleet.colour(m), alpha=0.22)
        expected = [] if m == fleet.lead else [(m, times[-1], fleet.duration)]
        np.testing.assert_allclose(np.reshape(waits, (-1, 3)), np.reshape(expected, (-1, 3)))
    (mark,) = bars(upper, "#222222")
    assert 0.3 < mark[0] < 0.5  # under the bar of UAV 0
    np.testing.assert_allclose(mark[1:], SHIELDED[0])
    said = [text.get_text() for text in upper.texts]
    assert [said.count(name) for name in ("item 3", "item 2", "item 0", "item 1")] == [1] * 4
    assert {"no items", f"lower bound {BOUND:.2f} s"} <= {text.strip() for text in said}
    assert f"makespan {fleet.makespan:.2f} s" in said
    for axes in (upper, lower):
        times = {line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1}
        assert times == {BOUND, fleet.makespan}
    curve = lower.lines[0] if len(lower.lines[0].get_xdata()) > 2 else lower.lines[2]
    np.testing.assert_allclose(curve.get_ydata(), fleet.gaps)
    levels = [line.get_ydata()[0] for line in lower.lines if len(set(line.get_ydata())) == 1]
    assert fleet.separation_limit in levels
    assert lower.get_yscale() == "log"
    assert any(f"{fleet.gaps.min():.2f} m apart" in text.get_text() for text in lower.texts)


def test_the_schedule_of_a_single_uav_has_no_distances(tmp_path: Path) -> None:
    one = load_fleet(write_run(tmp_path / "run", ((1, 0, 2, 3, 4),), uavs=2))
    assert not np.isfinite(one.gaps).any()
    figure = plot_schedule(tmp_path / "a.png", one)
    assert len(figure.axes) == 1
    plot_fleet_path_top(tmp_path / "b.png", one)


def test_a_flight_that_ended_is_marked_where_it_did(failed: FleetProgress, tmp_path: Path) -> None:
    figure = plot_schedule(tmp_path / "a.png", failed)
    upper = figure.axes[0]
    hatched = [bar for bar in upper.patches if bar.get_hatch()]
    flown = failed.flights[1]
    (bar,) = hatched
    begin = flown.trajectory.t[flown.rows[-1]]
    assert (bar.get_x(), bar.get_x() + bar.get_width()) == pytest.approx(
        (begin, flown.trajectory.duration)
    )
    assert not any("makespan" in text.get_text() for text in upper.texts)


# Frames


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
    render_run(folder, VideoSettings(fps=5, size=(640, 360)))
"""


def test_a_video_shows_all_uavs(folder: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"}
    probe = (
        "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 9, 9).close()"
    )
    if subprocess.run(
        [sys.executable, "-c", probe], env=environment, capture_output=True, check=False
    ).returncode:
        pytest.skip("no EGL here: apt-get install libegl1 libgl1-mesa-dri")
    failed = write_run(tmp_path / "failed", ended={0: 60, 1: 50, 2: 40})
    folders = [str(folder), str(failed)]
    subprocess.run([sys.executable, "-c", FILM, *folders], env=environment, check=True)

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    video = mediapy.read_video(folder / "fleet.mp4")
    fleet = load_fleet(folder)
    flown = int(np.ceil(round(fleet.duration * 5, 6))) + 1
    assert video.shape == (6 + flown + 9, 360, 640, 3)
    frames = np.asarray(video).astype(int)
    colours = [np.multiply(to_rgb(fleet.colour(m)), 255) for m in range(3)]

    def count(picture: np.ndarray, colour: np.ndarray) -> int:
        return int(np.sum(np.abs(picture - colour).max(axis=-1) < 40))

    inset = np.s_[10:190, 457:630]
    middle = frames[6 + flown // 2]
    for colour in colours:
        assert count(middle[inset], colour) > count(frames[2][inset], colour)
        assert count(frames[-1], colour) > 100  # whole paths
    # At the start all three stand near the camera, in the middle of the chase view.
    for colour in colours:
        assert count(frames[7][100:260, 200:460], colour) > 15
    assert len(mediapy.read_video(failed / "fleet.mp4")) == 6 + 6 + 1 + 9
    assert not list(folder.glob(".*"))
