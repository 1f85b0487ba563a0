"""Says how a video looks: size, frame rate, playback speed and smoothness of edges."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class VideoSettings:
    """Holds the settings of one video.

    Attributes:
        size: width and height in pixels, both even and at least 16.
        fps: frames per second of video.
        speed: seconds of flight per second of video.
        caption: headline of the result; None says whether the targets were reached.
        samples: OpenGL's multisampling, 0, 2, 4 or 8. 4 smooths edges, in software GL at more
            than twice the time.
    """

    size: tuple[int, int] = (1280, 720)
    fps: float = 30
    speed: float = 1.0
    caption: str | None = None
    samples: int = 0

    def __post_init__(self) -> None:
        """Refuses values that no video can have, by a ValueError that names them."""
        if min(self.size) < 16 or self.size[0] % 2 or self.size[1] % 2:
            raise ValueError(f"size: {self.size}: needs even numbers of at least 16 pixels")
        if not (0 < self.fps < math.inf and 0 < self.speed < math.inf):
            raise ValueError(f"fps, speed: {self.fps}, {self.speed}: must be positive numbers")

    @property
    def unit(self) -> float:
        """Returns the pixels of what has one pixel in a picture that is 720 high."""
        return self.size[1] / 720
