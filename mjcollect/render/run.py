"""Reads a run folder for pictures: who flew what, in which air, and how it ended."""

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


class FlownRun(NamedTuple):
    """Holds what a run folder says of its flights.

    Attributes:
        kind: one of KINDS. fleet: the flights. air: what disturbed them; None if nothing did.
        caption: headline of an unsuccessful run; None if it succeeded.
    """

    kind: str
    fleet: FleetProgress
    air: Air | None
    caption: str | None


def read_run(folder: str | os.PathLike[str]) -> FlownRun:
    """Reads the folder of a finished segment, mission or fleet.

    Raises:
        ValueError: the folder is none, or cannot be read; the message says why and what to do.
    """
    folder = Path(folder)
    kind = next((k for k in KINDS if (folder / f"{k}.json").is_file()), None)
    if kind is None:
        raise ValueError(
            f"{folder}: holds neither segment.json nor mission.json nor fleet.json; name the "
            "folder of a finished run (python -m train.segment or train.mission makes one)"
        )
    try:
        result = json.loads((folder / f"{kind}.json").read_text(encoding="utf-8"))
        air = Air.load(folder / AIR_FILE) if (folder / AIR_FILE).is_file() else None
        fleet = load_fleet(folder) if kind == "fleet" else _single(folder, kind, result, air)
        return FlownRun(kind, fleet, air, _caption(result))
    except (OSError, SceneError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{folder}: not a readable run ({type(error).__name__}: {one_line(error)}); "
            "run the training or flight again"
        ) from None


def _single(folder: Path, kind: str, result: dict[str, Any], air: Air | None) -> FleetProgress:
    """Reads the one flight of a segment's or mission's run folder."""
    scene = Scene.load(folder / "scene.json")
    trajectory = Trajectory.load(folder / "trajectory.csv")
    segment = result["segment"] if kind == "segment" else None
    rest = REST_SPEED if air is None else DISTURBED_REST
    flown = progress(scene, trajectory, list(result["order"]), segment, rest)
    return FleetProgress.alone(flown, np.reshape(load_shield(folder / SHIELD_FILE), (-1, 2)))


def _caption(result: dict[str, Any]) -> str | None:
    """Returns the headline of an unsuccessful run; None if it succeeded."""
    if result.get("success") or not result.get("violations"):
        return None
    # Those of a fleet are in order for each UAV only.
    first = min(result["violations"], key=lambda each: float(each.get("t") or 0.0))
    when = "" if first.get("t") is None else f" at {float(first['t']):.2f} s"
    whose = first.get("uavs", [first["uav"]] if "uav" in first else [])
    who = " and ".join(f"UAV {number}" for number in whose)
    return f"{who}{': ' if who else ''}{str(first['kind']).upper()}{when}"


def one_line(error: BaseException) -> str:
    """Returns what an error says, in one line that is not too long."""
    return " ".join(str(error).split())[:200]
