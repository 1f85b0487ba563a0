"""Draws the small picture of the whole scene in the corner of a frame, on which paths grow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import Picture, View, framing
from mjcollect.render.film.overview import Overview, draw_moving_box, moving_box_place
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.labels import Rectangle

Counts = NDArray[np.int_]
Part = tuple[int, int, int, int]  # of a picture: left, top, right, bottom in pixels
SHARE = 0.27  # The inset takes this share of a frame's width.
FILL = 0.93  # The scene takes this share of the inset's width or height.


def inset_size(size: tuple[int, int]) -> tuple[int, int]:
    """Returns width and height of the inset of frames of a size, in pixels."""
    return round(SHARE * size[0]), -(-size[1] // _zoom(size))


def _zoom(size: tuple[int, int]) -> int:
    """Returns how many pixels of a still, of which the middle is shown, make one of the inset."""
    small = round(SHARE * size[0])
    return max(1, min(round(0.95 * size[1] / small), size[0] // small))


class Inset:
    """Makes the insets of frames, of which some may be left out, but whose numbers never fall.

    It is the middle of a still, made small. The paths are drawn on it once, piece by piece, in the
    same steps whichever frames are left out, so that each frame has the same inset in any case.
    From frame to frame only the parts of the picture are drawn anew in which something changes.
    """

    def __init__(
        self, fleet: FleetProgress, wide: View, trails: Sequence[tuple[Array, Array]],
        last: Counts, reached: Counts,
    ) -> None:  # fmt: skip
        """Has nothing drawn yet.

        Args:
            fleet, trails: as of `Overview`. wide: what stills of the frames' size show otherwise.
            last: (F, M) the last point of each path that is passed in each frame.
            reached: (F, M) how many targets each flight has reached in each frame.
        """
        self._last, self._reached, self._shown = last, reached, -1
        changed = np.any(np.diff(reached, axis=0, prepend=-1), axis=1)
        # In each frame, the first one with as many targets reached, whose still it is drawn on.
        self._since = np.maximum.accumulate(np.where(changed, np.arange(len(reached)), 0))
        self.size, self._zoom = inset_size(wide.size), _zoom(wide.size)
        middle = self._zoom * self.size[0], wide.size[1]
        bounds, direction = fleet.scene.bounds, wide.target - wide.eye
        self._view = framing(bounds, direction, wide.fovy, middle, FILL)
        self._still_view = replace(self._view, size=wide.size)
        self._overview = Overview(fleet, self._view, trails)
        self._changed: list[Rectangle] = []  # Here all is to be drawn anew in the next frame.

    def picture(
        self, frame: int, still: Callable[[View, tuple[int, ...]], Picture], xs: Array,
        moving: Sequence[Array] = (),
    ) -> Image.Image:  # fmt: skip
        """Returns the inset of a frame, valid until the next one.

        Args:
            frame: its number. xs: (M, 3) the quadrotors. moving: (2, 3) corners of each moving box.
            still: renders what a camera sees when so many targets are reached, (M,).
        """
        reached, since = tuple(self._reached[frame].tolist()), int(self._since[frame])
        zoom, drawn = self._zoom, [0] * len(xs)
        size = zoom * self.size[0] / 340
        if self._shown < since:
            self._begin(still(self._still_view, reached))
            self._nodes = self._overview.node_places(reached, 8.0 * size)
            self._shown = since - 1
        else:
            drawn = self._last[self._shown].tolist()
        flown = self._overview.path_places(drawn, self._last[frame], 2.0 * zoom)
        for step in range(self._shown + 1, frame + 1):
            self._overview.paths_on(self._paths, drawn, self._last[step], 2.0 * zoom)
            drawn = self._last[step].tolist()
        self._shown = frame
        loose = self._overview.uav_places(xs, 6.0 * size)
        loose += [moving_box_place(self._view, box, 2.0 * zoom) for box in moving]
        parts, nodes = self._parts([*self._changed, *flown, *loose])
        self._changed = loose  # It will be elsewhere.
        for part in parts:
            self._marked.paste(self._paths.crop(part), part)
        for box in moving:
            draw_moving_box(self._marked, self._view, box, 2.0 * zoom)
        self._overview.nodes(self._marked, reached, 8.0 * size, nodes)
        self._overview.uavs(self._marked, xs, 6.0 * size)
        for part in parts:
            place = part[0] // zoom, part[1] // zoom
            self._small.paste(self._marked.crop(part).reduce(zoom), place)
        return self._small

    def _begin(self, still: Picture) -> None:
        """Takes a still on which nothing is drawn yet."""
        width, height = self._view.size
        left = (still.shape[1] - width) // 2
        middle = np.ascontiguousarray(still[:, left : left + width])
        self._paths = Image.fromarray(middle)  # only paths are drawn on it
        self._marked, self._small = self._paths.copy(), Image.new("RGB", self.size)
        self._changed = [(0.0, 0.0, float(width), float(height))]

    def _parts(self, changed: Iterable[Rectangle]) -> tuple[list[Part], set[int]]:
        """Returns the parts of the picture to draw anew, and the nodes that are in them.

        They hold all that changed and, whole, each node that they touch; none overlaps another.
        """
        nodes = {node: self._aligned(place) for node, place in self._nodes.items()}
        parts: list[Part] = []
        todo, touched = [self._aligned(place) for place in changed], set[int]()
        while todo:
            part = todo.pop()
            others = [other for other in parts if _overlap(part, other)]
            new = {node for node in nodes.keys() - touched if _overlap(part, nodes[node])}
            if others or new:
                touched |= new
                parts = [other for other in parts if other not in others]
                todo.append(_union([part, *others, *(nodes[node] for node in new)]))
            elif part[0] < part[2] and part[1] < part[3]:
                parts.append(part)
        return parts, touched

    def _aligned(self, place: Rectangle) -> Part:
        """Returns a rectangle that is grown to whole pixels of the inset and cut to its edges."""
        (width, height), zoom = self._view.size, self._zoom
        left, top = (max(0, zoom * math.floor(x / zoom)) for x in place[:2])
        right, bottom = (zoom * math.ceil(x / zoom) for x in place[2:])
        return left, top, min(right, width), min(bottom, height)


def _overlap(one: Part, two: Part) -> bool:
    return one[0] < two[2] and two[0] < one[2] and one[1] < two[3] and two[1] < one[3]


def _union(parts: Sequence[Part]) -> Part:
    left, top, right, bottom = zip(*parts, strict=True)
    return min(left), min(top), max(right), max(bottom)
