"""Says which moment of a flight is shown, by a clock that keys pause, speed up and set."""

from __future__ import annotations

# Keys that the viewer itself gives no meaning when it does not simulate; codes of GLFW.
SPACE, ENTER, RIGHT, LEFT, DOWN, UP = 32, 257, 262, 263, 264, 265
KEYS = (
    ("Space", "pause, go on"),
    ("Enter", "from the start"),
    ("Left, Right", "5 s back, on"),
    ("Up, Down", "faster, slower"),
    ("[  ]", "other cameras"),
)
JUMP = 5.0  # Left and right go so many seconds of flight back and forth.
SLOWEST, FASTEST = 1 / 16, 16.0


class Playback:
    """Is a clock that runs from 0 to the end of a flight, and stops there.

    Attributes:
        time: the moment shown, in s of flight. speed: seconds of flight per second.
        paused: whether the clock stands still.
    """

    def __init__(self, duration: float, speed: float = 1.0) -> None:
        """Starts at 0 with a flight of so many seconds."""
        self._duration = duration
        self.time, self.speed, self.paused = 0.0, speed, False

    def advance(self, seconds: float) -> None:
        """Lets so many seconds pass for who looks on."""
        if not self.paused:
            self._move(seconds * self.speed)

    def press(self, key: int) -> None:
        """Does what a key means; others than KEYS mean nothing."""
        if key == SPACE:
            if self.time >= self._duration:
                self.time = 0.0
                self.paused = True  # what follows lets it run
            self.paused = not self.paused
        elif key == ENTER:
            self.time, self.paused = 0.0, False
        elif key in (LEFT, RIGHT):
            self._move(JUMP if key == RIGHT else -JUMP)
        elif key in (UP, DOWN):
            factor = 2.0 if key == UP else 0.5
            self.speed = min(max(self.speed * factor, SLOWEST), FASTEST)

    def _move(self, seconds: float) -> None:
        self.time = min(max(self.time + seconds, 0.0), self._duration)
