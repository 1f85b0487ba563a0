"""Writes a mission as a plan that QGroundControl opens and MAVLink autopilots fly.

Its format is that of the "Plan File Format" page of QGroundControl's developer guide, version 1.
Altitudes are above the take-off point, the depot; commands are those of MAVLink's MAV_CMD.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mjcollect.export.mission import FlownMission
from mjcollect.export.waypoints import is_clear, thin
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene

TAKE_OFF, WAYPOINT, LAND, CHANGE_SPEED = 22, 16, 21, 178  # MAV_CMD
RELATIVE, NO_PLACE = 3, 2  # MAV_FRAME: altitude above home; a command without a place
PX4, QUADROTOR = 12, 2  # MAV_AUTOPILOT, MAV_TYPE
CROSS_TRACK = 0.5  # metres; the flown path is nowhere farther from the plan's legs
HOVER = 2.0  # seconds at every item
SPEED_STEP = 1.0  # m/s; a smaller change of speed is not sent
LEAST_SPEED = 1.0  # m/s; autopilots refuse to crawl
RISES = (2.5, 1.5, 1.0, 0.5)  # metres of the climb at take-off; the first that is free is taken


def plan(mission: FlownMission, cross_track: float = CROSS_TRACK, hover: float = HOVER) -> Any:
    """Returns the plan's JSON document.

    Between waypoints the speed is that of the fastest moment of the flight there, in whole m/s.

    Args:
        cross_track: greatest distance of the flown path to the legs (m). hover: stop at items (s).
    """
    scene, flown = mission.scene, mission.trajectory
    stops = mission.stops[:-1]
    rows = thin(flown.x, mission.stops, scene.boxes, scene.reach, cross_track)
    places = mission.frame.geographic(flown.x[rows])
    height = flown.x[rows, 2] - scene.depot[2]
    fastest = np.linalg.norm(flown.v, axis=1)
    home, items, speed = places[0], [], 0.0
    items.append(_item(1, TAKE_OFF, [0, 0, 0, None], home, _rise(scene, flown.x[rows[1]])))
    for k in range(1, len(rows)):
        wanted = max(round(float(fastest[rows[k - 1] : rows[k] + 1].max())), LEAST_SPEED)
        if abs(wanted - speed) >= SPEED_STEP:
            speed = wanted
            items.append(_command(len(items) + 1, CHANGE_SPEED, [1, speed, -1, 0, 0, 0, 0]))
        held = hover if rows[k] in stops else 0
        number = len(items) + 1
        items.append(_item(number, WAYPOINT, [held, 0, 0, None], places[k], float(height[k])))
    items.append(_item(len(items) + 1, LAND, [0, 0, 0, None], home, 0.0))
    fence = [[float(place[0]), float(place[1])] for place in mission.floor(scene.bounds)]
    return {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {
            "version": 2,
            "firmwareType": PX4,
            "vehicleType": QUADROTOR,
            "globalPlanAltitudeMode": 1,
            "cruiseSpeed": scene.v_max,
            "hoverSpeed": scene.v_max,
            "plannedHomePosition": home.tolist(),
            "items": items,
        },
        "geoFence": {
            "version": 2,
            "circles": [],
            "polygons": [{"version": 1, "inclusion": True, "polygon": fence}],
        },
        "rallyPoints": {"version": 2, "points": []},
    }


def plan_text(mission: FlownMission, cross_track: float = CROSS_TRACK, hover: float = HOVER) -> str:
    """Returns the text of the plan's file."""
    return json.dumps(plan(mission, cross_track, hover), indent=1) + "\n"


def _rise(scene: Scene, first: Array) -> float:
    """Returns how high (m) the plan takes off, from where the leg to `first` (3,) is free.

    Autopilots do not take off to the height that they stand at.
    """
    for rise in RISES:
        top = scene.depot + np.array([0.0, 0.0, rise])
        legs = ((scene.depot, top), (top, first))
        if all(is_clear(one, two, scene.boxes, scene.reach) for one, two in legs):
            return rise
    return RISES[-1]


def _command(number: int, command: int, params: list[float]) -> dict[str, Any]:
    """Returns a mission item without a place."""
    return {
        "type": "SimpleItem",
        "autoContinue": True,
        "command": command,
        "doJumpId": number,
        "frame": NO_PLACE,
        "params": params,
    }


def _item(
    number: int, command: int, params: list[float | None], place: Array, height: float
) -> dict[str, Any]:
    """Returns a mission item at a place (3,), `height` metres above home."""
    where = [float(place[0]), float(place[1]), height]
    return {
        "type": "SimpleItem",
        "AMSLAltAboveTerrain": None,
        "Altitude": height,
        "AltitudeMode": 1,
        "autoContinue": True,
        "command": command,
        "doJumpId": number,
        "frame": RELATIVE,
        "params": [*params, *where],
    }
