"""Draws the edges of a moving box on a picture of the whole scene."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import View

MOVING: tuple[int, int, int] = (128, 92, 220)


def draw_moving_box(image: Image.Image, view: View, box: Array, width: float) -> None:
    """Draws the edges of a box (2, 3), `width` pixels wide, as the camera `view` sees them."""
    draw = ImageDraw.Draw(image, "RGBA")
    corners = list(product((0, 1), repeat=3))
    pixels = view.project(np.array([box[list(c), range(3)] for c in corners]))[0]
    for a, b in combinations(range(8), 2):
        if sum(one != two for one, two in zip(corners[a], corners[b], strict=True)) == 1:
            draw.line([tuple(pixels[a]), tuple(pixels[b])], MOVING, max(1, round(width)))
