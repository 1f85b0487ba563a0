"""Writes the names of items and depot into the chase view, where they cover nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.geometry.boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import View
from mjcollect.render.overlay import NODES, TARGET, pill
from mjcollect.scene.order import DEPOT, node_name

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom in pixels
NEAREST, FARTHEST = 5.0, 600.0  # Nodes between these distances from the camera (m) are named.


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
    seen = segment_clear(np.broadcast_to(view.eye, points.shape), points, scene.obstacles, 1e-6)
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
