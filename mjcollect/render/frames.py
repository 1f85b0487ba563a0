"""Makes the frames of a film: opening on the whole scene, flight from behind, result."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import closing

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter1d

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, marks
from mjcollect.render.camera import Picture, View, behind, chase_views, framing
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.labels import name_all
from mjcollect.render.overlay import (
    COLLECTED,
    GREY,
    SHIELD,
    UAV,
    WHITE,
    Colour,
    FleetRow,
    Hud,
    Overview,
    draw_moving_box,
    on_panel,
    pill,
    speed_colours,
    uav_colour,
)
from mjcollect.render.scene_renderer import Pose, Stage
from mjcollect.render.settings import VideoSettings
from mjcollect.scene.air import Air
from mjcollect.scene.order import DEPOT, node_name

# The first picture, each fade, the last picture and the notice of an arrival last so long (s).
OPENING, FADE, HOLD, NOTICE = 1.3, 0.3, 1.8, 1.3
SPACING = 3.0  # Points of the drawn path are so far apart (m);
# of those of UAVs that are not followed, farther than this from the camera (m), one in so many.
NEAR, COARSE = 120.0, 4
TURN = 0.12  # A quadrotor turns in about this time (s); recorded commands jump from slot to slot.
OVERVIEW_FOVY = 30.0  # The camera on the whole scene has this field of view (degrees).
OVERVIEW_DIRECTION = np.array([1.0, 0.82, -0.72])
MOST_TOURS = 8  # The first card names the tours of up to so many UAVs.


class Track:
    """Holds where one UAV is in each frame, and points along its path.

    Attributes:
        x, v, a: (F, 3) position, velocity and acceleration in m and s.
        shields: (F,) whether the shield acts. reached: (F,) number of targets reached.
        goals: (F, 3) what it flies to, in metres.
        trail: (N, 3) points at equal distances along its path. trail_time: (N,) when it was there.
    """

    def __init__(self, fleet: FleetProgress, m: int, t: Array, span: float) -> None:
        """Finds the state of flight `m` at times t (F,), between rows where needed.

        Each frame stands for the `span` seconds up to the next one, so that no slot is lost.
        """
        done, shielded = fleet.flights[m], fleet.shielded[m]
        flown, step = done.trajectory, done.scene.physics_step
        # Who is home rests until the last one is.
        rest = max(0, math.ceil((t[-1] - flown.t[-1]) / step - 1e-6))
        rows = np.append(flown.t, flown.t[-1] + step * np.arange(1, rest + 1))
        x = np.concatenate([flown.x, np.tile(flown.x[-1], (rest, 1))])
        v, a = (np.concatenate([part, np.zeros((rest, 3))]) for part in (flown.v, flown.a))
        smooth = gaussian_filter1d(a, TURN / step, axis=0, mode="nearest")
        self.x, self.v, self.a = (interpolate(part, rows, t) for part in (x, v, smooth))
        begin, end = (t[:, None] + off for off in (1e-9, span - 1e-9))
        acts = (shielded[:, 0] < end) & (shielded[:, 1] > begin)
        self.shields = np.asarray(acts.any(axis=1))
        at = np.searchsorted(rows, t + 1e-9, side="right") - 1
        self.reached = np.searchsorted(done.rows, at, side="right")
        self.goals = np.array([done.scene.point(done.goal(count)) for count in self.reached])

        travelled = marks(flown.x)
        pieces = max(1, math.ceil(travelled[-1] / SPACING))
        places = np.linspace(0.0, travelled[-1], pieces + 1)
        self.trail = interpolate(flown.x, travelled, places)
        self.trail_time = np.interp(places, travelled, flown.t)
        speed = np.interp(places, travelled, np.linalg.norm(flown.v, axis=1))
        self.colours = speed_colours(speed, fleet.scene.v_max)
        if not fleet.is_alone:
            self.colours = np.tile(np.divide(uav_colour(fleet, m), 255), (len(places), 1))

    def point(self, time: float) -> int:
        """Returns the last point of the trail that was passed at a time (s)."""
        return int(np.searchsorted(self.trail_time, time, side="right")) - 1

    def flown(self, frame: int, time: float, eye: Array | None) -> tuple[Array, Array]:
        """Returns the path (P, 3) up to a frame, and RGB of its pieces.

        If there is an eye (3,), it is coarse where it is far from it.
        """
        kept = np.arange(self.point(time) + 1)
        if eye is not None:
            near = np.linalg.norm(self.trail[kept] - eye, axis=1) < NEAR
            kept = kept[near | (kept % COARSE == 0) | (kept == kept[-1])]
        return np.concatenate([self.trail[kept], self.x[frame, None]]), self.colours[kept]


class Film:
    """Makes the frames of one flight or a fleet's; the same flights give the same frames."""

    def __init__(
        self, fleet: FleetProgress, settings: VideoSettings, air: Air | None = None
    ) -> None:
        """Plans every frame; nothing is rendered yet.

        Args:
            fleet: what was flown. settings: how it is shown.
            air: what disturbed the flight; None if nothing did.
        """
        self._moving = () if air is None else air.moving
        self._air = air if air is not None and np.any(air.push) else None
        self._scene, self._fleet, self._settings = fleet.scene, fleet, settings
        self._opening, self._hold = round(OPENING * settings.fps), round(HOLD * settings.fps)
        self._lead = lead = fleet.lead
        flown = fleet.flights[lead].trajectory
        speed, fps = settings.speed, settings.fps
        count = math.ceil(flown.duration / speed * fps - 1e-9) + 1
        self._t = np.minimum(flown.t[0] + np.arange(count) * speed / fps, flown.t[-1])
        self._tracks = [Track(fleet, m, self._t, speed / fps) for m in range(len(fleet.flights))]
        self._views = self._chase_views()
        self._hud = Hud(self._scene, settings)
        bounds, size = self._scene.bounds, settings.size
        self._wide = framing(bounds, OVERVIEW_DIRECTION, OVERVIEW_FOVY, size, 0.92)
        trails = [(track.trail, track.colours) for track in self._tracks]
        self._overview = Overview(fleet, self._wide, trails)

    def __len__(self) -> int:
        """Returns the number of frames."""
        return self._opening + len(self._t) + self._hold

    def frames(self) -> Generator[Picture]:
        """Yields pictures (H, W, 3) uint8 in order, from a renderer that it opens and closes."""
        fade = FADE * self._settings.fps
        with closing(Stage(self._fleet, self._settings)) as stage:
            title = [(self._scene.name, WHITE), *self._plan()]
            start = [0] * len(self._tracks)
            opening, flight = self._still(stage, start, start, title), self._flight(stage)
            shown = next(flight)
            late = np.arange(self._opening, dtype=np.float64) - (self._opening - fade)
            yield from _fade(opening, shown, late / fade)
            yield shown
            for shown in flight:
                yield shown
            ends = [len(track.trail) - 1 for track in self._tracks]
            reached = self._reached(len(self._t) - 1)
            result = self._still(stage, reached, ends, self._result(reached))
            yield from _fade(shown, result, np.arange(1, self._hold + 1) / fade)

    def _reached(self, frame: int) -> tuple[int, ...]:
        """Returns how many targets each flight has reached in a frame, (M,)."""
        return tuple(int(track.reached[frame]) for track in self._tracks)

    def _chase_views(self) -> list[View]:
        """Returns the camera behind the lead in each frame; sets the headings of all too."""
        scene, lead, settings = self._scene, self._tracks[self._lead], self._settings
        views, heading = chase_views(scene, lead.x, lead.v, lead.goals, settings.fps, settings.size)
        self._headings = [
            heading
            if track is lead
            else behind(scene, track.x, track.v, track.goals, settings.fps)[0]
            for track in self._tracks
        ]
        return views

    # Parts of the film

    def _still(
        self, stage: Stage, reached: Sequence[int], last: Sequence[int],
        card: list[tuple[str, Colour]],
    ) -> Picture:  # fmt: skip
        """Returns the whole scene, full frame, with paths up to point `last` (M,) and a card."""
        unit = self._settings.unit
        stage.mark(reached)
        image = Image.fromarray(stage.still(self._wide))
        lead = self._tracks[self._lead]
        time = float(lead.trail_time[last[self._lead]])
        for box in self._moving:
            draw_moving_box(image, self._wide, box.box_at(time), 2 * unit)
        self._overview.paths(image, last, 4 * unit)
        self._overview.nodes(image, reached, 11 * unit)
        xs = np.array([track.trail[k] for track, k in zip(self._tracks, last, strict=True)])
        self._overview.uavs(image, xs, 7 * unit)
        self._hud.card(image, card)
        return np.asarray(image)

    def _flight(self, stage: Stage) -> Generator[Picture]:
        """Yields the frames from behind the lead, with instruments and the overview inset."""
        (width, height), unit = self._settings.size, self._settings.unit
        lead, alone = self._tracks[self._lead], self._fleet.is_alone
        inset_width, inset_height = self._overview.inset_size
        top = round(20 * unit)
        left = width - inset_width - top
        panels = (226 if len(self._fleet.shielded[self._lead]) else 190) * unit
        blocked = [
            (left - 4.0, 0.0, float(width), top + inset_height + 4.0),
            (0.0, height - panels, (400 if self._air is None else 584) * unit, float(height)),
            (0.0, 0.0, 460 * unit, 110 * unit),
        ]
        if not alone:
            plate = self._hud.fleet_place(len(self._tracks))[:2]
            blocked.append((*plate, float(width), float(height)))
        shown: tuple[int, ...] = ()
        for frame, view in enumerate(self._views):
            reached, time = self._reached(frame), float(self._t[frame])
            if reached != shown:
                stage.mark(reached)
                still, shown = stage.still(self._wide), reached
            moving = [box.box_at(time) for box in self._moving]
            stage.place(self._poses(frame), frame)
            trails = [
                track.flown(frame, time, None if track is lead else view.eye)
                for track in self._tracks
            ]
            image = Image.fromarray(stage.chase(view, trails, lead.goals[frame], moving))
            xs = np.array([track.x[frame] for track in self._tracks])
            name_all(image, self._fleet, reached, view, xs, blocked)
            draw = ImageDraw.Draw(image, "RGBA")
            self._instruments(image, draw, frame, reached)
            draw.rectangle(
                (left - 3, top - 3, left + inset_width + 2, top + inset_height + 2), WHITE
            )
            last = [track.point(time) for track in self._tracks]
            image.paste(self._overview.inset(still, reached, last, xs, moving), (left, top))
            yield np.asarray(image)

    def _poses(self, frame: int) -> list[Pose]:
        pairs = zip(self._tracks, self._headings, strict=True)
        return [Pose(track.x[frame], track.a[frame], heading[frame]) for track, heading in pairs]

    def _instruments(
        self, image: Image.Image, draw: ImageDraw.ImageDraw, frame: int, reached: Sequence[int]
    ) -> None:
        """Draws the plates of a frame and, for a while after each arrival, what was reached."""
        lead, flown = self._tracks[self._lead], self._fleet.flights[self._lead]
        name = "" if self._fleet.is_alone else f"{self._fleet.name(self._lead)}, "
        title = name + flown.segment_title(reached[self._lead])
        self._hud.card(image, [(self._scene.name, WHITE), (title, GREY)], 0.8, 0.33)
        self._hud.instruments(
            image,
            float(self._t[frame] - flown.trajectory.t[0]),
            float(np.linalg.norm(lead.v[frame])),
            f"to {node_name(flown.goal(reached[self._lead]))}",
            float(np.linalg.norm(lead.goals[frame] - lead.x[frame])),
            self._items(reached),
        )
        if self._air is not None:
            push = self._air.pushes(self._t[frame : frame + 1])[0]
            self._hud.push(image, push, self._views[frame])
        if lead.shields[frame]:
            self._hud.shield(draw)
        if not self._fleet.is_alone:
            row = min(
                np.searchsorted(flown.trajectory.t, self._t[frame]), len(flown.trajectory) - 1
            )
            self._hud.fleet(image, self._rows(frame, reached), float(self._fleet.gaps[row]))
        self._notices(draw, frame, reached)

    def _rows(self, frame: int, reached: Sequence[int]) -> list[FleetRow]:
        """Says what each UAV does in a frame."""
        rows = []
        for m, (flown, track) in enumerate(zip(self._fleet.flights, self._tracks, strict=True)):
            doing = f"to {node_name(flown.goal(reached[m]))}"
            if self._t[frame] >= flown.trajectory.t[-1] - 1e-9:
                doing = "home" if flown.complete else "ended"
            items = f"{len(flown.collected(reached[m]))} / {len(flown.order)}"
            shield = bool(track.shields[frame])
            colour, name = uav_colour(self._fleet, m), self._fleet.name(m)
            rows.append(FleetRow(colour, name, doing, items, m == self._lead, shield))
        return rows

    def _notices(self, draw: ImageDraw.ImageDraw, frame: int, reached: Sequence[int]) -> None:
        """Says for a while after each arrival what was reached, and by whom."""
        (width, height), unit = self._settings.size, self._settings.unit
        y = height - 60 * unit
        for m, track in enumerate(self._tracks):
            arrived = int(np.argmax(track.reached == reached[m]))  # the first frame since then
            if not reached[m] or frame - arrived >= NOTICE * self._settings.fps:
                continue
            text = _arrival(self._fleet.flights[m].targets[reached[m] - 1])
            if self._fleet.is_alone:
                pill(draw, (width / 2, y), text, round(24 * unit), COLLECTED)
            else:
                text, colour = f"{self._fleet.name(m)}: {text}", uav_colour(self._fleet, m)
                pill(draw, (width / 2, y), text, round(20 * unit), WHITE, colour)
            y -= 42 * unit

    # Words

    def _items(self, reached: Sequence[int]) -> str:
        return f"items {self._fleet.collected(reached)} / {len(self._scene.items)}"

    def _plan(self) -> list[tuple[str, Colour]]:
        """Says what is flown, for the cards."""
        fleet, scene, flown = self._fleet, self._scene, self._fleet.flights[0]
        limits = (f"limits {scene.v_max:g} m/s, {scene.a_max:g} m/s²", GREY)
        if not fleet.is_alone:
            tours = [
                (f"{fleet.name(m)}: {_tour(flown.order)}", on_panel(uav_colour(fleet, m)))
                for m, flown in enumerate(fleet.flights)
            ]
            shown = tours if len(tours) <= MOST_TOURS else []
            return [(fleet.title, GREY), *shown, limits]
        if flown.segment is not None:
            return [(flown.segment_title(0), GREY), limits]
        return [(f"mission: {len(flown.order)} items", GREY), (_tour(flown.order), GREY), limits]

    def _result(self, reached: Sequence[int]) -> list[tuple[str, Colour]]:
        """Says how the flight ended, for the last card."""
        fleet, caption, lead = self._fleet, self._settings.caption, self._fleet.flights[self._lead]
        colour = UAV if not fleet.complete else COLLECTED if caption is None else WHITE
        if caption is None:
            if not fleet.complete:
                caption = "not completed"
            else:
                caption = "mission complete" if lead.segment is None else _arrival(lead.targets[-1])
        length = sum(flown.trajectory.length for flown in fleet.flights)
        time = "time" if fleet.makespan is None else "makespan"
        lines = [
            (caption, colour),
            self._plan()[0],
            (f"{time} {fleet.duration:.2f} s", WHITE),
            *((line, WHITE) for line in self._compared()),
            (f"path {length:.0f} m" if fleet.is_alone else f"paths {length:.0f} m in all", WHITE),
            (self._items(reached), WHITE),
        ]
        acted = [when for when in fleet.shielded if len(when)]
        if acted:
            seconds = sum(float(np.sum(when[:, 1] - when[:, 0])) for when in acted)
            lines.append((f"shield acted for {seconds:.1f} s", SHIELD))
        return lines

    def _compared(self) -> list[str]:
        """Says how a fleet's time and distances compare with what is possible and allowed."""
        fleet, lines = self._fleet, []
        if fleet.makespan is not None and fleet.lower_bound > 0:
            ratio = fleet.makespan / fleet.lower_bound
            lines.append(f"{ratio:.3f} of the lower bound, {fleet.lower_bound:.2f} s")
        least = float(fleet.gaps.min())
        if np.isfinite(least):
            lines.append(f"at least {least:.2f} m apart, limit {fleet.separation_limit:g} m")
        return lines


def _tour(order: Sequence[int]) -> str:
    """Says in which order items are visited, in short if there are many."""
    names = [str(node) for node in order]
    if len(names) > 10:
        names = [*names[:6], "…", *names[-3:]]
    return " → ".join(["depot", *names, "depot"])


def _arrival(node: int) -> str:
    return "arrived at the depot" if node == DEPOT else f"{node_name(node)} collected"


def _fade(one: Picture, two: Picture, shares: Array) -> Generator[Picture]:
    """Blends picture one into picture two, by one share of picture two a frame."""
    for share in np.clip(shares, 0.0, 1.0):
        yield (one * (1.0 - share) + two * share).astype(np.uint8)
