"""Draws paths, nodes and UAVs over a still of the whole scene, and says where on the picture."""

from __future__ import annotations

from collections.abc import Container, Sequence
from itertools import combinations, product

import numpy as np
from PIL import Image, ImageDraw

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import View
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.labels import Rectangle
from mjcollect.render.overlay import DARK, MOVING, WHITE, font, node_look, uav_colour, write
from mjcollect.scene.order import DEPOT

CORNERS = np.array(list(product((0, 1), repeat=3)))
EDGES = [(a, b) for a, b in combinations(range(8), 2) if np.sum(CORNERS[a] != CORNERS[b]) == 1]


class Overview:
    """Draws flown paths, nodes and UAVs on a still of the whole scene, seen from one corner.

    Stills are rendered once per state of the items, which keeps a video affordable.
    """

    def __init__(
        self, fleet: FleetProgress, view: View, trails: Sequence[tuple[Array, Array]]
    ) -> None:
        """Projects everything once.

        Args:
            fleet: what to mark. view: the camera of the stills.
            trails: of each flight (N, 3) points of its path in metres and (N, 3) RGB in 0..1 there.
        """
        scene, self._fleet, self._view = fleet.scene, fleet, view
        self._pixels = [view.project(points)[0] for points, _ in trails]
        self._colours = [(colours * 255).astype(int) for _, colours in trails]
        eye = view.eye[None, None]
        hidden = [~segment_clear(at[:, None], eye, scene.tree, 1e-6)[:, 0] for at, _ in trails]
        self._alpha = [np.where(behind, 110, 255) for behind in hidden]
        pixels = view.project(np.array([scene.point(node) for node in scene.nodes]))[0]
        # Lower ones are drawn later, over those behind them.
        self._nodes = sorted(zip(scene.nodes, pixels, strict=True), key=lambda n: n[1][1])

    @property
    def _order(self) -> list[int]:
        """Returns the flights in the order in which they are drawn, the lead on top."""
        lead = self._fleet.lead
        return [*(m for m in range(len(self._pixels)) if m != lead), lead]

    def paths(self, image: Image.Image, last: Sequence[int], width: float) -> None:
        """Draws each path up to the point `last` (M,), `width` pixels wide."""
        self.paths_on(image, [0] * len(self._pixels), last, width)

    def paths_on(
        self, image: Image.Image, first: Sequence[int], last: Sequence[int], width: float
    ) -> None:
        """Draws each path from the point `first` (M,) on up to the point `last` (M,)."""
        for m in self._order:
            if last[m] > first[m]:
                self._path(image, m, first[m], last[m], width)

    def path_places(
        self, first: Sequence[int], last: Sequence[int], width: float
    ) -> list[Rectangle]:
        """Returns what each path that `paths_on` draws anything of lies in."""
        return [
            _around(self._pixels[m][first[m] : last[m] + 1], width + 2)
            for m in self._order
            if last[m] > first[m]
        ]

    def _path(self, image: Image.Image, m: int, first: int, last: int, width: float) -> None:
        """Draws the points first..last of flight `m`, fainter where a box hides it."""
        draw, pixels = ImageDraw.Draw(image, "RGBA"), self._pixels[m]
        for outline in (True, False):
            for k in range(first, last):
                colour = DARK if outline else tuple(self._colours[m][k])
                ends = [tuple(pixels[k]), tuple(pixels[k + 1])]
                alpha = int(self._alpha[m][k] * (0.35 if outline else 1.0))
                draw.line(ends, (*colour, alpha), round(width * (2.0 if outline else 1.0)))

    def nodes(
        self, image: Image.Image, reached: Sequence[int], radius: float,
        drawn: Container[int] | None = None,
    ) -> None:  # fmt: skip
        """Draws items as numbered discs and the depot as a square, of `radius` pixels.

        Args:
            image: drawn on. reached: how many targets each flight has reached, (M,).
            radius: of most nodes. drawn: only these nodes are drawn, if given.
        """
        draw = ImageDraw.Draw(image, "RGBA")
        for node, place in self._nodes:
            if drawn is not None and node not in drawn:
                continue
            look = node_look(self._fleet, node, reached)
            grow = radius * look.grow
            shape = draw.rectangle if node <= DEPOT else draw.ellipse
            box = (*(place - grow), *(place + grow))
            shape(box, look.fill, look.rim, max(1, round(radius * look.edge)))
            letters = font(radius * 1.25, True)
            write(draw, tuple(place), _label(node), look.text, letters, "mm")

    def node_places(self, reached: Sequence[int], radius: float) -> dict[int, Rectangle]:
        """Returns what each node, drawn so, lies in."""
        places = {}
        for node, place in self._nodes:
            grow = radius * node_look(self._fleet, node, reached).grow
            left, top, right, bottom = font(radius * 1.25, True).getbbox(_label(node), anchor="mm")
            text = place + np.array([[left, top], [right, bottom]])
            disc = np.stack([place - grow, place + grow])
            places[node] = _around(np.concatenate([text, disc]), 2)
        return places

    def uavs(self, image: Image.Image, xs: Array, radius: float) -> None:
        """Draws each quadrotor's marker at `xs` (M, 3) and a thin line down to the ground."""
        draw, ends = ImageDraw.Draw(image, "RGBA"), self._uav_ends(xs)
        for m in self._order:
            colour, ((u, v), below) = uav_colour(self._fleet, m), ends[m]
            draw.line([(u, v), tuple(below)], (*colour, 170), max(1, round(radius / 5)))
            draw.circle((u, v), radius, colour, WHITE, max(1, round(radius / 4)))

    def uav_places(self, xs: Array, radius: float) -> list[Rectangle]:
        """Returns what each quadrotor, drawn so, lies in."""
        return [_around(ends, radius + 2) for ends in self._uav_ends(xs)]

    def _uav_ends(self, xs: Array) -> Array:
        """Returns the pixels of quadrotors (M, 3) and of the ground below each, (M, 2, 2)."""
        floor = np.full(len(xs), self._fleet.scene.bounds[0, 2])
        feet = np.column_stack([xs[:, :2], floor])
        return self._view.project(np.stack([xs, feet], axis=1))[0]


def draw_moving_box(image: Image.Image, view: View, box: Array, width: float) -> None:
    """Draws the edges of a box (2, 3), `width` pixels wide, as the camera `view` sees them."""
    draw, pixels = ImageDraw.Draw(image, "RGBA"), _corner_pixels(view, box)
    for a, b in EDGES:
        draw.line([tuple(pixels[a]), tuple(pixels[b])], MOVING, max(1, round(width)))


def moving_box_place(view: View, box: Array, width: float) -> Rectangle:
    """Returns what a moving box, drawn so, lies in."""
    return _around(_corner_pixels(view, box), width + 2)


def _corner_pixels(view: View, box: Array) -> Array:
    return view.project(box[CORNERS, range(3)])[0]


def _label(node: int) -> str:
    """Returns what stands in a node's mark."""
    return "D" if node <= DEPOT else str(node)


def _around(pixels: Array, margin: float) -> Rectangle:
    """Returns the rectangle around pixels (N, 2) with a margin."""
    left, top = (pixels.min(axis=0) - margin).tolist()
    right, bottom = (pixels.max(axis=0) + margin).tolist()
    return left, top, right, bottom
