"""Names of items and depot in the chase view, placed where they cover nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.geometry.boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.camera import View
from mjcollect.render.overlay import TARGET, node_colour, pill
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom in pixels


def node_labels(
    image: Image.Image,
    scene: Scene,
    progress: Progress,
    reached: int,
    view: View,
    x: Array,
    blocked: Sequence[Rectangle],
) -> None:
    """Name what is in sight; bracket the target, or point to it where it is out of the picture.

    Args:
        image: drawn on. scene, progress, reached: what to name. view: the camera.
        x: (3,) the quadrotor, from which distances are counted.
        blocked: rectangles in pixels that labels keep out of.
    """
    draw = ImageDraw.Draw(image, "RGBA")
    unit = view.size[1] / 720
    target = progress.targets[reached] if reached < len(progress.targets) else None
    nodes = np.array([-1, *range(len(scene.items))])
    points = np.array([scene.point(int(node)) for node in nodes])
    pixels, depth = view.project(points)
    seen = segment_clear(np.broadcast_to(view.eye, points.shape), points, scene.obstacles, 1e-6)
    blocked = list(blocked)
    if target is not None:
        k = target + 1
        text = f"{node_name(target)} · {np.linalg.norm(points[k] - x):.0f} m"
        radius = max(14 * unit, scene.tolerance(target) / max(depth[k], 1.0) * view.size[1])
        _target(draw, view, text, pixels[k], float(depth[k]), radius, blocked)
    for node, point, (u, v), far, clear in zip(nodes, points, pixels, depth, seen, strict=True):
        near = np.linalg.norm(point - x) < 2 * scene.tolerance(int(node))  # just left: in the way
        if node == target or near or not clear or not 5.0 < far < 600.0:
            continue
        radius = scene.tolerance(int(node)) / far * view.size[1]
        place = (u, v - radius - 20 * unit)
        if _free(place, view.size, 45 * unit, 16 * unit, blocked):
            pill(draw, place, node_name(int(node)), round(15 * unit),
                 node_colour(int(node), progress, reached))  # fmt: skip
            blocked.append((u - 45 * unit, place[1] - 16 * unit, u + 45 * unit, v))


def _target(
    draw: ImageDraw.ImageDraw, view: View, text: str, pixel: Array, depth: float, radius: float,
    blocked: list[Rectangle],
) -> None:  # fmt: skip
    """Bracket and name the target at `pixel`, or point to it; takes its place in `blocked`."""
    unit, (width, height) = view.size[1] / 720, view.size
    u, v = pixel
    inside = depth > 0 and 0 <= u < width and 0 <= v < height
    if inside and _free((u, v), view.size, 0, 0, blocked):
        radius = min(radius, height / 3)
        for sx in (-1, 1):
            for sy in (-1, 1):
                corner = (u + sx * radius, v + sy * radius)
                arm = 0.45 * radius
                stroke = max(2, round(2.5 * unit))
                draw.line([corner, (corner[0] - sx * arm, corner[1])], TARGET, stroke)
                draw.line([corner, (corner[0], corner[1] - sy * arm)], TARGET, stroke)
        place = (u, v - radius - 22 * unit)
        if not _free(place, view.size, 90 * unit, 20 * unit, blocked):
            place = (u, v + radius + 22 * unit)
        if _free(place, view.size, 90 * unit, 20 * unit, blocked):
            _claim(place, unit, blocked)
            pill(draw, place, text, round(17 * unit), TARGET)
        return
    # Out of sight: an arrow on a ring round the centre of the picture.
    centre = np.array([width / 2, height / 2])
    aim = (pixel - centre) * (1 if depth > 0 else -1)
    aim = aim / max(float(np.linalg.norm(aim)), 1e-9)
    turns = np.radians([0, -25, 25, -50, 50, -80, 80, -120, 120])
    places = [
        centre
        + reach * height * np.array([1.3 * (c * aim[0] - s * aim[1]), s * aim[0] + c * aim[1]])
        for s, c in zip(np.sin(turns), np.cos(turns), strict=True)
        for reach in np.linspace(0.36, 0.12, 5)
    ]
    spot = next(
        (p for p in places if _free(tuple(p), view.size, 118 * unit, 40 * unit, blocked)), centre
    )
    side = np.array([-aim[1], aim[0]])
    tip = spot + aim * 34 * unit
    base = spot + aim * 20 * unit
    wing = side * 10 * unit
    if abs(aim[0]) > 0.5:  # beside the text, not under it
        shift = aim * [80 * unit, 0.0]
        tip, base = tip + shift, base + shift
    draw.polygon([tuple(tip), tuple(base + wing), tuple(base - wing)], TARGET)
    _claim((spot[0], spot[1]), unit, blocked)
    pill(draw, (spot[0], spot[1]), text, round(17 * unit), TARGET)


def _claim(place: tuple[float, float], unit: float, blocked: list[Rectangle]) -> None:
    u, v = place
    blocked.append((u - 100 * unit, v - 18 * unit, u + 100 * unit, v + 18 * unit))


def _free(
    place: tuple[float, ...], size: tuple[int, int], half_width: float, half_height: float,
    blocked: Sequence[Rectangle],
) -> bool:  # fmt: skip
    """Whether a label at `place` lies in the picture and outside every blocked rectangle."""
    u, v = place
    if not (half_width <= u <= size[0] - half_width and half_height <= v <= size[1] - half_height):
        return False
    return not any(
        left - half_width < u < right + half_width and top - half_height < v < bottom + half_height
        for left, top, right, bottom in blocked
    )
