"""The frames of a video: opening on the whole scene, the flight from behind, the result."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter1d

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import progress
from mjcollect.render.camera import Picture, View, chase_eyes, framing
from mjcollect.render.name_tags import node_labels
from mjcollect.render.overlay import (
    COLLECTED,
    GREY,
    SHIELD,
    UAV,
    WHITE,
    Hud,
    Inset,
    Overview,
    heads_for,
    pill,
    speed_colours,
)
from mjcollect.render.scene_renderer import Stage
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

OPENING, FADE, HOLD, NOTICE = 1.3, 0.3, 1.8, 1.3  # s of video
BOOM = 24.0  # metres from the chase camera to the quadrotor
SPACING = 3.0  # metres between points of the drawn path
TRAIL_WIDTH = 0.09  # metres
CHASE_FOVY, OVERVIEW_FOVY = 55.0, 30.0
OVERVIEW_DIRECTION = np.array([1.0, 0.82, -0.72])


class Film:
    """Frames of one flight; the same flight gives the same frames."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        order: Sequence[int],
        *,
        segment: int | None = None,
        fps: float = 30,
        speed: float = 1.0,
        size: tuple[int, int] = (1280, 720),
        caption: str | None = None,
        samples: int = 0,
        shielded: Array | None = None,
    ) -> None:
        """Plan every frame; nothing is rendered yet. See `mjcollect.render.render_video`."""
        self._scene, self._trajectory, self._order = scene, trajectory, list(order)
        self._size, self._fps, self._caption, self._samples = size, fps, caption, samples
        self.progress = progress(scene, trajectory, order, segment)
        self._segment = segment
        self._shielded = np.empty((0, 2)) if shielded is None else shielded
        self._sample(speed)
        self._trail_points()
        self._views = self._chase_views()
        self._hud = Hud(scene, size, speed)
        self._wide = framing(scene.bounds, OVERVIEW_DIRECTION, OVERVIEW_FOVY, size, 0.92)
        self._overview = Overview(scene, self.progress, self._wide, self._trail, self._trail_speed)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._t) + round(OPENING * self._fps) + round(HOLD * self._fps)

    def frames(self) -> Generator[Picture]:
        """Pictures (H, W, 3) uint8, in order. Opens a renderer and closes it at the end."""
        with Stage(self._scene, self._size, samples=self._samples) as stage:
            yield from self._opening(stage)
            last: Picture | None = None
            for last in self._flight(stage, 0):
                yield last
            assert last is not None
            yield from self._result(stage, last)

    # Planning

    def _sample(self, speed: float) -> None:
        """State per flight frame, between rows where needed."""
        flown = self._trajectory
        count = math.ceil(flown.duration / speed * self._fps - 1e-9) + 1
        self._t = np.minimum(flown.t[0] + np.arange(count) * speed / self._fps, flown.t[-1])
        # Commands jump from slot to slot; a quadrotor takes about this long to turn.
        smooth = gaussian_filter1d(flown.a, 0.12 / self._scene.physics_step, axis=0, mode="nearest")
        self._x, self._v, self._a = (
            np.stack([np.interp(self._t, flown.t, column) for column in part.T], axis=1)
            for part in (flown.x, flown.v, smooth)
        )
        # Each frame stands for the time up to the next one, so that no slot is lost.
        begin, end = (self._t + off for off in (1e-9, speed / self._fps - 1e-9))
        acts = (self._shielded[:, 0] < end[:, None]) & (self._shielded[:, 1] > begin[:, None])
        self._shields = acts.any(axis=1)
        row = np.searchsorted(flown.t, self._t + 1e-9, side="right") - 1
        self._reached = np.array([self.progress.reached(int(k)) for k in row])

    def _trail_points(self) -> None:
        """Points at equal distances along the flown path, with the speed and time there."""
        flown = self._trajectory
        steps = np.linalg.norm(np.diff(flown.x, axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(steps)])
        pieces = max(1, math.ceil(travelled[-1] / SPACING))
        at = np.linspace(0.0, travelled[-1], pieces + 1)
        self._trail = np.stack([np.interp(at, travelled, c) for c in flown.x.T], axis=1)
        self._trail_speed = np.interp(at, travelled, np.linalg.norm(flown.v, axis=1))
        self._trail_time = np.interp(at, travelled, flown.t)
        self._trail_colours = speed_colours(self._trail_speed, self._scene.v_max)

    def _goal(self, reached: int) -> int:
        """The node flown to; the last one once all were reached."""
        return self.progress.targets[min(reached, len(self.progress.targets) - 1)]

    def _chase_views(self) -> list[View]:
        self._goals = np.array([self._scene.point(self._goal(int(k))) for k in self._reached])
        boom = BOOM * max(1.0, self._scene.uav_radius / 0.5)
        eyes, self._headings = chase_eyes(
            self._scene, self._x, self._v, self._goals, self._fps, boom
        )
        eyes[:, 2] = np.maximum(eyes[:, 2], self._scene.bounds[0, 2] + 1.0)
        reach = np.linalg.norm(eyes - self._x, axis=1, keepdims=True)
        looks = self._x + 0.10 * reach * [0.0, 0.0, 1.0]
        return [View(e, k, CHASE_FOVY, self._size) for e, k in zip(eyes, looks, strict=True)]

    # Parts of the film

    def _opening(self, stage: Stage) -> Generator[Picture]:
        image = self._plain(stage, 0, 0)
        draw = ImageDraw.Draw(image, "RGBA")
        self._hud.card(draw, [(self._scene.name, WHITE), *((line, GREY) for line in self._plan())])
        first = next(self._flight(stage, 0))
        yield from _fade(
            np.asarray(image), first, round(OPENING * self._fps), FADE * self._fps, True
        )

    def _result(self, stage: Stage, last: Picture) -> Generator[Picture]:
        reached = int(self._reached[-1])
        image = self._plain(stage, reached, len(self._trail) - 1)
        done = reached == len(self.progress.targets)
        if self._caption is not None:
            headline = self._caption
        elif not done:
            headline = "not completed"
        elif self._segment is None:
            headline = "mission complete"
        else:
            goal = self.progress.targets[-1]
            headline = "arrived at the depot" if goal < 0 else f"{node_name(goal)} collected"
        items = len(self.progress.collected(reached))
        lines = [
            (headline, UAV if not done else COLLECTED if self._caption is None else WHITE),
            (self._plan()[0], GREY),
            (f"time {self._trajectory.duration:.2f} s", WHITE),
            (f"path {self._trajectory.length:.0f} m", WHITE),
            (f"items {items} / {len(self._order)}", WHITE),
        ]
        if len(self._shielded):
            seconds = float(np.sum(self._shielded[:, 1] - self._shielded[:, 0]))
            lines.append((f"shield acted for {seconds:.1f} s", SHIELD))
        self._hud.card(ImageDraw.Draw(image, "RGBA"), lines)
        yield from _fade(last, np.asarray(image), round(HOLD * self._fps), FADE * self._fps, False)

    def _flight(self, stage: Stage, start: int) -> Generator[Picture]:
        scene, shown = self._scene, -1
        inset = Inset(self._overview, self._size, round(0.27 * self._size[0]))
        margin = round(20 * self._size[1] / 720)
        corner = (self._size[0] - inset.size[0] - margin, margin)
        unit = self._size[1] / 720
        panels = (226 if len(self._shielded) else 190) * unit
        blocked = [
            (corner[0] - 4, 0.0, float(self._size[0]), margin + inset.size[1] + 4.0),
            (0.0, self._size[1] - panels, 400 * unit, float(self._size[1])),
            (0.0, 0.0, 460 * unit, 110 * unit),
        ]
        still: Picture | None = None
        for frame in range(start, len(self._t)):
            reached = int(self._reached[frame])
            stage.mark(self.progress, reached)
            if still is None or reached != shown:
                still, shown = stage.still(self._wide), reached
            x, view = self._x[frame], self._views[frame]
            point = int(np.searchsorted(self._trail_time, self._t[frame], side="right")) - 1
            stage.place(x, self._a[frame], self._headings[frame], frame)
            trail = np.concatenate([self._trail[: point + 1], x[None]])
            colours = self._trail_colours[: point + 1]
            goal = self._goals[frame]
            image = Image.fromarray(stage.chase(view, trail, colours, TRAIL_WIDTH, goal))
            node_labels(image, scene, self.progress, reached, view, x, blocked)
            self._instruments(image, frame, reached)
            draw = ImageDraw.Draw(image, "RGBA")
            left, top = corner
            draw.rectangle(
                (left - 3, top - 3, left + inset.size[0] + 2, top + inset.size[1] + 2), WHITE
            )
            image.paste(inset.picture(still, reached, point, x), corner)
            yield np.asarray(image)

    def _instruments(self, image: Image.Image, frame: int, reached: int) -> None:
        draw = ImageDraw.Draw(image, "RGBA")
        goal = self._goal(reached)
        self._hud.title(draw, self._leg(reached))
        self._hud.instruments(
            image,
            float(self._t[frame] - self._trajectory.t[0]),
            float(np.linalg.norm(self._v[frame])),
            heads_for(goal),
            float(np.linalg.norm(self._goals[frame] - self._x[frame])),
            f"items {len(self.progress.collected(reached))} / {len(self._order)}",
        )
        if self._shields[frame]:
            self._hud.shield(draw)
        if reached and frame - int(np.argmax(self._reached == reached)) < NOTICE * self._fps:
            node = self.progress.targets[reached - 1]
            text = "arrived at the depot" if node < 0 else f"{node_name(node)} collected"
            unit = self._size[1] / 720
            pill(
                draw,
                (self._size[0] / 2, self._size[1] - 60 * unit),
                text,
                round(24 * unit),
                COLLECTED,
            )

    def _plain(self, stage: Stage, reached: int, point: int) -> Image.Image:
        """The whole scene, full frame, with the path up to `point`."""
        stage.mark(self.progress, reached)
        image = Image.fromarray(stage.still(self._wide))
        unit = self._size[1] / 720
        self._overview.path(image, 0, point, 4 * unit)
        self._overview.nodes(image, reached, 11 * unit)
        self._overview.uav(image, self._trail[point], 7 * unit)
        return image

    def _leg(self, reached: int) -> str:
        """'segment 2: item 0 → item 2' for the segment being flown."""
        index = min(reached, len(self.progress.targets) - 1)
        nodes = (self.progress.start, *self.progress.targets)
        number = self.progress.first_segment + index
        return f"segment {number}: {node_name(nodes[index])} → {node_name(nodes[index + 1])}"

    def _plan(self) -> list[str]:
        """What is flown, for the cards."""
        scene = self._scene
        limits = f"limits {scene.v_max:g} m/s, {scene.a_max:g} m/s²"
        if self._segment is not None:
            return [self._leg(0), limits]
        names = [str(node) for node in self._order]
        if len(names) > 10:
            names = [*names[:6], "…", *names[-3:]]
        return [
            f"mission: {len(self._order)} items",
            " → ".join(["depot", *names, "depot"]),
            limits,
        ]


def _fade(one: Picture, two: Picture, count: int, length: float, late: bool) -> Generator[Picture]:
    """`count` frames from picture one to picture two, blended late or early."""
    for k in range(count):
        share = (k - (count - length)) / length if late else (k + 1) / length
        weight = float(np.clip(share, 0.0, 1.0))
        mixed = one * (1.0 - weight) + two * weight
        yield mixed.astype(np.uint8)
