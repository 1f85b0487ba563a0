"""Says how a video looks: size, frame rate, playback speed and smoothness of edges."""

from __future__ import annotations

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
    fps: float = 25
    speed: float = 1.0
    caption: str | None = None
    samples: int = 0

    @property
    def unit(self) -> float:
        """Returns the pixels of what has one pixel in a picture that is 720 high."""
        return self.size[1] / 720
