"""Makes run folders by hand, for tests of replays."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from straight_flights import fly

from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import save_shield

ITEMS = [[180.0, 20.0, 40.0], [150.0, 160.0, 60.0]]
BOXES = [[[80.0, 60.0, 0.0], [120.0, 120.0, 90.0]], [[20.0, 120.0, 0.0], [60.0, 180.0, 50.0]]]


def scene_with(**fields) -> Scene:
    fields = {"items": ITEMS, "obstacles": BOXES, "yaw": [0.0, 30.0], "no_fly": [1]} | fields
    return Scene("yard </script>", 0, [[0, 0, 0], [200, 200, 120]], [10, 10, 5], **fields)


def write_mission(folder: Path, order=(0, 1), scene: Scene | None = None, **more) -> Path:
    """A run folder of a straight flight; `more` goes into mission.json, or segment.json."""
    scene = scene or scene_with()
    points = [scene.depot, *scene.items[list(order)], scene.depot]
    index = more.get("segment")
    flown = fly(points if index is None else points[index : index + 2])
    folder.mkdir(parents=True)
    scene.save(folder / "scene.json")
    flown.save(folder / "trajectory.csv")
    save_shield(folder / "shield.csv", np.array([[1.0, 1.4]]))
    document = {"order": list(order), "success": True, "lower_bound": 9.0, "planner": "law"} | more
    name = "mission" if index is None else "segment"
    (folder / f"{name}.json").write_text(json.dumps(document))
    return folder
