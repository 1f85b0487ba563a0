"""Draws the small picture of the whole scene in the corner of a frame, on which paths grow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mjcollect.geometry.compiled import Array
from mjcollect.render.camera import Picture, View
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.overlay import Overview, draw_moving_box

Counts = NDArray[np.int_]
SHARE = 0.27  # The inset takes this share of a frame's width.


def inset_size(size: tuple[int, int]) -> tuple[int, int]:
    """Returns width and height of the inset of frames of a size, in pixels."""
    small = round(SHARE * size[0])
    return small, round(small * size[1] / _cut(size))


def _cut(size: tuple[int, int]) -> int:
    """Returns the width of the middle of a still, an even number of pixels, that is shown."""
    return min(size[0], 2 * round(size[1] * 0.475))


class Inset:
    """Makes the insets of frames, of which some may be left out, but whose numbers never fall.

    It is the middle of a still, made small. The paths are drawn on it once, piece by piece, in the
    same steps whichever frames are left out, so that each frame has the same inset in any case.
    """

    def __init__(
        self, fleet: FleetProgress, view: View, trails: Sequence[tuple[Array, Array]],
        last: Counts, reached: Counts,
    ) -> None:  # fmt: skip
        """Has nothing drawn yet.

        Args:
            fleet, view, trails: as of `Overview`.
            last: (F, M) the last point of each path that is passed in each frame.
            reached: (F, M) how many targets each flight has reached in each frame.
        """
        self._last, self._reached, self._shown = last, reached, -1
        changed = np.any(np.diff(reached, axis=0, prepend=-1), axis=1)
        # In each frame, the first one with as many targets reached, whose still it is drawn on.
        self._since = np.maximum.accumulate(np.where(changed, np.arange(len(reached)), 0))
        width, cut = view.size[0], _cut(view.size)
        self._left, self._right = (width - cut) // 2, (width + cut) // 2
        self._view = replace(view, size=(cut, view.size[1]))
        self._overview = Overview(fleet, self._view, trails)
        self.size = inset_size(view.size)
        self._zoom = cut / self.size[0]

    def picture(
        self, frame: int, still: Callable[[tuple[int, ...]], Picture], xs: Array,
        moving: Sequence[Array] = (),
    ) -> Image.Image:  # fmt: skip
        """Returns the inset of a frame.

        Args:
            frame: its number. still: renders the whole scene with so many targets reached, (M,).
            xs: (M, 3) the quadrotors. moving: (2, 3) corners of each moving box.
        """
        reached = tuple(self._reached[frame].tolist())
        first, zoom = self._shown + 1, self._zoom
        if self._shown < self._since[frame]:
            middle = still(reached)[:, self._left : self._right]
            self._canvas = Image.fromarray(np.ascontiguousarray(middle))
            first = int(self._since[frame])
        for step in range(first, frame + 1):
            drawn = [0] * len(xs) if step == self._since[frame] else self._last[step - 1]
            self._overview.paths_on(self._canvas, drawn, self._last[step], 2.0 * zoom)
        self._shown = frame
        image = self._canvas.copy()
        for box in moving:
            draw_moving_box(image, self._view, box, 2.0 * zoom)
        self._overview.nodes(image, reached, 8.0 * zoom * self.size[0] / 340)
        self._overview.uavs(image, xs, 6.0 * zoom * self.size[0] / 340)
        return image.resize(self.size, Image.Resampling.BOX)
