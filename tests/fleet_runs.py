"""Makes run folders of fleets by hand, for tests of their pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from straight_flights import fly

from mjcollect.fleet.share import parts
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory, save_shield

TOURS = ((1,), (3, 2, 0), (4,))
ITEMS = [[120, 150, 60], [180, 30, 90], [40, 170, 120], [20, 90, 40], [150, 100, 30]]
BOXES = [[[60, 60, 0], [80, 80, 50]], [[100, 20, 0], [120, 60, 70]]]
BOUND, SHIELDED = 9.5, np.array([[1.0, 1.4]])


def scene_of(items: list = ITEMS, more_depots: list | tuple = ()) -> Scene:
    bounds = [[0, 0, 0], [200, 200, 200]]
    return Scene("fleet", 0, bounds, [10, 10, 5], items, BOXES, more_depots=more_depots)  # type: ignore[arg-type]


def write_run(
    folder: Path, tours=TOURS, uavs: int = 4, ended: dict | None = None, more_depots=()
) -> Path:
    """A run folder; `ended` cuts the flights of UAVs to so many rows."""
    scene, missions = scene_of(more_depots=more_depots), []
    for uav, (part, tour) in enumerate(zip(parts(scene, tours), tours, strict=True)):
        own = folder / "uavs" / str(uav)
        own.mkdir(parents=True)
        flown = fly([part.depot, *part.items, part.depot])
        whole = (ended or {}).get(uav) is None
        if not whole:
            rows = (ended or {})[uav]
            flown = Trajectory(*(c[:rows] for c in (flown.t, flown.x, flown.v, flown.a)))
        part.save(own / "scene.json")
        flown.save(own / "trajectory.csv")
        save_shield(own / "shield.csv", SHIELDED if uav == 0 else np.empty((0, 2)))
        time = flown.duration if whole else None
        entry = {"uav": uav, "folder": f"uavs/{uav}", "items": list(tour), "success": whole}
        missions.append({**entry, "mission_time": time})
    scene.save(folder / "scene.json")
    times = [entry["mission_time"] for entry in missions]
    failed = {"kind": "contact", "t": 2.0, "uav": 1}
    document = {
        "scene": scene.name, "uavs": uavs, "success": None not in times, "lower_bound": BOUND,
        "makespan": None if None in times else max(times), "bound_method": "exact", "ratio": None,
        "separation": 2.0, "separation_limit": scene.apart, "planner": "law",
        "violations": [failed] if None in times else [], "missions": missions,
    }  # fmt: skip
    (folder / "fleet.json").write_text(json.dumps(document))
    return folder
