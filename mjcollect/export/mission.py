"""Reads a flown mission with its place on Earth, for all formats."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import FLOOR, corners
from mjcollect.scene.place import Frame
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory


class ExportError(ValueError):
    """Says why a run cannot be exported; the message names what is wrong and the fix."""


@dataclass(frozen=True)
class FlownMission:
    """Holds a finished mission of a scene with an origin.

    Attributes:
        order: items in the order of their visit. stops: row of the trajectory at which each segment
            ends, the last of them at the depot.
    """

    scene: Scene
    trajectory: Trajectory
    order: tuple[int, ...]
    stops: tuple[int, ...]

    def __post_init__(self) -> None:
        """Raises an ExportError if the scene has no origin."""
        if self.scene.origin is None:
            raise ExportError(
                f"scene.json: {self.scene.name}: has no origin, so its place on Earth is not "
                'known; add "origin": {"latitude": ..., "longitude": ...} to it and fly again'
            )

    @classmethod
    def of(cls, scene: Scene, trajectory: Trajectory, result: Mapping[str, Any]) -> FlownMission:
        """Returns the mission of a flight and what mission.json says of it.

        Raises:
            ExportError: the scene has no origin, or the mission was no success.
        """
        if not result["success"]:
            raise ExportError(
                "mission.json: success is false: only a flight that comes home with everything and "
                "breaks no rule becomes a plan; fly again"
            )
        seconds = np.cumsum([segment["time"] for segment in result["segments"]])
        stops = np.rint(seconds / scene.physics_step).astype(int)
        return cls(scene, trajectory, tuple(result["order"]), tuple(stops.tolist()))

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> FlownMission:
        """Reads the folder of a finished mission.

        Raises:
            ExportError: it does not hold one, or as `of` says. SceneError: its scene is refused.
        """
        folder = Path(folder)
        try:
            result = json.loads((folder / "mission.json").read_text(encoding="utf-8"))
            scene = Scene.load(folder / "scene.json")
            return cls.of(scene, Trajectory.load(folder / "trajectory.csv"), result)
        except FileNotFoundError as error:
            name = Path(str(error.filename)).name
            raise ExportError(
                f"run: {folder}: holds no {name}; name the folder of a finished mission"
            ) from None
        except (KeyError, TypeError, json.JSONDecodeError) as error:
            raise ExportError(f"run: {folder}: mission.json is damaged ({error!r})") from None

    @cached_property
    def frame(self) -> Frame:
        """Returns what turns metres into latitude and longitude."""
        assert self.scene.origin is not None
        return Frame(self.scene.origin)

    @property
    def rows(self) -> Array:
        """Returns the rows of the trajectory at the slots' ends, the first and all stops too."""
        every = np.arange(0, len(self.trajectory), self.scene.substeps)
        return np.union1d(every, [*self.stops, len(self.trajectory) - 1])

    def floor(self, box: Array) -> Array:
        """Returns the floor (4, 3) of a box (2 or 3, 3) as places, counterclockwise."""
        return self.frame.geographic(corners(box)[FLOOR])
