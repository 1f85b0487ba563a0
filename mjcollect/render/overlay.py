"""Draws over a rendered frame with PIL: plates of text, speed bar, overview inset, boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import View
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.settings import VideoSettings
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene

Colour = tuple[int, ...]
SPEED_MAP = "viridis"  # The colour-blind can read this colour map of matplotlib, also in grey.
WHITE: Colour = (255, 255, 255)
GREY: Colour = (190, 198, 206)
DARK: Colour = (20, 24, 30)
PANEL: Colour = (16, 22, 30, 205)
UAV: Colour = (255, 96, 16)
WIND: Colour = (240, 228, 66)
MOVING: tuple[int, int, int] = (128, 92, 220)
SHIELD: Colour = (86, 180, 233)
EMPTY_BAR: Colour = (70, 78, 88)
FLEET_WIDTH, FLEET_ROOM = 268, 270  # Width, and height at most, of the plate of a fleet's UAVs.
# Nodes have these colours by `Progress.state`; the renderer's are the same.
NODES: dict[str, Colour] = {
    "target": (242, 64, 153),
    "collected": (0, 178, 127),
    "depot": (26, 115, 217),
    "item": (242, 166, 0),
}
TARGET, COLLECTED = NODES["target"], NODES["collected"]
# In a fleet's pictures colours tell UAVs apart: what is nobody's has none.
UNCOLLECTED: Colour = (236, 239, 242)
FLEET_DEPOT: Colour = (84, 94, 106)


def speed_colours(speed: Array, v_max: float) -> Array:
    """Returns the colours (..., 3), RGB in 0..1, of speeds (...) in m/s up to `v_max`."""
    return np.asarray(matplotlib.colormaps[SPEED_MAP](speed / v_max))[..., :3]


@lru_cache
def font(pixels: float, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Returns DejaVu Sans of so many pixels, matplotlib's own, so that no system font is needed."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name
    return ImageFont.truetype(str(path), max(round(pixels), 5))


def write(
    draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, colour: Colour,
    letters: ImageFont.FreeTypeFont, anchor: str = "lm",
) -> None:  # fmt: skip
    """Writes text at a place in pixels, rounded; `anchor` says where in the text that is.

    It is "lm", "mm" or "rm": its left, middle or right, halfway up.
    """
    (left, top), shape = _shape(text, letters, anchor)
    draw.bitmap((round(place[0]) + left, round(place[1]) + top), shape, colour)


@lru_cache(512)  # Most of a frame's texts stand in the one before.
def _shape(
    text: str, letters: ImageFont.FreeTypeFont, anchor: str
) -> tuple[tuple[int, int], Image.Image]:
    """Returns where text begins, from its anchor, and how much of each pixel it covers."""
    box = letters.getbbox(text, anchor=anchor)
    left, top, right, bottom = math.floor(box[0]), math.floor(box[1]), *map(math.ceil, box[2:])
    shape = Image.new("L", (right - left, bottom - top))
    ImageDraw.Draw(shape).text((-left, -top), text, 255, letters, anchor=anchor)
    return (left, top), shape


def panel(
    draw: ImageDraw.ImageDraw, box: Sequence[float], radius: float, fill: Colour = PANEL,
    rim: Colour | None = None, width: int = 1,
) -> None:  # fmt: skip
    """Draws a plate with round corners at whole pixels: between them its parts would overlap."""
    left, top, right, bottom = map(round, box)
    draw.rounded_rectangle((left, top, right, bottom), round(radius), fill, rim, width)


class Look(NamedTuple):
    """Says how a node is drawn.

    Attributes:
        fill, rim, text: colours of its disc or square, of the edge and of what stands in it.
        accent: colour of its name's rim and, if it is flown to, of the ring around it.
        grow: factor on its size. edge: width of the rim as a share of its radius.
    """

    fill: Colour
    rim: Colour
    text: Colour
    accent: Colour
    grow: float
    edge: float


def node_look(fleet: FleetProgress, node: int, reached: Sequence[int]) -> Look:
    """Returns how a node is drawn once each flight has reached so many targets, `reached` (M,).

    In a fleet's pictures an item has the colour of the UAV that collected it, and is rimmed by that
    of the UAV that flies to it.
    """
    state, m = fleet.state(node, reached)
    grow = 1.25 if state == "target" else 1.0
    if fleet.is_alone:
        text = DARK if state == "item" else WHITE
        return Look(NODES[state], WHITE, text, NODES[state], grow, 1 / 6)
    fill = FLEET_DEPOT if node <= DEPOT else UNCOLLECTED
    if state == "collected" and m is not None:
        fill = uav_colour(fleet, m)
    if state == "target" and m is not None:
        colour = uav_colour(fleet, m)
        return Look(fill, colour, ink(fill), colour, grow, 1 / 3)
    return Look(fill, WHITE if fill != UNCOLLECTED else DARK, ink(fill), fill, grow, 1 / 6)


def uav_colour(fleet: FleetProgress, m: int) -> Colour:
    """Returns the colour of a flight's marker: of the fleet's UAV, or that of a single one."""
    return UAV if fleet.is_alone else ImageColor.getrgb(fleet.colour(m))


def ink(fill: Colour) -> Colour:
    """Returns the colour, dark or white, of text that is read best on a colour."""
    return DARK if np.dot(fill[:3], (0.299, 0.587, 0.114)) > 135 else WHITE


def on_panel(colour: Colour) -> Colour:
    """Returns a colour that can be read on a dark plate: dark ones become lighter."""
    share = 0.6 if ink(colour) == WHITE else 0.0
    share = 0.35 if share and max(colour[:3]) > 150 else share
    return tuple(round(part + share * (255 - part)) for part in colour[:3])


def fitted(text: str, letters: ImageFont.FreeTypeFont, width: float) -> str:
    """Returns `text`, cut short with an ellipsis if it is wider than `width` pixels."""
    if letters.getlength(text) <= width:
        return text
    while text and letters.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def pill(
    draw: ImageDraw.ImageDraw, centre: tuple[float, float], text: str, pixels: int, colour: Colour,
    fill: Colour = PANEL,
) -> None:  # fmt: skip
    """Draws a short label on a plate with a coloured rim; its letters have so many pixels."""
    letters = font(pixels, True)
    half = draw.textlength(text, letters) / 2 + 0.6 * pixels
    x, y = centre
    box = (x - half, y - 0.85 * pixels, x + half, y + 0.85 * pixels)
    panel(draw, box, 0.85 * pixels, fill, colour, max(1, pixels // 9))
    write(draw, (x, y), text, ink(fill), letters, "mm")


class FleetRow(NamedTuple):
    """Holds what a plate says of one UAV: 'UAV 2', 'to item 3', '1 / 4'; the followed one's bold.

    While the shield changes its command, that is shown by the shield's colour.
    """

    colour: Colour
    name: str
    doing: str
    items: str
    followed: bool
    shielded: bool


class Hud:
    """Draws the plates of a frame: what is flown at the top left, instruments below it."""

    def __init__(self, scene: Scene, settings: VideoSettings):
        """Fits the plates to the frames of a video."""
        self._scene, self._settings = scene, settings
        self._unit, self._height = settings.unit, settings.size[1]
        width = round(336 * self._unit)
        ramp = speed_colours(np.linspace(0, scene.v_max, width), scene.v_max)
        bar = np.repeat((ramp * 255).astype(np.uint8)[None], max(2, round(14 * self._unit)), axis=0)
        self._bar = Image.fromarray(bar)

    def instruments(
        self, image: Image.Image, time: float, speed: float, goal: str, distance: float, items: str
    ) -> None:
        """Shows time, speed against its limit, distance to the goal, items and playback speed.

        Args:
            image: drawn on. time: in seconds. speed: in m/s. goal, items: texts.
            distance: to the goal, in metres.
        """
        draw = ImageDraw.Draw(image, "RGBA")
        u, top = self._unit, self._height - 176 * self._unit
        panel(draw, (20 * u, top, 388 * u, self._height - 20 * u), 10 * u)
        left, right, small = 36 * u, 372 * u, font(17 * u)
        limit = self._scene.v_max
        for x, down, text, colour, letters in (
            (left, 30, f"{time:.2f} s", WHITE, font(32 * u, True)),
            (right, 30, f"{self._settings.speed:g}×", GREY, font(20 * u)),
            (left, 66, "speed", GREY, small),
            (right, 66, f"{speed:.1f} / {limit:g} m/s", WHITE, small),
            (left, 122, goal, GREY, small),
            (156 * u, 122, f"{distance:.0f} m", WHITE, font(17 * u, True)),
            (right, 122, items, WHITE, small),
        ):
            anchor = "rm" if x == right else "lm"
            write(draw, (x, top + down * u), text, colour, letters, anchor)
        x, y = round(left), round(top + 84 * u)
        full, high = self._bar.size
        filled = min(full, max(1, round(full * speed / limit)))
        draw.rectangle((x, y, x + full, y + high - 1), EMPTY_BAR)
        image.paste(self._bar.crop((0, 0, filled, high)), (x, y))

    def shield(self, draw: ImageDraw.ImageDraw) -> None:
        """Draws a mark above the instruments: the shield changes the command that is flown."""
        place = 70 * self._unit, self._height - 202 * self._unit
        pill(draw, place, "shield", round(20 * self._unit), SHIELD)

    def push(self, image: Image.Image, push: Array, view: View) -> None:
        """Draws a plate with an arrow and what wind and gust (3,) accelerate by, in m/s².

        Up on the plate is ahead of the camera; the angle is counted from x to y.
        """
        u, draw = self._unit, ImageDraw.Draw(image, "RGBA")
        left, top = 408 * u, self._height - 176 * u
        panel(draw, (left, top, left + 168 * u, self._height - 20 * u), 10 * u)
        level = float(np.hypot(push[0], push[1]))
        forward = view.axes[2, :2] / max(float(np.linalg.norm(view.axes[2, :2])), 1e-9)
        along = push[:2] @ forward
        aside = push[0] * forward[1] - push[1] * forward[0]
        middle = np.array([left + 84 * u, top + 52 * u])
        size = float(np.linalg.norm(push))
        draw.circle(tuple(middle), 40 * u, None, EMPTY_BAR, max(1, round(2 * u)))
        if level > 1e-6:
            ahead = np.array([aside, -along]) / level
            across, length = np.array([-ahead[1], ahead[0]]), 36 * u * min(1.0, 0.3 + level / 8.0)
            tip, tail = middle + length * ahead, middle - length * ahead
            neck = tip - min(20 * u, length) * ahead
            draw.line([tuple(tail), tuple(neck)], WIND, max(2, round(6 * u)))
            corners = [tip, neck + 10 * u * across, neck - 10 * u * across]
            draw.polygon([tuple(corner) for corner in corners], WIND)
        angle = round(float(np.degrees(np.arctan2(push[1], push[0])))) % 360
        x, y = middle
        write(draw, (x, y + 60 * u), f"wind {size:.1f} m/s²", WHITE, font(17 * u), "mm")
        write(draw, (x, y + 82 * u), f"to {angle}°", GREY, font(15 * u), "mm")

    def fleet(self, image: Image.Image, rows: Sequence[FleetRow], gap: float) -> None:
        """Draws a plate at the bottom right: what each UAV does, and the least distance of two.

        Args:
            image: drawn on. rows: one for each UAV. gap: least distance in m; inf for one UAV.
        """
        u, draw = self._unit, ImageDraw.Draw(image, "RGBA")
        right, bottom = self._settings.size[0] - 20 * u, self._height - 20 * u
        left, top, step = self.fleet_place(len(rows))
        panel(draw, (left, top, right, bottom), 10 * u)
        letters = font(0.62 * step)
        for k, row in enumerate(rows):
            y, chip = top + 10 * u + (k + 0.5) * step, 0.30 * step
            draw.circle((left + 22 * u, y), chip, row.colour, WHITE, max(1, round(chip / 5)))
            name = font(0.62 * step, row.followed)
            write(draw, (left + 40 * u, y), row.name, WHITE, name)
            room = (FLEET_WIDTH - 118 - 56) * u
            doing = fitted(row.doing, letters, room)
            colour = SHIELD if row.shielded else GREY
            write(draw, (left + 118 * u, y), doing, colour, letters)
            write(draw, (right - 14 * u, y), row.items, WHITE, letters, "rm")
        if np.isfinite(gap):
            y = top + 10 * u + (len(rows) + 0.5) * step
            write(draw, (left + 14 * u, y), "closest two", GREY, letters)
            write(draw, (right - 14 * u, y), f"{gap:.1f} m apart", WHITE, letters, "rm")

    def fleet_place(self, count: int) -> tuple[float, float, float]:
        """Returns left, top and height of a row of that plate for so many UAVs, in pixels."""
        u, lines = self._unit, count + (count > 1)
        step = min(26.0, FLEET_ROOM / lines) * u  # Many UAVs have narrow rows.
        left, bottom = self._settings.size[0] - (20 + FLEET_WIDTH) * u, self._height - 20 * u
        return left, bottom - lines * step - 20 * u, step

    def card(
        self, image: Image.Image, lines: list[tuple[str, Colour]], scale: float = 1.0,
        share: float = 0.9,
    ) -> None:  # fmt: skip
        """Draws a plate with a big first line at the top left: opening, what is flown, result.

        Args:
            image: drawn on. lines: text and colour of each. scale: size of the plate.
            share: the share of the picture's width that text may take.
        """
        u, draw = scale * self._unit, ImageDraw.Draw(image, "RGBA")
        room = share * self._settings.size[0]
        rows = []
        for row, (text, colour) in enumerate(lines):
            letters = font(21 * u) if row else font(32 * u, True)
            y = (62 + 34 * row if row else 54) * u
            rows.append((y, fitted(text, letters, room), colour, letters))
        width = max(letters.getlength(text) for _, text, _, letters in rows)
        bottom = 20 * u + (42 + 34 * len(lines)) * u
        panel(draw, (20 * u, 20 * u, 68 * u + width, bottom), 12 * u)
        for y, text, colour, letters in rows:
            write(draw, (44 * u, y), text, colour, letters)
