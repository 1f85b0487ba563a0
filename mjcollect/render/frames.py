"""Makes the frames of a film: opening on the whole scene, flight from behind, result."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import closing

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter1d

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, marks
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import Picture, View, chase_eyes, framing
from mjcollect.render.overlay import (
    COLLECTED,
    GREY,
    SHIELD,
    UAV,
    WHITE,
    Colour,
    Hud,
    Overview,
    draw_moving_box,
    node_labels,
    pill,
    speed_colours,
)
from mjcollect.render.scene_renderer import Stage
from mjcollect.render.settings import VideoSettings
from mjcollect.scene.air import Air
from mjcollect.scene.order import DEPOT, node_name

# The first picture, each fade, the last picture and the notice of an arrival last so long (s).
OPENING, FADE, HOLD, NOTICE = 1.3, 0.3, 1.8, 1.3
BOOM = 24.0  # The chase camera follows a body of up to 0.5 m radius at this distance (m).
SPACING = 3.0  # Points of the drawn path are so far apart (m).
TURN = 0.12  # A quadrotor turns in about this time (s); recorded commands jump from slot to slot.
CHASE_FOVY, OVERVIEW_FOVY = 55.0, 30.0  # The cameras have these fields of view (degrees).
OVERVIEW_DIRECTION = np.array([1.0, 0.82, -0.72])


class Film:
    """Makes the frames of one flight; the same flight gives the same frames."""

    def __init__(
        self, progress: Progress, settings: VideoSettings, shielded: Array, air: Air | None = None
    ) -> None:
        """Plans every frame; nothing is rendered yet.

        Args:
            progress: what was flown. settings: how it is shown.
            shielded: (n, 2) seconds from begin to end of the times in which the shield acted.
            air: what disturbed the flight; None if nothing did.
        """
        self._moving = () if air is None else air.moving
        self._air = air if air is not None and np.any(air.push) else None
        self._scene, self._trajectory = progress.scene, progress.trajectory
        self._progress, self._settings, self._shielded = progress, settings, shielded
        self._opening, self._hold = round(OPENING * settings.fps), round(HOLD * settings.fps)
        self._sample()
        self._trail_points()
        self._views = self._chase_views()
        self._hud = Hud(self._scene, settings)
        bounds, size = self._scene.bounds, settings.size
        self._wide = framing(bounds, OVERVIEW_DIRECTION, OVERVIEW_FOVY, size, 0.92)
        self._overview = Overview(progress, self._wide, self._trail, self._trail_colours)

    def __len__(self) -> int:
        """Returns the number of frames."""
        return self._opening + len(self._t) + self._hold

    def frames(self) -> Generator[Picture]:
        """Yields pictures (H, W, 3) uint8 in order, from a renderer that it opens and closes."""
        fade = FADE * self._settings.fps
        with closing(Stage(self._scene, self._settings)) as stage:
            title = [(self._scene.name, WHITE), *((line, GREY) for line in self._plan())]
            opening, flight = self._still(stage, 0, 0, title), self._flight(stage)
            shown = next(flight)
            late = np.arange(self._opening, dtype=np.float64) - (self._opening - fade)
            yield from _fade(opening, shown, late / fade)
            yield shown
            for shown in flight:
                yield shown
            reached, end = int(self._reached[-1]), len(self._trail) - 1
            result = self._still(stage, reached, end, self._result(reached))
            yield from _fade(shown, result, np.arange(1, self._hold + 1) / fade)

    # Planning

    def _sample(self) -> None:
        """Finds the state in each frame of the flight, between rows where needed."""
        flown, speed, fps = self._trajectory, self._settings.speed, self._settings.fps
        count = math.ceil(flown.duration / speed * fps - 1e-9) + 1
        self._t = np.minimum(flown.t[0] + np.arange(count) * speed / fps, flown.t[-1])
        smooth = gaussian_filter1d(flown.a, TURN / self._scene.physics_step, axis=0, mode="nearest")
        self._x, self._v, self._a = (
            interpolate(part, flown.t, self._t) for part in (flown.x, flown.v, smooth)
        )
        # Each frame stands for the time up to the next one, so that no slot is lost.
        begin, end = (self._t[:, None] + off for off in (1e-9, speed / fps - 1e-9))
        acts = (self._shielded[:, 0] < end) & (self._shielded[:, 1] > begin)
        self._shields = acts.any(axis=1)
        rows = np.searchsorted(flown.t, self._t + 1e-9, side="right") - 1
        self._reached = np.searchsorted(self._progress.rows, rows, side="right")

    def _trail_points(self) -> None:
        """Finds points at equal distances along the flown path, with the time and colour there."""
        flown = self._trajectory
        travelled = marks(flown.x)
        pieces = max(1, math.ceil(travelled[-1] / SPACING))
        at = np.linspace(0.0, travelled[-1], pieces + 1)
        self._trail = interpolate(flown.x, travelled, at)
        speed = np.interp(at, travelled, np.linalg.norm(flown.v, axis=1))
        self._trail_time = np.interp(at, travelled, flown.t)
        self._trail_colours = speed_colours(speed, self._scene.v_max)

    def _chase_views(self) -> list[View]:
        """Returns the camera behind the quadrotor in each frame; sets goals and headings too."""
        scene, x, settings = self._scene, self._x, self._settings
        goals = [scene.point(self._progress.goal(reached)) for reached in self._reached]
        self._goals = np.array(goals)
        boom = BOOM * max(1.0, scene.uav_radius / 0.5)
        eyes, self._headings = chase_eyes(scene, x, self._v, self._goals, settings.fps, boom)
        eyes[:, 2] = np.maximum(eyes[:, 2], scene.bounds[0, 2] + 1.0)
        reach = np.linalg.norm(eyes - x, axis=1, keepdims=True)
        looks = x + 0.10 * reach * [0.0, 0.0, 1.0]
        return [View(e, k, CHASE_FOVY, settings.size) for e, k in zip(eyes, looks, strict=True)]

    # Parts of the film

    def _still(
        self, stage: Stage, reached: int, point: int, card: list[tuple[str, Colour]]
    ) -> Picture:
        """Returns the whole scene, full frame, with the path up to `point` and a card of text."""
        unit = self._settings.unit
        stage.mark(self._progress, reached)
        image = Image.fromarray(stage.still(self._wide))
        time = float(self._trail_time[point])
        for box in self._moving:
            draw_moving_box(image, self._wide, box.box_at(time), 2 * unit)
        self._overview.path(image, 0, point, 4 * unit)
        self._overview.nodes(image, reached, 11 * unit)
        self._overview.uav(image, self._trail[point], 7 * unit)
        self._hud.card(image, card)
        return np.asarray(image)

    def _flight(self, stage: Stage) -> Generator[Picture]:
        """Yields the frames from behind the quadrotor, with instruments and the overview inset."""
        (width, height), unit = self._settings.size, self._settings.unit
        inset_width, inset_height = self._overview.inset_size
        top = round(20 * unit)
        left = width - inset_width - top
        panels = (226 if len(self._shielded) else 190) * unit
        blocked = [
            (left - 4.0, 0.0, float(width), top + inset_height + 4.0),
            (0.0, height - panels, (400 if self._air is None else 584) * unit, float(height)),
            (0.0, 0.0, 460 * unit, 110 * unit),
        ]
        shown = -1
        for frame, reached in enumerate(map(int, self._reached)):
            if reached != shown:
                stage.mark(self._progress, reached)
                still, shown = stage.still(self._wide), reached
            x, view = self._x[frame], self._views[frame]
            point = int(np.searchsorted(self._trail_time, self._t[frame], side="right")) - 1
            time = float(self._t[frame])
            moving = [box.box_at(time) for box in self._moving]
            stage.place(x, self._a[frame], self._headings[frame], frame)
            trail = np.concatenate([self._trail[: point + 1], x[None]])
            colours = self._trail_colours[: point + 1]
            image = Image.fromarray(stage.chase(view, trail, colours, self._goals[frame], moving))
            node_labels(image, self._progress, reached, view, x, blocked)
            draw = ImageDraw.Draw(image, "RGBA")
            self._instruments(image, draw, frame, reached)
            draw.rectangle(
                (left - 3, top - 3, left + inset_width + 2, top + inset_height + 2), WHITE
            )
            image.paste(self._overview.inset(still, reached, point, x, moving), (left, top))
            yield np.asarray(image)

    def _instruments(
        self, image: Image.Image, draw: ImageDraw.ImageDraw, frame: int, reached: int
    ) -> None:
        """Draws the plates of a frame and, for a while after each arrival, what was reached."""
        (width, height), unit = self._settings.size, self._settings.unit
        flown = [(self._scene.name, WHITE), (self._progress.segment_title(reached), GREY)]
        self._hud.card(image, flown, 0.8, 0.33)
        self._hud.instruments(
            image,
            float(self._t[frame] - self._trajectory.t[0]),
            float(np.linalg.norm(self._v[frame])),
            f"to {node_name(self._progress.goal(reached))}",
            float(np.linalg.norm(self._goals[frame] - self._x[frame])),
            self._items(reached),
        )
        if self._air is not None:
            push = self._air.pushes(self._t[frame : frame + 1])[0]
            self._hud.push(image, push, self._views[frame])
        if self._shields[frame]:
            self._hud.shield(draw)
        arrived = int(np.argmax(self._reached == reached))  # the first frame since the arrival
        if reached and frame - arrived < NOTICE * self._settings.fps:
            text = _arrival(self._progress.targets[reached - 1])
            pill(draw, (width / 2, height - 60 * unit), text, round(24 * unit), COLLECTED)

    def _items(self, reached: int) -> str:
        return f"items {len(self._progress.collected(reached))} / {len(self._progress.order)}"

    def _plan(self) -> list[str]:
        """Says what is flown, for the cards."""
        scene, order = self._scene, self._progress.order
        limits = f"limits {scene.v_max:g} m/s, {scene.a_max:g} m/s²"
        if self._progress.segment is not None:
            return [self._progress.segment_title(0), limits]
        names = [str(node) for node in order]
        if len(names) > 10:
            names = [*names[:6], "…", *names[-3:]]
        tour = " → ".join(["depot", *names, "depot"])
        return [f"mission: {len(order)} items", tour, limits]

    def _result(self, reached: int) -> list[tuple[str, Colour]]:
        """Says how the flight ended, for the last card."""
        done, caption = self._progress, self._settings.caption
        colour = UAV if not done.complete else COLLECTED if caption is None else WHITE
        if caption is None:
            if not done.complete:
                caption = "not completed"
            else:
                caption = "mission complete" if done.segment is None else _arrival(done.targets[-1])
        lines = [
            (caption, colour),
            (self._plan()[0], GREY),
            (f"time {self._trajectory.duration:.2f} s", WHITE),
            (f"path {self._trajectory.length:.0f} m", WHITE),
            (self._items(reached), WHITE),
        ]
        if len(self._shielded):
            seconds = float(np.sum(self._shielded[:, 1] - self._shielded[:, 0]))
            lines.append((f"shield acted for {seconds:.1f} s", SHIELD))
        return lines


def _arrival(node: int) -> str:
    return "arrived at the depot" if node == DEPOT else f"{node_name(node)} collected"


def _fade(one: Picture, two: Picture, shares: Array) -> Generator[Picture]:
    """Blends picture one into picture two, by one share of picture two a frame."""
    for share in np.clip(shares, 0.0, 1.0):
        yield (one * (1.0 - share) + two * share).astype(np.uint8)
