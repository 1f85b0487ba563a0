"""Makes the frames of a film: opening on the whole scene, flight from behind, result."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import closing
from functools import partial

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.render.camera import Picture, View, behind, chase_views, framing
from mjcollect.render.film.inset import Inset, inset_size
from mjcollect.render.film.overview import Overview, draw_moving_box
from mjcollect.render.film.scene_renderer import Stage
from mjcollect.render.film.track import Track
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.flown_model import Pose
from mjcollect.render.labels import Rectangle, name_all
from mjcollect.render.overlay import (
    COLLECTED,
    GREY,
    SHIELD,
    UAV,
    WHITE,
    Colour,
    FleetRow,
    Hud,
    on_panel,
    pill,
    uav_colour,
)
from mjcollect.render.settings import VideoSettings
from mjcollect.scene.air import Air
from mjcollect.scene.order import DEPOT, node_name

# The first picture, each fade, the last picture and the notice of an arrival last so long (s).
OPENING, FADE, HOLD, NOTICE = 1.3, 0.3, 1.8, 1.3
OVERVIEW_FOVY = 30.0  # The camera on the whole scene has this field of view (degrees).
OVERVIEW_DIRECTION = np.array([1.0, 0.82, -0.72])
MOST_TOURS = 8  # The first card names the tours of up to so many UAVs.


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
        self._blocked = self._blocked_by_plates()
        self._last = np.stack([track.point(self._t) for track in self._tracks], axis=1)
        reached = np.stack([track.reached for track in self._tracks], axis=1)
        self._inset = partial(Inset, fleet, self._wide, trails, self._last, reached)

    def __len__(self) -> int:
        """Returns the number of frames."""
        return self._opening + len(self._t) + self._hold

    @property
    def size(self) -> tuple[int, int]:
        """Returns width and height of the pictures in pixels."""
        return self._settings.size

    def frames(self, part: int = 0, parts: int = 1) -> Generator[Picture]:
        """Yields pictures (H, W, 3) uint8 in order, from a renderer that it opens and closes.

        Args:
            part, parts: only frames part, part + parts, part + 2 parts and so on are made,
                and each is the same as among all frames.
        """
        fade = FADE * self._settings.fps
        first, last = self._opening, self._opening + len(self._t)  # of the flight; beyond it
        with closing(Stage(self._fleet, self._settings)) as stage:
            title = [(self._scene.name, WHITE), *self._plan()]
            start = [0] * len(self._tracks)
            opening = self._still(stage, start, start, title)
            inset = self._inset()
            shown = self._frame(stage, inset, 0)
            for number in range(part, first, parts):
                yield _blend(opening, shown, (number - (first - fade)) / fade)
            for number in range(first + (part - first) % parts, last, parts):
                shown = self._frame(stage, inset, number - first)
                yield shown
            shown = self._frame(stage, inset, len(self._t) - 1)
            ends = [len(track.trail) - 1 for track in self._tracks]
            reached = self._reached(len(self._t) - 1)
            result = self._still(stage, reached, ends, self._result(reached))
            for number in range(last + (part - last) % parts, len(self), parts):
                yield _blend(shown, result, (number - last + 1) / fade)

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
        image = Image.fromarray(stage.still(self._wide, reached))
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

    def _frame(self, stage: Stage, inset: Inset, frame: int) -> Picture:
        """Returns a frame from behind the lead, with instruments and the overview inset."""
        view, lead = self._views[frame], self._tracks[self._lead]
        reached, time = self._reached(frame), float(self._t[frame])
        xs = np.array([track.x[frame] for track in self._tracks])
        moving = [box.box_at(time) for box in self._moving]
        small = inset.picture(frame, stage.still, xs, moving)
        stage.place(self._poses(frame), frame)
        points = self._last[frame].tolist()
        trails = [
            track.flown(frame, last, view) for track, last in zip(self._tracks, points, strict=True)
        ]
        image = Image.fromarray(stage.chase(view, reached, trails, lead.goals[frame], moving))
        name_all(image, self._fleet, reached, view, xs, self._blocked)
        draw = ImageDraw.Draw(image, "RGBA")
        self._instruments(image, draw, frame, reached)
        left, top = self._inset_place()
        right, bottom = left + inset.size[0] + 2, top + inset.size[1] + 2
        draw.rectangle((left - 3, top - 3, right, bottom), None, WHITE, 3)
        image.paste(small, (left, top))
        return np.asarray(image)

    def _inset_place(self) -> tuple[int, int]:
        """Returns left and top of the inset in pixels."""
        width, unit = self._settings.size[0], self._settings.unit
        return width - inset_size(self._settings.size)[0] - round(20 * unit), round(22 * unit)

    def _blocked_by_plates(self) -> list[Rectangle]:
        """Returns where instruments, inset and the like stand, which names keep out of."""
        (width, height), unit = self._settings.size, self._settings.unit
        left, top = self._inset_place()
        bottom = top + inset_size(self._settings.size)[1]
        panels = (226 if len(self._fleet.shielded[self._lead]) else 190) * unit
        blocked = [
            (left - 4.0, 0.0, float(width), bottom + 4.0),
            (0.0, height - panels, (400 if self._air is None else 584) * unit, float(height)),
            (0.0, 0.0, 460 * unit, 110 * unit),
        ]
        if not self._fleet.is_alone:
            plate = self._hud.fleet_place(len(self._tracks))[:2]
            blocked.append((*plate, float(width), float(height)))
        return blocked

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


def _blend(one: Picture, two: Picture, share: float) -> Picture:
    """Blends picture one into picture two, of which the share is cut to 0..1."""
    share = min(max(share, 0.0), 1.0)
    return (one * (1.0 - share) + two * share).astype(np.uint8)
