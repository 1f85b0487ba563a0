"""Draws over a rendered frame with PIL: plates of text, speed bar, overview inset, names, boxes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, product
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import Picture, View
from mjcollect.render.settings import VideoSettings
from mjcollect.scene.order import DEPOT, node_name
from mjcollect.scene.scene import Scene

Colour = tuple[int, ...]
Rectangle = tuple[float, float, float, float]  # left, top, right, bottom in pixels
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
# Nodes have these colours by `Progress.state`; the renderer's are the same.
NODES: dict[str, Colour] = {
    "target": (242, 64, 153),
    "collected": (0, 178, 127),
    "depot": (26, 115, 217),
    "item": (242, 166, 0),
}
TARGET, COLLECTED = NODES["target"], NODES["collected"]
NEAREST, FARTHEST = 5.0, 600.0  # Nodes between these distances from the camera (m) are named.


def speed_colours(speed: Array, v_max: float) -> Array:
    """Returns the colours (..., 3), RGB in 0..1, of speeds (...) in m/s up to `v_max`."""
    return np.asarray(matplotlib.colormaps[SPEED_MAP](speed / v_max))[..., :3]


@lru_cache
def font(pixels: float, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Returns DejaVu Sans of so many pixels, matplotlib's own, so that no system font is needed."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name
    return ImageFont.truetype(str(path), max(round(pixels), 5))


class Overview:
    """Draws the flown path and the nodes on a still of the whole scene, seen from one corner.

    Stills are rendered once per state of the items, which keeps a video affordable. The inset in
    the corner of a frame is the middle of a still, made small; on it the path is drawn once,
    piece by piece.
    """

    def __init__(self, progress: Progress, view: View, trail: Array, colours: Array) -> None:
        """Projects everything once.

        Args:
            progress: what to mark. view: the camera of the stills.
            trail: (N, 3) points of the flown path in metres. colours: (N, 3) RGB in 0..1 there.
        """
        scene, self._progress, self._view = progress.scene, progress, view
        self._pixels = view.project(trail)[0]
        self._colours = (colours * 255).astype(int)
        hidden = ~segment_clear(trail[:, None], view.eye[None, None], scene.tree, 1e-6)[:, 0]
        self._alpha = np.where(hidden, 110, 255)
        self._nodes = range(DEPOT, len(scene.items))
        self._node_pixels = view.project(np.array([scene.point(node) for node in self._nodes]))[0]
        width, height = view.size
        cut = min(width, round(height * 0.95))
        self._cut = ((width - cut) // 2, 0, (width - cut) // 2 + cut, height)
        small = round(0.27 * width)
        self.inset_size = (small, round(small * height / cut))
        self._zoom = cut / small
        self._canvas = Image.new("RGB", view.size)
        self._reached = self._drawn = -1  # arrivals and points of the path on the canvas

    def path(self, image: Image.Image, first: int, last: int, width: float) -> None:
        """Draws the path's points first..last, fainter where a box hides it; `width` in pixels."""
        draw = ImageDraw.Draw(image, "RGBA")
        for outline in (True, False):
            for k in range(first, last):
                colour = DARK if outline else tuple(self._colours[k])
                ends = [tuple(self._pixels[k]), tuple(self._pixels[k + 1])]
                alpha = int(self._alpha[k] * (0.35 if outline else 1.0))
                draw.line(ends, (*colour, alpha), round(width * (2.0 if outline else 1.0)))

    def nodes(self, image: Image.Image, reached: int, radius: float) -> None:
        """Draws items as numbered discs and the depot as a square, of `radius` pixels."""
        draw = ImageDraw.Draw(image, "RGBA")
        ordered = sorted(zip(self._nodes, self._node_pixels, strict=True), key=lambda n: n[1][1])
        for node, place in ordered:
            state = self._progress.state(node, reached)
            grow = radius * (1.25 if state == "target" else 1.0)
            shape = draw.rectangle if node == DEPOT else draw.ellipse
            box = (*(place - grow), *(place + grow))
            shape(box, NODES[state], WHITE, max(1, round(radius / 6)))
            label = "D" if node == DEPOT else str(node)
            colour = DARK if state == "item" else WHITE
            draw.text(tuple(place), label, colour, font(radius * 1.25, True), anchor="mm")

    def uav(self, image: Image.Image, x: Array, radius: float) -> None:
        """Draws the quadrotor's marker at `x` (3,) and a thin line down to the ground."""
        foot = np.array([x[0], x[1], self._progress.scene.bounds[0, 2]])
        (u, v), below = self._view.project(np.stack([x, foot]))[0]
        draw = ImageDraw.Draw(image, "RGBA")
        draw.line([(u, v), tuple(below)], (*UAV, 170), max(1, round(radius / 5)))
        draw.circle((u, v), radius, UAV, WHITE, max(1, round(radius / 4)))

    def inset(
        self, still: Picture, reached: int, point: int, x: Array, moving: Sequence[Array] = ()
    ) -> Image.Image:
        """Returns the small picture: path up to `point`, quadrotor at `x` (3,), moving boxes."""
        if reached != self._reached:
            self._canvas = Image.fromarray(still)
            self._reached, self._drawn = reached, 0
        self.path(self._canvas, self._drawn, point, 2.0 * self._zoom)
        self._drawn = point
        image = self._canvas.copy()
        for box in moving:
            draw_moving_box(image, self._view, box, 2.0 * self._zoom)
        self.nodes(image, reached, 8.0 * self._zoom * self.inset_size[0] / 340)
        self.uav(image, x, 6.0 * self._zoom * self.inset_size[0] / 340)
        return image.crop(self._cut).resize(self.inset_size, Image.Resampling.BOX)


def fitted(text: str, letters: ImageFont.FreeTypeFont, width: float) -> str:
    """Returns `text`, cut short with an ellipsis if it is wider than `width` pixels."""
    if letters.getlength(text) <= width:
        return text
    while text and letters.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def pill(
    draw: ImageDraw.ImageDraw, centre: tuple[float, float], text: str, pixels: int, colour: Colour
) -> None:
    """Draws a short label on a plate with a coloured rim; its letters have so many pixels."""
    letters = font(pixels, True)
    half = draw.textlength(text, letters) / 2 + 0.6 * pixels
    x, y = centre
    box = (x - half, y - 0.85 * pixels, x + half, y + 0.85 * pixels)
    draw.rounded_rectangle(box, 0.85 * pixels, PANEL, colour, max(1, pixels // 9))
    draw.text((x, y), text, WHITE, letters, anchor="mm")


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
        panel = (20 * u, top, 388 * u, self._height - 20 * u)
        draw.rounded_rectangle(panel, 10 * u, PANEL)
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
            draw.text((x, top + down * u), text, colour, letters, anchor=anchor)
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
        draw.rounded_rectangle((left, top, left + 168 * u, self._height - 20 * u), 10 * u, PANEL)
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
        draw.text((x, y + 60 * u), f"wind {size:.1f} m/s²", WHITE, font(17 * u), "mm")
        draw.text((x, y + 82 * u), f"to {angle}°", GREY, font(15 * u), "mm")

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
        draw.rounded_rectangle((20 * u, 20 * u, 68 * u + width, bottom), 12 * u, PANEL)
        for y, text, colour, letters in rows:
            draw.text((44 * u, y), text, colour, letters, anchor="lm")


def node_labels(
    image: Image.Image, progress: Progress, reached: int, view: View, x: Array,
    blocked: Sequence[Rectangle],
) -> None:  # fmt: skip
    """Names what is in sight; rings the target, or points to it where it is out of the picture.

    Args:
        image: drawn on. progress, reached: what to name. view: the camera.
        x: (3,) the quadrotor, from which distances are counted.
        blocked: rectangles in pixels that labels keep out of.
    """
    tags, scene = _Tags(image, blocked), progress.scene
    nodes = range(DEPOT, len(scene.items))
    points = np.array([scene.point(node) for node in nodes])
    pixels, depth = view.project(points)
    seen = segment_clear(np.broadcast_to(view.eye, points.shape), points, scene.tree, 1e-6)
    states = [progress.state(node, reached) for node in nodes]
    if "target" in states:
        k = states.index("target")
        text = f"{node_name(nodes[k])} · {np.linalg.norm(points[k] - x):.0f} m"
        radius = scene.tolerance(nodes[k]) / max(depth[k], 1.0) * image.height
        u, v = pixels[k]
        if depth[k] > 0 and tags.free(u, v, 0, 0):
            tags.ring(text, u, v, min(max(14 * tags.unit, radius), image.height / 3))
        else:
            tags.point_to(text, pixels[k], behind=depth[k] <= 0)
    for k, node in enumerate(nodes):
        near = np.linalg.norm(points[k] - x) < 2 * scene.tolerance(node)  # just left: in the way
        if states[k] == "target" or near or not seen[k] or not NEAREST < depth[k] < FARTHEST:
            continue
        u, v = pixels[k]
        above = v - scene.tolerance(node) / depth[k] * image.height - 20 * tags.unit
        if tags.free(u, above, 45, 16):
            pill(tags.draw, (u, above), node_name(node), round(15 * tags.unit), NODES[states[k]])
            tags.blocked.append((u - 45 * tags.unit, above - 16 * tags.unit, u + 45 * tags.unit, v))


class _Tags:
    """Draws names on a picture; sizes without a unit are pixels of a picture that is 720 high."""

    def __init__(self, image: Image.Image, blocked: Sequence[Rectangle]) -> None:
        self.draw, self.size = ImageDraw.Draw(image, "RGBA"), image.size
        self.unit = image.height / 720
        self.blocked = list(blocked)

    def free(self, u: float, v: float, half_width: float, half_height: float) -> bool:
        """Returns whether a label at (u, v) lies in the picture and on no blocked rectangle."""
        wide, high = half_width * self.unit, half_height * self.unit
        inside = wide <= u <= self.size[0] - wide and high <= v <= self.size[1] - high
        return inside and not any(
            left - wide < u < right + wide and top - high < v < bottom + high
            for left, top, right, bottom in self.blocked
        )

    def name_target(self, text: str, u: float, v: float) -> None:
        """Writes the target's name, which later names keep out of."""
        wide, high = 100 * self.unit, 18 * self.unit
        self.blocked.append((u - wide, v - high, u + wide, v + high))
        pill(self.draw, (u, v), text, round(17 * self.unit), TARGET)

    def ring(self, text: str, u: float, v: float, radius: float) -> None:
        """Draws a ring round the target, and its name above or below where that is free."""
        self.draw.circle((u, v), radius, None, TARGET, max(2, round(2.5 * self.unit)))
        for place in (v - radius - 22 * self.unit, v + radius + 22 * self.unit):
            if self.free(u, place, 90, 20):
                self.name_target(text, u, place)
                break

    def point_to(self, text: str, pixel: Array, behind: bool) -> None:
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
        self.draw.polygon([tuple(tip), tuple(base + wing), tuple(base - wing)], TARGET)
        self.name_target(text, *spot)


def draw_moving_box(image: Image.Image, view: View, box: Array, width: float) -> None:
    """Draws the edges of a box (2, 3), `width` pixels wide, as the camera `view` sees them."""
    draw = ImageDraw.Draw(image, "RGBA")
    corners = list(product((0, 1), repeat=3))
    pixels = view.project(np.array([box[list(c), range(3)] for c in corners]))[0]
    for a, b in combinations(range(8), 2):
        if sum(one != two for one, two in zip(corners[a], corners[b], strict=True)) == 1:
            draw.line([tuple(pixels[a]), tuple(pixels[b])], MOVING, max(1, round(width)))
