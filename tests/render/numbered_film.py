"""A film without GL, which processes can make: each picture shows its number."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator

import numpy as np


class NumberedFilm:
    """Ends at one frame with an error, or with its process, if told so."""

    size = (8, 6)

    def __init__(self, count: int, fails: int = -1, dies: int = -1) -> None:
        self.count, self.fails, self.dies = count, fails, dies

    def __len__(self) -> int:
        return self.count

    def frames(self, part: int = 0, parts: int = 1) -> Generator[np.ndarray]:
        for number in range(part, self.count, parts):
            if number == self.fails:
                raise ValueError(f"no frame {number}")
            if number == self.dies:
                os.kill(os.getpid(), signal.SIGKILL)
            yield np.full((6, 8, 3), number, dtype=np.uint8)
