"""What is drawn over a rendered frame with PIL: panels, speed bar, the overview inset."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjcollect.geometry.boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import Picture, View
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene

Colour = tuple[int, ...]
SPEED_MAP = "viridis"  # readable by the colour-blind and in grey
WHITE: Colour = (255, 255, 255)
GREY: Colour = (190, 198, 206)
PANEL: Colour = (16, 22, 30, 205)
PENDING: Colour = (242, 166, 0)
COLLECTED: Colour = (0, 178, 127)
TARGET: Colour = (242, 64, 153)
DEPOT: Colour = (26, 115, 217)
UAV: Colour = (255, 96, 16)
SHIELD: Colour = (86, 180, 233)


def speed_colours(speed: Array, v_max: float) -> Array:
    """RGB (..., 3) in 0..1 of speeds in m/s."""
    rgba = matplotlib.colormaps[SPEED_MAP](np.clip(speed / v_max, 0.0, 1.0))
    return np.asarray(rgba)[..., :3]


@lru_cache
def font(pixels: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """matplotlib's own DejaVu Sans, so that no system font is needed."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), max(pixels, 5)
    )


def node_colour(node: int, progress: Progress, reached: int) -> Colour:
    """Colour of an item or the depot once `reached` targets were reached."""
    if reached < len(progress.targets) and node == progress.targets[reached]:
        return TARGET
    if node in progress.collected(reached):
        return COLLECTED
    return DEPOT if node < 0 else PENDING


class Overview:
    """The whole scene from one corner, with the flown path drawn on a still of it.

    Stills are rendered once per state of the items, which keeps a video affordable.
    """

    def __init__(self, scene: Scene, progress: Progress, view: View, trail: Array, speed: Array):
        """Project everything once.

        Args:
            scene, progress: what to mark. view: the camera of the stills.
            trail: (N, 3) points of the flown path. speed: (N,) m/s there.
        """
        self._scene, self._progress, self._view = scene, progress, view
        self._pixels = view.project(trail)[0]
        self._colours = (speed_colours(speed, scene.v_max) * 255).astype(int)
        hidden = ~segment_clear(trail[:, None], view.eye[None, None], scene.obstacles, 1e-6)[:, 0]
        self._alpha = np.where(hidden, 110, 255)
        self._nodes = (-1, *range(len(scene.items)))
        self._node_pixels = view.project(np.array([scene.point(node) for node in self._nodes]))[0]

    def path(self, image: Image.Image, first: int, last: int, width: float) -> None:
        """Draw the path's points first..last; fainter where a box hides it."""
        draw = ImageDraw.Draw(image, "RGBA")
        for outline in (True, False):
            for k in range(first, last):
                colour = (20, 24, 30) if outline else tuple(self._colours[k])
                ends = [tuple(self._pixels[k]), tuple(self._pixels[k + 1])]
                alpha = int(self._alpha[k] * (0.35 if outline else 1.0))
                draw.line(ends, (*colour, alpha), round(width * (2.0 if outline else 1.0)))

    def nodes(self, image: Image.Image, reached: int, radius: float) -> None:
        """Draw items as numbered discs and the depot as a square."""
        draw = ImageDraw.Draw(image, "RGBA")
        ordered = sorted(zip(self._nodes, self._node_pixels, strict=True), key=lambda n: n[1][1])
        for node, (x, y) in ordered:
            colour = node_colour(node, self._progress, reached)
            grow = radius * (1.25 if colour == TARGET else 1.0)
            box = (x - grow, y - grow, x + grow, y + grow)
            shape = draw.rectangle if node < 0 else draw.ellipse
            shape(box, colour, WHITE, max(1, round(radius / 6)))
            label = "D" if node < 0 else str(node)
            dark = colour == PENDING
            draw.text((x, y), label, (20, 24, 30) if dark else WHITE,
                      font(round(radius * 1.25), True), anchor="mm")  # fmt: skip

    def uav(self, image: Image.Image, x: Array, radius: float) -> None:
        """Draw the quadrotor's marker at `x` (3,) and a thin line down to the ground."""
        foot = np.array([x[0], x[1], self._scene.bounds[0, 2]])
        (u, v), (fu, fv) = self._view.project(np.stack([x, foot]))[0]
        draw = ImageDraw.Draw(image, "RGBA")
        draw.line([(u, v), (fu, fv)], (*UAV, 170), max(1, round(radius / 5)))
        draw.ellipse((u - radius, v - radius, u + radius, v + radius), UAV, WHITE,
                     max(1, round(radius / 4)))  # fmt: skip


class Inset:
    """The overview as a framed picture in a corner; the path is drawn once, piece by piece."""

    def __init__(self, overview: Overview, size: tuple[int, int], width: int):
        """Cut the middle of stills of `size` pixels; the inset is `width` pixels wide."""
        self._overview = overview
        self._size = size
        wide = min(size[0], round(size[1] * 0.95))
        left = (size[0] - wide) // 2
        self._cut = (left, 0, left + wide, size[1])
        self._small = (width, round(width * size[1] / wide))
        self._zoom = wide / width
        self._canvas: Image.Image | None = None
        self._reached = self._drawn = -1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, frame excluded."""
        return self._small

    def picture(self, still: Picture, reached: int, point: int, x: Array) -> Image.Image:
        """The inset with the path up to `point` and the quadrotor at `x` (3,)."""
        overview, zoom = self._overview, self._zoom
        if self._canvas is None or reached != self._reached:
            self._canvas = Image.fromarray(still)
            self._reached, self._drawn = reached, 0
        if point > self._drawn:
            overview.path(self._canvas, self._drawn, point, 2.0 * zoom)
            self._drawn = point
        image = self._canvas.copy()
        overview.nodes(image, reached, 8.0 * zoom * self._small[0] / 340)
        overview.uav(image, x, 6.0 * zoom * self._small[0] / 340)
        return image.crop(self._cut).resize(self._small, Image.Resampling.BOX)


def fitted(text: str, letters: ImageFont.FreeTypeFont, width: float) -> str:
    """`text`, cut short with an ellipsis if it is wider than `width` pixels."""
    if letters.getlength(text) <= width:
        return text
    while text and letters.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def panel(draw: ImageDraw.ImageDraw, box: tuple[float, ...], radius: float) -> None:
    """A dark translucent plate."""
    draw.rounded_rectangle(box, radius, PANEL)


def pill(
    draw: ImageDraw.ImageDraw, centre: tuple[float, float], text: str, pixels: int, colour: Colour
) -> None:
    """A short label on a plate with a coloured rim."""
    letters = font(pixels, True)
    half = draw.textlength(text, letters) / 2 + 0.6 * pixels
    x, y = centre
    box = (x - half, y - 0.85 * pixels, x + half, y + 0.85 * pixels)
    draw.rounded_rectangle(box, 0.85 * pixels, PANEL, colour, max(1, pixels // 9))
    draw.text((x, y), text, WHITE, letters, anchor="mm")


class Hud:
    """The plates of a frame: what is flown at the top left, the instruments below it."""

    def __init__(self, scene: Scene, size: tuple[int, int], speed: float):
        """Sizes follow the frame's height. `speed` is the playback speed."""
        self._scene, self._size = scene, size
        self._unit = size[1] / 720
        self._playback = f"{speed:g}×"
        width = round(336 * self._unit)
        ramp = speed_colours(np.linspace(0, scene.v_max, width), scene.v_max)
        bar = np.repeat((ramp * 255).astype(np.uint8)[None], max(2, round(14 * self._unit)), axis=0)
        self._bar = Image.fromarray(bar)

    def title(self, draw: ImageDraw.ImageDraw, text: str) -> None:
        """Scene name and what is flown."""
        u = self._unit
        name = fitted(self._scene.name, font(round(24 * u), True), 420 * u)
        width = max(draw.textlength(name, font(round(24 * u), True)),
                    draw.textlength(text, font(round(19 * u))))  # fmt: skip
        panel(draw, (20 * u, 20 * u, 52 * u + width, 96 * u), 10 * u)
        draw.text((36 * u, 44 * u), name, WHITE, font(round(24 * u), True), anchor="lm")
        draw.text((36 * u, 74 * u), text, GREY, font(round(19 * u)), anchor="lm")

    def instruments(
        self, image: Image.Image, time: float, speed: float, goal: str, distance: float, items: str
    ) -> None:
        """Time, speed against its limit, distance to the target, items, playback speed."""
        draw = ImageDraw.Draw(image, "RGBA")
        u, height = self._unit, self._size[1]
        left, top = 20 * u, height - 176 * u
        panel(draw, (left, top, left + 368 * u, height - 20 * u), 10 * u)
        left, right = left + 16 * u, left + 352 * u
        draw.text(
            (left, top + 30 * u),
            f"{time:6.2f} s".strip(),
            WHITE,
            font(round(32 * u), True),
            anchor="lm",
        )
        draw.text((right, top + 30 * u), self._playback, GREY, font(round(20 * u)), anchor="rm")
        y = round(top + 84 * u)
        x = round(left)
        draw.text((left, top + 66 * u), "speed", GREY, font(round(17 * u)), anchor="lm")
        draw.text((right, top + 66 * u), f"{speed:.1f} / {self._scene.v_max:g} m/s", WHITE,
                  font(round(17 * u)), anchor="rm")  # fmt: skip
        full = self._bar.width
        filled = min(full, max(1, round(full * speed / self._scene.v_max)))
        draw.rectangle((x, y, x + full, y + self._bar.height - 1), (70, 78, 88, 255))
        image.paste(self._bar.crop((0, 0, filled, self._bar.height)), (x, y))
        draw.text((left, top + 122 * u), goal, GREY, font(round(17 * u)), anchor="lm")
        draw.text((left + 120 * u, top + 122 * u), f"{distance:.0f} m", WHITE,
                  font(round(17 * u), True), anchor="lm")  # fmt: skip
        draw.text((right, top + 122 * u), items, WHITE, font(round(17 * u)), anchor="rm")

    def shield(self, draw: ImageDraw.ImageDraw) -> None:
        """A mark above the instruments: the shield changes the command that is flown."""
        u = self._unit
        left, bottom = 20 * u, self._size[1] - 184 * u
        letters = font(round(18 * u), True)
        width = draw.textlength("shield", letters)
        panel(draw, (left, bottom - 36 * u, left + 54 * u + width, bottom), 10 * u)
        x, y, s = left + 23 * u, bottom - 18 * u, 10 * u
        crest = [(-0.8, -0.85), (0.0, -1.1), (0.8, -0.85), (0.75, 0.1), (0.0, 1.1), (-0.75, 0.1)]
        draw.polygon([(x + s * across, y + s * down) for across, down in crest], SHIELD)
        draw.text((left + 40 * u, y), "shield", WHITE, letters, anchor="lm")

    def card(self, draw: ImageDraw.ImageDraw, lines: list[tuple[str, Colour]]) -> None:
        """A plate with a big first line at the top left: opening and result."""
        u = self._unit
        fonts = [font(round((32 if row == 0 else 21) * u), row == 0) for row in range(len(lines))]
        room = self._size[0] - 120 * u
        texts = [
            fitted(text, letters, room) for (text, _), letters in zip(lines, fonts, strict=True)
        ]
        width = max(letters.getlength(text) for text, letters in zip(texts, fonts, strict=True))
        bottom = 20 * u + (42 + 34 * len(lines)) * u
        panel(draw, (20 * u, 20 * u, 68 * u + width, bottom), 12 * u)
        colours = [colour for _, colour in lines]
        for row, (text, colour, letters) in enumerate(zip(texts, colours, fonts, strict=True)):
            y = (54 if row == 0 else 62 + 34 * row) * u
            draw.text((44 * u, y), text, colour, letters, anchor="lm")


def heads_for(node: int) -> str:
    """'to item 3' or 'to depot'."""
    return f"to {node_name(node)}"
