"""Makes the document that a replay's page shows: one scene, and the flights of one run or more.

Numbers that are many are float32 in base64, which halves their size; `decoded` reads them back.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.render.fleet import UAV_COLOURS, FleetProgress
from mjcollect.render.overlay import MOVING, NODES, SHIELD, UAV, speed_colours
from mjcollect.render.runs import FlownRun, violation_text
from mjcollect.scene.mjcf import NO_FLY_RGBA, OBSTACLE_RGBA
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

SPACING = 0.05  # Rows of a flight are at most so far apart in time (s), if its steps are shorter.
COLUMNS = 8  # A row holds time, position, velocity, and the length flown so far.
RAMP = 33  # The page's speed bar has so many colours.
SHOWN = ("bounds", "depot", "more_depots", "items", "obstacles")  # keys of the scene file


class ReplayError(ValueError):
    """Says that runs cannot be shown as asked; the message names run, value and fix."""


def document(runs: Sequence[FlownRun], names: Sequence[str]) -> dict[str, Any]:
    """Returns the JSON document of a replay.

    Args:
        runs: at least one; they fly in the scene of the first. names: by which they are called.

    Raises:
        ReplayError: the runs were flown in different scenes.
    """
    scene = runs[0].fleet.scene
    for run, name in zip(runs[1:], names[1:], strict=True):
        if difference := scene.difference(run.fleet.scene, SHOWN):
            raise ReplayError(
                f"{name}: was flown in another scene than {names[0]}: {difference}; only runs of "
                "one scene can be shown together"
            )
    return {
        "scene": scene_part(scene),
        "runs": [
            run_part(run, name, index, alone=len(runs) == 1)
            for index, (run, name) in enumerate(zip(runs, names, strict=True))
        ],
        "colours": {
            **{state: _hex(colour) for state, colour in NODES.items()},
            "moving": _hex(MOVING),
            "shield": _hex(SHIELD),
            "noFly": to_hex(NO_FLY_RGBA),
            "boxes": [to_hex(rgba) for rgba in OBSTACLE_RGBA],
            "speed": [to_hex(rgb) for rgb in speed_colours(np.linspace(0, 1, RAMP), 1.0)],
        },
    }


def scene_part(scene: Scene) -> dict[str, Any]:
    """Returns what the page draws of a scene, all in metres.

    `boxes` are rows of centre, size and yaw (degrees), in the order of the scene's obstacles.
    """
    low, high = scene.obstacles[:, 0], scene.obstacles[:, 1]
    return {
        "name": scene.name,
        "bounds": scene.bounds.tolist(),
        "depots": scene.depots.tolist(),
        "items": scene.items.tolist(),
        "boxes": encoded(np.column_stack([(low + high) / 2, high - low, scene.yaw])),
        "noFly": list(scene.no_fly),
        "epsilon": scene.epsilon,
        "returnTolerance": scene.return_tolerance,
        "radius": scene.uav_radius,
        "vMax": scene.v_max,
    }


def run_part(run: FlownRun, name: str, index: int, alone: bool) -> dict[str, Any]:
    """Returns what the page shows of a run, whose number is `index`; `alone` if there is no other.

    Times are in s from the start of the flight.
    """
    result, fleet = run.result, run.fleet
    own = UAV_COLOURS[index % len(UAV_COLOURS)]
    moving = () if run.air is None else run.air.moving
    return {
        "name": name,
        "kind": run.kind,
        "success": bool(result.get("success")),
        "caption": run.caption,
        "planner": result.get("planner"),
        "lowerBound": result.get("lower_bound"),
        "duration": fleet.duration,
        "colour": _hex(UAV) if alone and fleet.is_alone else own,
        "violations": [
            {"t": float(each["t"]), "text": violation_text(each)}
            for each in result.get("violations", [])
            if each.get("t") is not None
        ],
        "wind": None if run.air is None else run.air.wind.tolist(),
        "moving": [box.to_dict() for box in moving],
        "flights": [
            flight_part(
                fleet, m, fleet.colour(m) if alone and not fleet.is_alone else None
            )
            for m in range(len(fleet.flights))
        ],
    }  # fmt: skip


def flight_part(fleet: FleetProgress, m: int, colour: str | None) -> dict[str, Any]:
    """Returns what the page shows of flight `m` of a fleet, in a colour or in that of its run.

    `stops` are the targets in order, with the time of arrival, None where it never arrived.
    """
    flown = fleet.flights[m]
    times = [float(flown.trajectory.t[row] - flown.trajectory.t[0]) for row in flown.rows]
    late = [None] * (len(flown.targets) - len(times))
    return {
        "name": None if fleet.is_alone else fleet.name(m),
        "colour": colour,
        "rows": encoded(rows(flown.trajectory)),
        "before": list(flown.collected(0)),
        "stops": [
            {"node": _node(fleet, m, node), "t": t}
            for node, t in zip(flown.targets, [*times, *late], strict=True)
        ],
        "duration": flown.trajectory.duration,  # Rows have it as float32, arrivals do not.
        "length": flown.trajectory.length,
        "shield": fleet.shielded[m].tolist(),
    }


def rows(trajectory: Trajectory) -> NDArray[np.float64]:
    """Returns the rows (R, 8) of a flight that the page draws: t, x, y, z, vx, vy, vz, length.

    The first and the last of the trajectory are among them.
    """
    t = trajectory.t - trajectory.t[0]
    step = float(t[1]) if len(t) > 1 else SPACING
    stride = max(1, int(SPACING / step + 1e-6)) if step > 0 else 1
    chosen = np.unique(np.append(np.arange(0, len(t), stride), len(t) - 1))
    gone = np.linalg.norm(np.diff(trajectory.x, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(gone)])
    return np.column_stack([t, trajectory.x, trajectory.v, length])[chosen]


def encoded(numbers: Array) -> str:
    """Returns numbers as base64 of little-endian float32, row by row."""
    return base64.b64encode(np.asarray(numbers, dtype="<f4").tobytes()).decode("ascii")


def decoded(text: str, columns: int) -> NDArray[np.float32]:
    """Returns the rows (R, columns) that `encoded` was given, as float32."""
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(-1, columns)


def _node(fleet: FleetProgress, m: int, node: int) -> int:
    """Returns a target as a node of the whole scene."""
    flown: Progress = fleet.flights[m]
    return node if node in flown.order else fleet.home(m)


def _hex(colour: Sequence[int]) -> str:
    red, green, blue = colour[:3]
    return f"#{red:02x}{green:02x}{blue:02x}"
