"""Describes boxes that move to and fro along a path, as scene files and recorded flights hold them.

The judge reads boxes from here, so this shares no code with the flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjcollect.geometry.compiled import Array

Point = tuple[float, float, float]


@dataclass(frozen=True)
class MovingBox:
    """Describes a box, parallel to the axes, whose centre moves along a path and back for ever.

    Attributes:
        size: of its sides (m). path: two corners or more of its centre's path (m). speed: m/s.
        phase: where it starts, a share of the whole way there and back.
    """

    size: Point
    path: tuple[Point, ...]
    speed: float
    phase: float = 0.0

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> MovingBox:
        """Returns the box of a JSON document, without any check."""
        x, y, z = map(float, document["size"])
        path = tuple((float(a), float(b), float(c)) for a, b, c in document["path"])
        phase = float(document.get("phase", 0.0))
        return cls((x, y, z), path, float(document["speed"]), phase)

    def to_dict(self) -> dict[str, Any]:
        """Returns the JSON document; it holds a phase only where there is one."""
        document = {
            "size": list(self.size),
            "path": [list(point) for point in self.path],
            "speed": self.speed,
        }
        return document | ({"phase": self.phase} if self.phase else {})

    def centres(self, t: Array) -> Array:
        """Returns where its centre is (R, 3) at times t (R,) in s."""
        corners = np.array(self.path)
        pieces = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        marks = np.concatenate([[0.0], np.cumsum(pieces)])
        length = marks[-1]
        gone = 2.0 * length * self.phase + self.speed * t
        at = length - np.abs(np.mod(gone, 2.0 * length) - length)
        return np.stack([np.interp(at, marks, corners[:, k]) for k in range(3)], axis=1)

    def box_at(self, t: float) -> Array:
        """Returns its corners (2, 3) at a time in s."""
        centre, half = self.centres(np.array([t]))[0], np.array(self.size) / 2
        return np.stack([centre - half, centre + half])
