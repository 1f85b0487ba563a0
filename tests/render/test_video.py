"""Cameras, overlays and video. GL is needed by one test only, in a child process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mediapy
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from PIL import Image

from mjcollect.render import overlay
from mjcollect.render.arrivals import progress
from mjcollect.render.camera import View, chase_eyes, clear_distance, framing
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.labels import name_all
from mjcollect.render.runs import UnreadableRun
from mjcollect.render.settings import VideoSettings
from mjcollect.render.video import render_in_child, render_run
from mjcollect.scene.assets import asset_path
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

EYE = np.array([10.0, -20.0, 30.0])


def scene_of(obstacles: list, items: list, **limits: float) -> Scene:
    bounds = [[0, 0, 0], [200, 200, 200]]
    return Scene("test", 0, bounds, [5, 5, 5], items, obstacles, **limits)  # type: ignore[arg-type]


def flight(points: list, slot: int = 10, pause: int = 10, step: float = 0.02) -> Trajectory:
    """Straight from point to point, at rest for `pause` rows at each (not within any limits)."""
    x = [np.array(points[0], dtype=float)] * pause
    for point in points[1:]:
        x += list(np.linspace(x[-1], point, 6 * slot)[1:]) + [np.array(point, dtype=float)] * pause
    rows = np.array(x)
    v = np.diff(rows, axis=0, prepend=rows[:1]) / step
    a = np.diff(v, axis=0, append=v[-1:]) / step
    return Trajectory(np.arange(len(rows)) * step, rows, v, a)


# Progress


def test_arrivals_are_the_first_rows_at_rest_at_each_target() -> None:
    scene = scene_of([], [[100, 5, 5], [100, 100, 5]])
    flown = flight([scene.depot, scene.items[1], scene.items[0], scene.depot])
    done = progress(scene, flown, [1, 0])
    at_rest = [np.flatnonzero(np.all(flown.x == scene.point(n), axis=1)) for n in (1, 0)]
    assert done.targets == (1, 0, -1)
    # The row that arrives still has the speed of the step into it.
    assert done.rows[:2] == tuple(int(rows[1]) for rows in at_rest)
    assert done.rows[2] > done.rows[1]
    assert done.complete
    assert [done.collected(reached) for reached in range(4)] == [(), (1,), (1, 0), (1, 0)]
    assert [done.goal(reached) for reached in range(4)] == [1, 0, -1, -1]
    assert done.segment_title(1) == "segment 1: item 1 → item 0"
    assert done.segment_title(3) == "segment 2: item 0 → depot"
    assert [done.state(node, 1) for node in (-1, 0, 1)] == ["depot", "target", "collected"]
    assert done.state(-1, 2) == "target"


def test_passing_over_a_target_or_the_wrong_order_is_no_arrival() -> None:
    scene = scene_of([], [[50, 5, 5], [100, 5, 5]])
    through = flight([scene.depot, scene.items[1]])  # passes item 0 without stopping
    assert progress(scene, through, [0, 1]).rows == ()
    assert len(progress(scene, through, [1, 0]).rows) == 1
    one = progress(scene, flight([scene.items[0], scene.items[1]]), [0, 1], 1)
    assert len(one.rows) == 1
    assert [one.collected(reached) for reached in range(2)] == [(0,), (0, 1)]


def test_progress_refuses_a_wrong_order_or_segment() -> None:
    scene = scene_of([], [[50, 5, 5], [100, 5, 5]])
    with pytest.raises(ValueError, match="order"):
        progress(scene, flight([scene.depot]), [0, 0])
    with pytest.raises(ValueError, match=r"segment: 3.*0\.\.2"):
        progress(scene, flight([scene.depot]), [0, 1], 3)


# Cameras


def test_projection_agrees_with_ray_casting() -> None:
    """The ray through a pixel, built from angles, must come back to that pixel."""
    view = View(EYE, np.array([50.0, 60.0, 0.0]), 60.0, (640, 360))
    right, up, forward = view.axes
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    assert up[2] > 0
    assert right[2] == 0
    half = np.tan(np.radians(30.0))
    for u, v in ((320, 180), (0, 0), (640, 360), (100, 300)):
        across, above = (u - 320) / 180 * half, (180 - v) / 180 * half
        pixel, depth = view.project(EYE + 7.0 * (forward + across * right + above * up))
        np.testing.assert_allclose(pixel, (u, v), atol=1e-9)
        assert depth == pytest.approx(7.0)
    assert view.project(EYE - forward)[1] < 0


@pytest.mark.parametrize("size", [(1280, 720), (400, 800)])
def test_framing_shows_all_of_the_box_and_no_smaller_than_need_be(size: tuple[int, int]) -> None:
    box = np.array([[0.0, -50.0, 10.0], [1000.0, 300.0, 400.0]])
    view = framing(box, np.array([1.0, 0.8, -0.7]), 40.0, size, fill=0.9)
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    pixels, depth = view.project(corners)
    half = np.array(size) / 2
    assert np.all(depth > 0)
    assert np.abs((pixels - half) / half).max() == pytest.approx(0.9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_clear_distance_agrees_with_marching_along_the_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 60, (4, 3))
    boxes = np.stack([low, low + rng.uniform(5, 40, (4, 3))], axis=1)
    start = rng.uniform(0, 100, 3)
    outside = np.abs(np.clip(start, boxes[:, 0], boxes[:, 1]) - start).max(axis=1)
    assume(outside.min() >= 1.0)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    distance = float(clear_distance(start, direction, boxes, 0.5))
    at = start + np.arange(0, 200, 0.01)[:, None] * direction
    gap = np.abs(np.clip(at[:, None], boxes[:, 0], boxes[:, 1]) - at[:, None]).max(axis=-1)
    near = np.flatnonzero((gap < 0.5).any(axis=1))
    if len(near):
        assert distance == pytest.approx(near[0] * 0.01, abs=0.011)
    else:  # a corner may be cut for less than the marching step
        assert distance > 199 or np.abs(gap).min() < 0.51


def test_clear_distance_lets_one_leave_a_wall_that_is_nearer_than_the_margin() -> None:
    wall = np.array([[[0.0, 0, 0], [10, 10, 10]]])
    start = np.array([10.1, 5, 5])
    away, into = np.array([1.0, 0, 0]), np.array([-1.0, 0, 0])
    assert clear_distance(start, away, wall, 0.5) == np.inf
    assert clear_distance(start, into, wall, 0.5) < 0.1


def slalom() -> tuple[Scene, np.ndarray, np.ndarray, np.ndarray]:
    """A flight that hugs walls at 0.6 m, turns round corners and goes under a slab."""
    boxes = [
        [[20, 0, 0], [40, 100, 60]],
        [[60, 40, 0], [80, 200, 60]],
        [[90, 20, 20], [130, 60, 40]],
    ]
    scene = scene_of(boxes, [[150, 40, 10]])
    corners = [[19.4, 5, 10], [19.4, 100.6, 10], [40.6, 100.6, 10], [40.6, 39.4, 10],
               [80.6, 39.4, 10], [110, 39.4, 10], [150, 40, 10]]  # fmt: skip
    x = flight(corners, pause=1).x
    v = np.gradient(x, 1 / 30, axis=0)
    return scene, x, v, np.broadcast_to(scene.items[0], x.shape)


def test_chase_camera_is_never_in_a_box_nor_behind_one() -> None:
    scene, x, v, goal = slalom()
    eyes, _ = chase_eyes(scene, x, v, goal, 30, 24.0)
    shares = np.linspace(0, 1, 200)[:, None, None]
    sight = x + shares * (eyes - x)  # every point between body and camera
    for low, high in scene.obstacles:
        assert not np.any(np.all((sight > low) & (sight < high), axis=-1))
    assert np.linalg.norm(eyes - x, axis=1).max() <= 24.0 + 1e-9
    # Straight behind without choice, the walls would have been in the way.
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    straight = x - 24.0 * v / np.maximum(speed, 1e-9)
    assert any(
        np.any(np.all((straight > b[0]) & (straight < b[1]), axis=1)) for b in scene.obstacles
    )


def test_chase_camera_moves_smoothly_and_follows_from_behind_in_the_open() -> None:
    scene = scene_of([], [[190, 100, 100]])
    t = np.linspace(0, 1, 200)[:, None]
    x = np.array([10.0, 100, 100]) + t * [180, 0, 0]
    v = np.broadcast_to([27.0, 0, 0], x.shape)
    eyes, heading = chase_eyes(scene, x, v, np.broadcast_to(scene.items[0], x.shape), 30, 24.0)
    offset = eyes - x
    assert np.all(offset[:, 0] < -20)
    assert np.all(offset[:, 2] > 3)
    np.testing.assert_allclose(heading[:-20], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 24.0)
    scene, x, v, goal = slalom()
    eyes, _ = chase_eyes(scene, x, v, goal, 30, 24.0)
    step = np.linalg.norm(np.diff(eyes - x, axis=0), axis=1)
    assert step.max() < 3.0  # metres a frame, at 24 m: no cuts


# Overlays


def test_attitude_turns_thrust_along_the_acceleration() -> None:
    from mjcollect.render.flown_model import attitude

    rotation = attitude(np.array([9.81, 0.0, 0.0]), 0.3)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation[:, 2], np.array([1, 0, 1]) / np.sqrt(2))
    level = attitude(np.zeros(3), 0.3)
    np.testing.assert_allclose(level[:, 0], [np.cos(0.3), np.sin(0.3), 0], atol=1e-12)
    assert attitude(np.array([0, 0, -20.0]), 0.0)[2, 2] > 0  # never on its back


@settings(max_examples=60, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-1.4, 1.4), st.floats(30, 150))
def test_labels_stay_in_the_picture_and_out_of_the_panels(
    azimuth: float, elevation: float, distance: float
) -> None:
    """Wherever the target is: in sight, at the edge or behind the camera."""
    scene = scene_of([], [[150, 40, 10], [20, 150, 90]])
    done = progress(scene, flight([scene.depot]), [0, 1])
    x = np.array([100.0, 100, 100])
    aim = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
                    np.sin(elevation)])  # fmt: skip
    view = View(x - distance * aim, x, 55.0, (640, 360))
    blocked = [(400.0, 0.0, 640.0, 200.0), (0.0, 260.0, 200.0, 360.0), (0.0, 0.0, 230.0, 55.0)]
    image = Image.new("RGB", (640, 360))
    name_all(image, FleetProgress.alone(done), (0,), view, x[None], blocked)
    pixels = np.asarray(image)
    assert pixels.any()
    # Plates and letters; the target's ring may reach below a panel.
    label = pixels.any(axis=2) & np.any(pixels != overlay.TARGET, axis=2)
    assert not label[:, [0, -1]].any()
    for left, top, right, bottom in blocked:
        assert not label[int(top) : int(bottom), int(left) : int(right)].any()


def test_speed_bar_is_filled_in_proportion_to_speed() -> None:
    scene = scene_of([], [[150, 40, 10]], v_max=40.0)
    hud = overlay.Hud(scene, VideoSettings())
    widths = []
    for speed in (0.0, 10.0, 40.0, 50.0):
        image = Image.new("RGB", (1280, 720))
        hud.instruments(image, 1.0, speed, "to item 0", 10.0, "items 0 / 1")
        row = np.asarray(image)[634, 36:372].astype(int)
        widths.append(int(np.argmax(np.append(np.all(row == (70, 78, 88), axis=1), True))))
    assert widths == [1, 84, 336, 336]


def test_long_names_fit_the_cards() -> None:
    scene = Scene("n" * 100, 0, [[0, 0, 0], [9, 9, 9]], [1, 1, 1], [[5, 5, 5]], [])  # type: ignore[arg-type]
    image = Image.new("RGB", (640, 360))
    hud = overlay.Hud(scene, VideoSettings(size=(640, 360)))
    hud.card(image, [("n" * 100, overlay.WHITE), ("x" * 300, overlay.GREY)])
    hud.card(image, [("n" * 100, overlay.WHITE), ("segment 1: item 0", overlay.GREY)], 0.8, 0.33)
    assert not np.asarray(image)[:, -8:].any()


# Runs and the command line


def write_run(folder: Path, name: str = "segment") -> Path:
    scene = Scene.load(asset_path("scenes", "scenario_1.json"))
    folder.mkdir(exist_ok=True)
    scene.save(folder / "scene.json")
    flight([scene.depot, scene.depot + 2.0], slot=2, pause=10).save(folder / "trajectory.csv")
    result = {"order": [0, 2, 1, 3], "segment": 0, "success": True, "violations": []}
    (folder / f"{name}.json").write_text(json.dumps(result))
    return folder


def test_a_wrong_backend_gives_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "wrong")
    said = render_in_child(write_run(tmp_path / "run"))
    assert said is not None
    assert "MUJOCO_GL=wrong" in said
    assert "libegl1" in said
    assert f"python -m mjcollect.render --run {tmp_path / 'run'}" in said
    assert "Traceback" not in said
    assert "\n" not in said
    assert not list((tmp_path / "run").glob("*.mp4"))


def test_command_line_says_in_one_line_what_is_missing(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "mjcollect.render", "--run", str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert len(ran.stderr.strip().splitlines()) == 1
    assert "neither segment.json nor mission.json" in ran.stderr


@pytest.mark.parametrize("broken", ["scene.json", "trajectory.csv", "segment.json"])
def test_an_unreadable_run_is_refused(tmp_path: Path, broken: str) -> None:
    folder = write_run(tmp_path)
    (folder / broken).write_text("{}")
    with pytest.raises(UnreadableRun, match="not a readable run"):
        render_run(folder)


def test_importing_render_touches_no_gl() -> None:
    code = "import sys, mjcollect.render as r; assert 'mujoco' not in sys.modules"
    environment = {**os.environ, "MUJOCO_GL": "wrong"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


CLIP = """
import sys
from mjcollect.render import VideoSettings, render_run
for _ in range(2):  # another film between them must not change the second
    film = render_run(sys.argv[1], VideoSettings(fps=10, size=(480, 270)))
    render_run(sys.argv[2], VideoSettings(fps=10, size=(160, 90)))
    film.rename(film.with_name(f"{len(list(film.parent.glob('?.mp4')))}.mp4"))
"""


def test_a_clip_shows_quadrotor_and_path(tmp_path: Path, egl: dict[str, str]) -> None:
    box = [[60.0, 60.0, 0.0], [90.0, 90.0, 80.0]]
    scene = scene_of([box], [[60, 20, 30], [150, 150, 30]])
    flown = flight([scene.depot, scene.items[0]], slot=7, pause=5)
    one = Trajectory(flown.t[:1], flown.x[:1], flown.v[:1], flown.a[:1])
    result = {"order": [0, 1], "segment": 0, "success": True}
    failed = {"order": [0, 1], "success": False, "violations": [{"kind": "contact", "t": 0.0}]}
    for name, flew, found in (("segment", flown, result), ("mission", one, failed)):
        (tmp_path / name).mkdir()
        scene.save(tmp_path / name / "scene.json")
        flew.save(tmp_path / name / "trajectory.csv")
        (tmp_path / name / f"{name}.json").write_text(json.dumps(found))
    folders = [str(tmp_path / name) for name in ("segment", "mission")]
    subprocess.run([sys.executable, "-c", CLIP, *folders], env=egl, check=True)

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    video = mediapy.read_video(tmp_path / "segment" / "0.mp4")
    flown_frames = int(np.ceil(round(flown.duration * 10, 6))) + 1
    assert video.shape == (13 + flown_frames + 18, 270, 480, 3)
    assert video.metadata.fps == 10
    np.testing.assert_array_equal(video, mediapy.read_video(tmp_path / "segment" / "1.mp4"))
    frames = np.asarray(video).astype(int)
    middle = frames[13 + flown_frames // 2]
    assert middle.std() > 20
    assert np.abs(middle - frames[13 + 2]).mean() > 5  # the camera has moved on
    # The quadrotor's orange hull in the middle of the chase view.
    r, g, b = np.moveaxis(middle[100:220, 180:300], -1, 0)
    assert np.sum((r > 170) & (g > 50) & (g < 150) & (b < 90)) > 20
    # Its path in the overview at the end: viridis above the middle, which nothing else has there.
    last = frames[-1]
    colour = overlay.speed_colours(np.linalg.norm(flown.v, axis=1).max(), scene.v_max) * 255
    before = frames[2]
    like = np.abs(last - colour).max(axis=-1) < 60
    assert np.sum(like & (np.abs(before - colour).max(axis=-1) > 60)) > 30
    assert len(mediapy.read_video(tmp_path / "mission" / "mission.mp4")) == 13 + 1 + 18
    assert not list(tmp_path.glob("*/.*"))
