"""Names what is in sight in the chase view with PIL: target, other nodes, a fleet's other UAVs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import View
from mjcollect.render.fleet import UAV_WIDTH, FleetProgress
from mjcollect.render.overlay import (
    PANEL,
    WHITE,
    Colour,
    font,
    ink,
    node_look,
    panel,
    pill,
    uav_colour,
    write,
)
from mjcollect.scene.order import node_name

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom in pixels
NEAREST, FARTHEST = 5.0, 600.0  # Nodes between these distances from the camera (m) are named.
# A UAV's name stands so many pixels above it or, where that is taken, such steps higher or lower.
LIFT, STEP, STEPS = 24.0, 27.0, (0, 1, 2, -1, 3, 4, -2, 5, -3, 6, -4, 7, 8)
SMALL = 9.0  # A UAV of fewer pixels from middle to side has a dot.
CHIP, GAP = 0.9, 0.25  # Chips are so much wider than their numbers and so far apart, in letters.
HIDDEN = 120  # What a box hides is drawn with this opacity, of 255.


def name_all(
    image: Image.Image, fleet: FleetProgress, reached: Sequence[int], view: View, xs: Array,
    blocked: Sequence[Rectangle],
) -> None:  # fmt: skip
    """Names what is in sight; rings the target, or points to it where it is out of the picture.

    Args:
        image: drawn on. fleet, reached: what to name. view: the camera.
        xs: (M, 3) the quadrotors; distances are counted from the lead.
        blocked: rectangles in pixels that labels keep out of.
    """
    tags, scene, x = _Tags(image, blocked), fleet.scene, xs[fleet.lead]
    nodes = scene.nodes
    points = np.array([scene.point(node) for node in nodes])
    pixels, depth = view.project(points)
    seen = segment_clear(np.broadcast_to(view.eye, points.shape), points, scene.tree, 1e-6)
    looks = [node_look(fleet, node, reached) for node in nodes]
    target = fleet.target(reached)
    if target is not None:
        k = nodes.index(target)
        text = f"{node_name(target)} · {np.linalg.norm(points[k] - x):.0f} m"
        radius = scene.tolerance(target) / max(depth[k], 1.0) * image.height
        u, v = pixels[k]
        if depth[k] > 0 and tags.free(u, v, 0, 0):
            ring = min(max(14 * tags.unit, radius), image.height / 3)
            tags.ring(text, u, v, ring, looks[k].accent)
        else:
            tags.point_to(text, pixels[k], depth[k] <= 0, looks[k].accent)
    _name_uavs(tags, fleet, view, xs)
    tags.write()
    for k, node in enumerate(nodes):
        near = np.linalg.norm(points[k] - x) < 2 * scene.tolerance(node)  # just left: in the way
        if node == target or near or not seen[k] or not NEAREST < depth[k] < FARTHEST:
            continue
        u, v = pixels[k]
        above = v - scene.tolerance(node) / depth[k] * image.height - 20 * tags.unit
        if tags.free(u, above, 45, 16):
            pill(tags.draw, (u, above), node_name(node), round(15 * tags.unit), looks[k].accent)
            tags.blocked.append((u - 45 * tags.unit, above - 16 * tags.unit, u + 45 * tags.unit, v))


def _name_uavs(tags: _Tags, fleet: FleetProgress, view: View, xs: Array) -> None:
    """Names the UAVs other than the lead, those behind boxes too; in one plate if near together."""
    if len(xs) == 1:
        return
    pixels, depth = view.project(xs)
    seen = segment_clear(np.broadcast_to(view.eye, xs.shape), xs, fleet.scene.tree, 1e-6)
    # Half the width of a quadrotor in pixels.
    focal = view.size[1] / 2 / np.tan(np.radians(view.fovy) / 2)
    size = fleet.uav_scale * UAV_WIDTH / 2 / np.maximum(depth, 1.0) * focal
    marks = [
        UavMark(fleet.uavs[m], uav_colour(fleet, m), u, v, float(size[m]), bool(seen[m]))
        for m, (u, v) in enumerate(pixels.tolist())
        if m != fleet.lead and depth[m] > 1.0 and tags.free(u, v, 0, 0)
    ]
    for mark in sorted(marks, key=lambda mark: mark.size):  # the nearest on top
        tags.dot(mark)
    for group in _groups(marks, tags.unit):
        tags.uavs(sorted(group, key=lambda mark: mark.number))


class UavMark(NamedTuple):
    """Holds a UAV's number and colour, where it is, half its width (pixels), and if it is seen."""

    number: int
    colour: Colour
    u: float
    v: float
    size: float
    seen: bool


def _groups(marks: Sequence[UavMark], unit: float) -> list[list[UavMark]]:
    """Returns the marks in groups, whose names would overlap if each stood above its UAV."""
    groups: list[list[UavMark]] = []
    for mark in marks:
        near = [
            group
            for group in groups
            if any(
                abs(mark.u - other.u) < 70 * unit
                and abs(mark.v - mark.size - other.v + other.size) < 30 * unit
                for other in group
            )
        ]
        groups = [group for group in groups if group not in near]
        groups.append([mark, *(other for group in near for other in group)])
    return groups


class _Tags:
    """Draws names on a picture; sizes without a unit are pixels of a picture that is 720 high."""

    def __init__(self, image: Image.Image, blocked: Sequence[Rectangle]) -> None:
        self.draw, self.size = ImageDraw.Draw(image, "RGBA"), image.size
        self.unit = image.height / 720
        self.blocked = list(blocked)
        self._plates: list[Callable[[], None]] = []  # drawn by `write`, over all lines

    def free(self, u: float, v: float, half_width: float, half_height: float) -> bool:
        """Returns whether a label at (u, v) lies in the picture and on no blocked rectangle."""
        wide, high = half_width * self.unit, half_height * self.unit
        inside = wide <= u <= self.size[0] - wide and high <= v <= self.size[1] - high
        return inside and not any(
            left - wide < u < right + wide and top - high < v < bottom + high
            for left, top, right, bottom in self.blocked
        )

    def write(self) -> None:
        """Draws the names of target and UAVs, which stand over the lines that lead to others."""
        for plate in self._plates:
            plate()

    def name_target(self, text: str, u: float, v: float, colour: Colour) -> None:
        """Writes the target's name, which later names keep out of."""
        wide, high = 100 * self.unit, 18 * self.unit
        self.blocked.append((u - wide, v - high, u + wide, v + high))
        self._plates.append(lambda: pill(self.draw, (u, v), text, round(17 * self.unit), colour))

    def ring(self, text: str, u: float, v: float, radius: float, colour: Colour) -> None:
        """Draws a ring round the target, and its name above or below where that is free."""
        self.draw.circle((u, v), radius, None, colour, max(2, round(2.5 * self.unit)))
        for place in (v - radius - 22 * self.unit, v + radius + 22 * self.unit):
            if self.free(u, place, 90, 20):
                self.name_target(text, u, place, colour)
                break

    def point_to(self, text: str, pixel: Array, behind: bool, colour: Colour) -> None:
        """Names the target and draws an arrow to it, on a ring round the centre of the picture."""
        centre = np.array(self.size) / 2
        aim = (pixel - centre) * (-1 if behind else 1)
        aim = aim / max(float(np.linalg.norm(aim)), 1e-9)
        side = np.array([-aim[1], aim[0]])
        places = [
            centre + reach * self.size[1] * (np.cos(turn) * aim + np.sin(turn) * side) * [1.3, 1.0]
            for turn in np.radians([0, -25, 25, -50, 50, -80, 80, -120, 120])
            for reach in np.linspace(0.36, 0.12, 5)
        ]
        spot = next((place for place in places if self.free(place[0], place[1], 118, 40)), centre)
        # The arrow stands beside the text, else above or below it.
        start = spot + aim * [80 * self.unit, 0.0] if abs(aim[0]) > 0.5 else spot
        tip, base = start + aim * 34 * self.unit, start + aim * 20 * self.unit
        wing = side * 10 * self.unit
        self.draw.polygon([tuple(tip), tuple(base + wing), tuple(base - wing)], colour)
        self.name_target(text, float(spot[0]), float(spot[1]), colour)

    def dot(self, mark: UavMark) -> None:
        """Draws a dot over a UAV of few pixels, see-through if it is behind a box."""
        shade = 255 if mark.seen else HIDDEN
        if mark.size < SMALL * self.unit:
            place, rim = (mark.u, mark.v), (*WHITE, shade)
            self.draw.circle(place, 4 * self.unit, (*mark.colour, shade), rim)

    def uavs(self, group: Sequence[UavMark]) -> None:
        """Names UAVs, 'UAV 2' or 'UAV 2 5 7', where that is free above or below them."""
        u = sum(mark.u for mark in group) / len(group)
        top = min(mark.v - mark.size for mark in group)
        bottom = max(mark.v + mark.size for mark in group)
        pixels = round(14 * self.unit)
        wide, high = _plate_width(group, pixels) / 2, 0.85 * pixels
        lifts = [(LIFT + STEP * abs(step)) * self.unit * np.sign(step + 0.5) for step in STEPS]
        places = [top - lift if lift > 0 else bottom - lift for lift in lifts]
        half = wide / self.unit + 2, high / self.unit + 1
        v = next((place for place in places if self.free(u, place, *half)), None)
        if v is None:
            return
        self.blocked.append((u - wide, v - high, u + wide, v + high))
        for mark in group:
            near = mark.v - mark.size if v < mark.v else mark.v + mark.size
            shade = 255 if mark.seen else HIDDEN
            self.draw.line([(u, v), (mark.u, near)], (*WHITE, shade), max(1, round(self.unit)))
        self._plates.append(lambda: _uav_plate(self.draw, (u, v), group, pixels))


def _plate_width(group: Sequence[UavMark], pixels: int) -> float:
    """Returns the width in pixels of a plate that names UAVs in letters of so many pixels."""
    letters = font(pixels, True)
    if len(group) == 1:
        return letters.getlength(f"UAV {group[0].number}") + 1.2 * pixels
    chips = sum(letters.getlength(str(mark.number)) + CHIP * pixels for mark in group)
    return letters.getlength("UAV ") + chips + (1.2 + GAP * (len(group) - 1)) * pixels


def _uav_plate(
    draw: ImageDraw.ImageDraw, centre: tuple[float, float], group: Sequence[UavMark], pixels: int
) -> None:
    """Draws a name on its UAV's colour, or a plate with a chip of its colour for each of several.

    That of a UAV that a box hides is only rimmed by its colour.
    """
    if len(group) == 1:
        (mark,) = group
        rim, fill = (WHITE, mark.colour) if mark.seen else (mark.colour, PANEL)
        pill(draw, centre, f"UAV {mark.number}", pixels, rim, fill)
        return
    (u, v), letters = centre, font(pixels, True)
    wide, high = _plate_width(group, pixels) / 2, 0.85 * pixels
    plate = (u - wide, v - high, u + wide, v + high)
    panel(draw, plate, high, PANEL, WHITE, max(1, pixels // 9))
    left = u - wide + 0.6 * pixels
    write(draw, (left, v), "UAV", WHITE, letters)
    left += letters.getlength("UAV ")
    for mark in group:
        chip = letters.getlength(str(mark.number)) + CHIP * pixels
        box = (left, v - 0.62 * pixels, left + chip, v + 0.62 * pixels)
        draw.rounded_rectangle(box, 0.62 * pixels, mark.colour, WHITE if mark.seen else None)
        write(draw, (left + chip / 2, v), str(mark.number), ink(mark.colour), letters, "mm")
        left += chip + GAP * pixels
