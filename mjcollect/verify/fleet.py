"""Judges the flights of a fleet: each as a mission of its part, and how far apart all keep.

Like `flight` it shares no code with what flies.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import find_objects, label

from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify.flight import TOLERANCE, Array, Violation, verify_run


@dataclass(frozen=True)
class Encounter:
    """Describes two UAVs of a fleet that came too near to each other.

    Attributes:
        t: time at which it begins (s).
        uavs: their numbers.
        value: least distance of their centres
            in this stretch of time (m). limit: what they must keep apart (m).
    """

    t: float
    uavs: tuple[int, int]
    value: float
    limit: float

    def to_dict(self) -> dict[str, object]:
        """Returns the encounter as a JSON document, of the kind `separation`."""
        return {"kind": "separation", **asdict(self), "uavs": list(self.uavs)}


def least_gaps(one: Trajectory, other: Trajectory) -> Array:
    """Returns the least distance (R,) in m of two flights between rows k and k + 1.

    A flight that is over rests at its last row. Between rows both move in straight lines.

    Raises:
        ValueError: their rows are not at the same times.
    """
    rows = max(len(one), len(other))
    short = min(len(one), len(other))
    if not np.array_equal(one.t[:short], other.t[:short]):
        raise ValueError("trajectories: rows of a fleet's flights must be at the same times")
    first, second = (
        np.concatenate([flown.x, np.repeat(flown.x[-1:], rows - len(flown), axis=0)])
        for flown in (one, other)
    )
    offset = second - first
    step = np.concatenate([np.diff(offset, axis=0), np.zeros((1, 3))])
    square = np.sum(step**2, axis=1)
    share = np.clip(-np.sum(offset * step, axis=1) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset + share[:, None] * step, axis=1))


def verify_separation(scene: Scene, flights: Sequence[Trajectory]) -> list[Encounter]:
    """Returns where UAVs of a fleet come nearer than `scene.apart`, in continuous time.

    Raises:
        ValueError: the flights' rows are not at the same times.
    """
    found = []
    for j, other in enumerate(flights):
        for i, one in enumerate(flights[:j]):
            gap = least_gaps(one, other)
            time = one.t if len(one) > len(other) else other.t
            for (rows,) in find_objects(label(gap < scene.apart - TOLERANCE)[0]):
                least = float(gap[rows].min())
                found.append(Encounter(float(time[rows.start]), (i, j), least, scene.apart))
    return sorted(found, key=lambda encounter: encounter.t)


def verify_fleet(folder: str | os.PathLike[str]) -> list[Violation | Encounter]:
    """Returns everything that a fleet's flight in a run folder breaks.

    Each UAV's flight is judged as a mission of its own part of the scene, and all by pairs.

    Raises:
        OSError, SceneError, ValueError, KeyError: the folder holds no finished run, or its parts
            are not the scene's: boxes or limits differ, an item is in none or two, or a place lies
            within the tolerance of no depot, or of another one than the result says.
    """
    folder = Path(folder)
    scene = Scene.load(folder / "scene.json")
    result = json.loads((folder / "fleet.json").read_text(encoding="utf-8"))
    found: list[Violation | Encounter] = []
    flights, items = [], []
    for mission in result["missions"]:
        own = folder / mission["folder"]
        part = Scene.load(own / "scene.json")
        if not set(mission["items"]) <= set(range(len(scene.items))):
            raise ValueError(f"items: {mission['items']}: must be 0 to {len(scene.items) - 1}")
        if not _is_part(scene, part, mission["items"], mission.get("depot")):
            raise ValueError(f"{own / 'scene.json'}: is no part of {folder / 'scene.json'}")
        items += mission["items"]
        flights.append(Trajectory.load(own / "trajectory.csv"))
        found += verify_run(own)
    if sorted(items) != list(range(len(scene.items))):
        raise ValueError(f"items: {sorted(items)}: each of {len(scene.items)} must be in one part")
    return [*found, *verify_separation(scene, flights)]


def _is_part(scene: Scene, part: Scene, items: Sequence[int], depot: int | None) -> bool:
    """Returns whether a scene is that of one UAV of a fleet, which collects `items` in order.

    Its place is at the scene's depot of number `depot`, or at any of them if that is None.
    """
    whole, own = scene.to_dict(), part.to_dict()
    for key in ("name", "items", "depot", "return_tolerance"):
        del whole[key], own[key]
    whole.pop("more_depots", None)  # A part has its own place only.
    if depot is not None and depot not in range(len(scene.depots)):
        return False
    depots = scene.depots if depot is None else scene.depots[[depot]]
    away = float(np.linalg.norm(depots - part.depot, axis=1).min())
    at_depot = away + part.return_tolerance <= scene.return_tolerance + TOLERANCE
    return whole == own and at_depot and np.array_equal(part.items, scene.items[list(items)])
