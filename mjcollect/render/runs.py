"""Reads the folder of any finished run, for videos and replays."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjcollect.flight.disturbance import REST_SPEED as DISTURBED_REST
from mjcollect.render.arrivals import REST_SPEED, progress
from mjcollect.render.fleet import FleetProgress, load_fleet
from mjcollect.scene.air import AIR_FILE, Air
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import SHIELD_FILE, Trajectory, load_shield

KINDS = ("fleet", "segment", "mission")


class UnreadableRun(ValueError):
    """Says that a folder is no finished run; the message says what is missing and what to do."""


class FlownRun(NamedTuple):
    """Holds what a run's folder says of its flight.

    Attributes:
        name: of the folder. kind: fleet, segment or mission. result: the document of KIND.json.
        fleet: the flights, of which a segment or a mission has one.
        air: what disturbed the flight; None in calm air.
    """

    name: str
    kind: str
    result: dict[str, Any]
    fleet: FleetProgress
    air: Air | None

    @property
    def caption(self) -> str | None:
        """Returns the headline of a failed run, as 'CONTACT at 2.40 s'; None if it succeeded."""
        if self.result.get("success") or not self.result.get("violations"):
            return None
        # Those of a fleet are in order for each UAV only.
        first = min(self.result["violations"], key=lambda each: float(each.get("t") or 0.0))
        return violation_text(first)


def violation_text(violation: dict[str, Any]) -> str:
    """Returns who broke which rule and when, as 'UAV 1: CONTACT at 2.40 s'."""
    when = "" if violation.get("t") is None else f" at {float(violation['t']):.2f} s"
    whose = violation.get("uavs", [violation["uav"]] if "uav" in violation else [])
    who = " and ".join(f"UAV {number}" for number in whose)
    return f"{who}{': ' if who else ''}{str(violation['kind']).upper()}{when}"


def load_run(folder: str | os.PathLike[str]) -> FlownRun:
    """Reads a run's folder, of a segment, a mission or a fleet.

    Raises:
        UnreadableRun: it is none, or a file of it is missing or not as it was written.
    """
    folder = Path(folder)
    kind = next((k for k in KINDS if os.path.isfile(folder / f"{k}.json")), None)
    if kind is None:
        raise UnreadableRun(
            f"{folder}: holds neither segment.json nor mission.json nor fleet.json; name the "
            "folder of a finished run, as train.segment, train.mission and train.fly make it"
        )
    try:
        text = (folder / f"{kind}.json").read_text(encoding="utf-8")
        result = json.loads(text, parse_constant=_refuse)
        for violation in result.get("violations", []):
            violation_text(violation)
        air = Air.load(folder / AIR_FILE) if (folder / AIR_FILE).is_file() else None
        fleet = load_fleet(folder) if kind == "fleet" else _single(folder, kind, result, air)
        run = FlownRun(shown_name(folder.resolve().name), kind, result, fleet, air)
    except (OSError, SceneError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnreadableRun(
            f"{folder}: not a readable run ({type(error).__name__}: {one_line(error)}); "
            "run the training or flight again"
        ) from None
    return run


def _refuse(number: str) -> float:
    raise ValueError(f"{number} is no number of JSON")


def shown_name(name: str) -> str:
    """Returns a file's name with replacement characters for what is no UTF-8."""
    return os.fsencode(name).decode("utf-8", "replace")


def one_line(error: object) -> str:
    """Returns an error's message in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]


def _single(folder: Path, kind: str, result: dict[str, Any], air: Air | None) -> FleetProgress:
    """Reads the one flight of a segment's or mission's run folder."""
    scene = Scene.load(folder / "scene.json")
    trajectory = Trajectory.load(folder / "trajectory.csv")
    segment = result["segment"] if kind == "segment" else None
    rest = REST_SPEED if air is None else DISTURBED_REST
    flown = progress(scene, trajectory, list(result["order"]), segment, rest)
    return FleetProgress.alone(flown, np.reshape(load_shield(folder / SHIELD_FILE), (-1, 2)))
