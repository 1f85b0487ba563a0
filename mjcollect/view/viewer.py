"""Plays a scene or a recorded flight in MuJoCo's passive viewer: nothing is simulated.

Import this only where there is a display.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

import mujoco
import mujoco.viewer
import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import behind, framing
from mjcollect.render.film.frames import OVERVIEW_DIRECTION
from mjcollect.render.film.track import Track
from mjcollect.render.fleet import UAV_SCALE, FleetProgress
from mjcollect.render.flown_model import FlownModel, Pose
from mjcollect.render.overlay import uav_colour
from mjcollect.scene.air import Air
from mjcollect.scene.mjcf import build
from mjcollect.scene.scene import Scene
from mjcollect.view.playback import KEYS, Playback

RATE = 60.0  # The flight is known so many times per second of flight.
REFRESH = 1 / 40  # The window gets a new picture after this time (s).
THICK, THIN = 4.0, 1.5  # Paths, and lines to the ground, are so many pixels wide.
MOVING_RGBA = np.array([0.50, 0.36, 0.86, 1.0], dtype=np.float32)
FOOT = np.array([0.95, 0.95, 0.95])  # Lines from items to the ground have this colour.
SIZE = (1280, 800)  # Of about this shape is a window (pixels).
CLOSING = 10.0  # The window's thread gets so long to end (s).


def show_scene(scene: Scene, seconds: float | None = None) -> None:
    """Shows a scene with a quadrotor at the depot until the window is closed.

    Args:
        scene: what to show. seconds: after which the window closes by itself.
    """
    root = build(scene, visual_scale=UAV_SCALE)
    model = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
    data = mujoco.MjData(model)
    data.qpos[:3] = scene.depot
    mujoco.mj_forward(model, data)
    begin = time.monotonic()
    with _window(model, data, scene, lambda key: None) as (viewer, goes_on):
        viewer.set_texts(_text([("scene", scene.name), KEYS[-1]]))
        with viewer.lock():
            _feet(viewer.user_scn, scene)
        viewer.sync()
        while goes_on() and not _over(begin, seconds):
            time.sleep(REFRESH)
            viewer.sync()


def show_flight(
    fleet: FleetProgress, air: Air | None = None, speed: float = 1.0, seconds: float | None = None
) -> None:
    """Plays flights in real time until the window is closed; see KEYS.

    Args:
        fleet: the flights. air: what disturbed them. speed: seconds of flight per second.
        seconds: after which the window closes by itself.
    """
    flown, playback = _Flown(fleet, air), Playback(fleet.duration, speed)
    begin = now = time.monotonic()
    pressed: list[int] = []  # by the viewer's thread
    with _window(flown.model, flown.data, fleet.scene, pressed.append) as (viewer, goes_on):
        while goes_on() and not _over(begin, seconds):
            before, now = now, time.monotonic()
            playback.advance(now - before)
            while pressed:
                playback.press(pressed.pop(0))
            with viewer.lock():
                flown.put(playback.time, viewer.user_scn)
            state = "paused" if playback.paused else f"{playback.speed:g} x"
            viewer.set_texts(_text([*flown.says(playback.time), ("speed", state), *KEYS]))
            viewer.sync()
            time.sleep(max(0.0, REFRESH - (time.monotonic() - now)))


class _Flown:
    """Puts quadrotors, paths and moving boxes where they were at a time of the flight."""

    def __init__(self, fleet: FleetProgress, air: Air | None) -> None:
        self._fleet, self._moving = fleet, () if air is None else air.moving
        shown = FlownModel(fleet)
        self.model, self.data, self._shown = shown.model, shown.data, shown
        begin = fleet.flights[fleet.lead].trajectory.t[0]
        steps = math.ceil(fleet.duration * RATE - 1e-9)
        self._t = begin + np.minimum(np.arange(steps + 1) / RATE, fleet.duration)
        count = range(len(fleet.flights))
        self._tracks = [Track(fleet, m, self._t, 1 / RATE) for m in count]
        self._headings = [
            behind(fleet.scene, track.x, track.v, track.goals, RATE)[0] for track in self._tracks
        ]

    def put(self, moment: float, extra: mujoco.MjvScene) -> None:
        """Shows a moment (s of flight); paths and moving boxes are put into `extra`."""
        frame = self._frame(moment)
        pairs = zip(self._tracks, self._headings, strict=True)
        poses = [Pose(track.x[frame], track.a[frame], heading[frame]) for track, heading in pairs]
        self._shown.mark(self._reached(frame))
        self._shown.place(poses, frame)
        extra.ngeom = 0
        _feet(extra, self._fleet.scene)
        for box in self._moving:
            _box(extra, box.box_at(float(self._t[frame])))
        floor = self._fleet.scene.bounds[0, 2]
        room = (extra.maxgeom - extra.ngeom) // len(self._tracks) - 2
        for m, track in enumerate(self._tracks):
            colour = np.divide(uav_colour(self._fleet, m), 255)
            _line(extra, track.x[frame], np.array([*track.x[frame, :2], floor]), colour, THIN)
            last = int(track.point(self._t[frame]))
            step = -(-len(track.trail) // room)  # So many points are one piece, to have room.
            kept = np.arange(0, last + 1, step)
            points = np.concatenate([track.trail[kept], track.x[frame, None]])
            for a, b, colour in zip(points[:-1], points[1:], track.colours[kept], strict=True):
                _line(extra, a, b, colour, THICK)

    def says(self, moment: float) -> list[tuple[str, str]]:
        """Says what the moment is, in pairs of texts."""
        frame = self._frame(moment)
        speeds = [float(np.linalg.norm(track.v[frame])) for track in self._tracks]
        items = self._fleet.collected(self._reached(frame))
        return [
            ("time", f"{moment:.1f} / {self._fleet.duration:.1f} s"),
            ("m/s", "  ".join(f"{speed:.0f}" for speed in speeds)),
            ("items", f"{items} / {len(self._fleet.scene.items)}"),
        ]

    def _frame(self, moment: float) -> int:
        return min(math.ceil(moment * RATE - 1e-9), len(self._t) - 1)

    def _reached(self, frame: int) -> list[int]:
        return [int(track.reached[frame]) for track in self._tracks]


@contextmanager
def _window(
    model: mujoco.MjModel, data: mujoco.MjData, scene: Scene, key: Callable[[int], None]
) -> Iterator[tuple[mujoco.viewer.Handle, Callable[[], bool]]]:
    """Opens the window, which looks at the whole scene from above one corner, and closes it.

    Gives the window, and a function that says whether it is open and no Ctrl-C was pressed.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; at the end, since MuJoCo's viewer, interrupted while
            it opens or draws, would neither go on nor close.
    """
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    before = signal.signal(signal.SIGINT, stop)
    threads = set(threading.enumerate())
    viewer = mujoco.viewer.launch_passive(
        model, data, key_callback=key, show_left_ui=False, show_right_ui=False
    )
    view = framing(scene.bounds, OVERVIEW_DIRECTION, float(model.vis.global_.fovy), SIZE)
    offset = view.target - view.eye
    try:
        with viewer.lock():
            viewer.cam.lookat[:] = view.target
            viewer.cam.distance = float(np.linalg.norm(offset))
            viewer.cam.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
            viewer.cam.elevation = np.degrees(np.arcsin(offset[2] / viewer.cam.distance))
        yield viewer, lambda: viewer.is_running() and not stopped
    finally:
        viewer.close()
        # MuJoCo's issue 790: a program that ends before the window's thread does ends by SIGSEGV.
        for thread in set(threading.enumerate()) - threads:
            thread.join(CLOSING)
        signal.signal(signal.SIGINT, before)
    if stopped:
        raise KeyboardInterrupt


def _over(begin: float, seconds: float | None) -> bool:
    return seconds is not None and time.monotonic() - begin >= seconds


def _text(rows: Sequence[tuple[str, str]]) -> tuple[None, None, str, str]:
    """Returns rows of two texts as the viewer takes them, for the top left corner."""
    return None, None, "\n".join(row[0] for row in rows), "\n".join(row[1] for row in rows)


def _feet(extra: mujoco.MjvScene, scene: Scene) -> None:
    """Draws lines from items and depot to the ground, for depth."""
    for node in scene.nodes:
        point = scene.point(node)
        _line(extra, point, np.array([*point[:2], scene.bounds[0, 2]]), FOOT, THIN)


def _line(extra: mujoco.MjvScene, a: Array, b: Array, colour: Array, width: float) -> None:
    geom, kind = extra.geoms[extra.ngeom], mujoco.mjtGeom.mjGEOM_LINE
    rgba = np.array([*colour, 1.0], dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
    mujoco.mjv_connector(geom, kind, width, a, b)
    extra.ngeom += 1


def _box(extra: mujoco.MjvScene, box: Array) -> None:
    geom, kind = extra.geoms[extra.ngeom], mujoco.mjtGeom.mjGEOM_BOX
    half, turn = (box[1] - box[0]) / 2, np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, kind, half, box.mean(axis=0), turn, MOVING_RGBA)
    extra.ngeom += 1
