"""Holds what disturbed one recorded flight, and saves it as a JSON document beside the flight."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.scene.moving import MovingBox

AIR_FILE = "air.json"


@dataclass(frozen=True)
class Air:
    """Says what one flight met.

    Attributes:
        flight: its number among those flown. wind: (3,) steady wind (m/s²).
        gain: acceleration per command. delay: s by which commands came late.
        moving: the boxes that moved, those of the scene file among them.
        slot: a slot's duration (s). push: (S, 3) wind and gust at the end of each slot (m/s²).
    """

    flight: int
    wind: Array
    gain: float
    delay: float
    moving: tuple[MovingBox, ...]
    slot: float
    push: Array

    def pushes(self, t: Array) -> Array:
        """Returns wind and gust (R, 3) at times t (R,) in s, straight between the slots' ends."""
        if len(self.push) == 0:
            return np.tile(self.wind, (len(t), 1))
        ends = self.slot * np.arange(1, len(self.push) + 1)
        return np.stack([np.interp(t, ends, self.push[:, k]) for k in range(3)], axis=1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the JSON file; `load` gives back the same floats."""
        document = {
            "flight": self.flight,
            "wind": self.wind.tolist(),
            "gain": self.gain,
            "delay": self.delay,
            "moving": [box.to_dict() for box in self.moving],
            "slot": self.slot,
            "push": self.push.tolist(),
        }
        Path(path).write_text(json.dumps(document) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Air:
        """Reads a file written by `save`.

        Raises:
            OSError, ValueError, KeyError: the file is not there, or not as written by `save`.
        """
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        return cls(
            flight=document["flight"],
            wind=np.array(document["wind"], dtype=float),
            gain=document["gain"],
            delay=document["delay"],
            moving=tuple(map(MovingBox.from_dict, document["moving"])),
            slot=document["slot"],
            push=np.array(document["push"], dtype=float).reshape(-1, 3),
        )
