"""Defines the scene, an immutable description of one collection problem, kept as JSON.

Paper section II: a cube with box obstacles (6)-(8), a depot (4), items (5) and the limits (2)-(3).
Every impossible or suspicious scene is refused with a `SceneError` that names field, value and fix.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.enclosure import Space
from mjcollect.geometry.tree import Tree
from mjcollect.geometry.turns import around, turned
from mjcollect.scene.assets import asset_path
from mjcollect.scene.depots import check_inside, check_moving_box, check_open, check_room
from mjcollect.scene.fields import LIMIT_RANGE, array_of, limit_of, moving_box_of
from mjcollect.scene.file_format import SceneError, parse, read_text
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.place import Origin

MAX_EXTENT = 1e5  # metres; in wider bounds 1e-6 m is no longer resolved along a mission
MAX_SUBSTEPS = 1000  # A slot has at most so many physics steps.
RACER_STOP = 62.5  # metres in which the suite's own drone stops from 50 m/s with 20 m/s^2
POSITIVE_LIMITS = (
    "v_max",
    "a_max",
    "epsilon",
    "slot",
    "return_tolerance",
    "uav_radius",
    "physics_step",
)
_SHAPES = {"bounds": (2, 3), "depot": (3,), "items": (-1, 3), "obstacles": (-1, 2, 3), "yaw": (-1,)}
_SHAPES |= {"more_depots": (-1, 3)}


@dataclass(frozen=True, eq=False)
class Scene:
    """Describes one collection problem, in metres and seconds; its arrays are read-only.

    Attributes:
        name: label of the scene; run folders are named by its `slug`.
        seed: seed that the scene was drawn with (0 if made by hand).
        bounds: (2, 3), minimum and maximum corner; the body's centre may lie on them.
        depot: (3,), start and end of the mission.
        more_depots: (D - 1, 3), where UAVs of a fleet start and end as well, see `depots`.
        items: (K, 3), K >= 1.
        obstacles: (M, 2, 3), boxes as minimum and maximum corner before they are turned.
        clearance: distance to keep between the body and boxes, at least.
        yaw: (M,), degrees by which each box is turned about its centre, counterclockwise as seen
            from above; none for all zero.
        no_fly: indices of the boxes that are no bodies but places where none may fly; they count as
            bodies and are only drawn otherwise.
        separation: metres that the centres of two UAVs keep apart, at least twice the radius; 0 for
            four times the radius, see `apart`.
        v_max, a_max: norm limits of speed (m/s) and acceleration (m/s^2), eq. (2)-(3).
        epsilon: collection radius, eq. (5).
        slot: time for which one command is held, the paper's delta.
        return_tolerance: distance from the depot within which the mission must end.
        uav_radius: radius of the body; no point of it may touch a box.
        physics_step: MuJoCo's time step; it divides the slot.
        moving: boxes that move along paths; documents like those of the file become `MovingBox`.
        origin: place on Earth of the point [0, 0, 0], if any; a document becomes an `Origin`.
    """

    name: str
    seed: int
    bounds: Array
    depot: Array
    items: Array
    obstacles: Array
    v_max: float = 50.0
    a_max: float = 20.0
    epsilon: float = 5.0
    slot: float = 0.2
    return_tolerance: float = 5.0
    uav_radius: float = 0.5
    physics_step: float = 0.02
    moving: tuple[MovingBox, ...] = ()
    origin: Origin | None = None
    clearance: float = 0.0
    yaw: Array = field(default_factory=lambda: np.zeros(0))
    no_fly: tuple[int, ...] = ()
    separation: float = 0.0
    more_depots: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        """Freezes the arrays and refuses what cannot be flown.

        Raises:
            SceneError: a rule is broken; it names field, value and fix.
        """
        if np.array_equal(self.yaw, np.zeros(np.shape(self.yaw))):
            object.__setattr__(self, "yaw", np.zeros(len(self.obstacles)))
        for name, shape in _SHAPES.items():
            array = array_of(name, getattr(self, name), shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for limit in POSITIVE_LIMITS:
            object.__setattr__(self, limit, limit_of(limit, getattr(self, limit)))
        object.__setattr__(self, "moving", tuple(map(moving_box_of, self.moving)))
        object.__setattr__(self, "no_fly", tuple(sorted(set(self.no_fly))))
        object.__setattr__(self, "origin", Origin.of(self.origin))
        self._check()

    # Derived values

    @property
    def substeps(self) -> int:
        """Returns the number n of physics steps in a slot."""
        return round(self.slot / self.physics_step)

    @property
    def slug(self) -> str:
        """Returns the name as a file name: all but letters, digits and . _ - becomes _."""
        return re.sub(r"[^A-Za-z0-9._-]|^[.-]", "_", self.name)

    @property
    def reach(self) -> float:
        """Returns how near (m) the body's centre may come to a box: radius and clearance."""
        return self.uav_radius + self.clearance

    @property
    def apart(self) -> float:
        """Returns how near (m) the centres of two UAVs may come: `separation` or its default."""
        return self.separation or 4 * self.uav_radius

    @cached_property
    def unit(self) -> float:
        """Returns the metres that distances of guidance and observations are in, 1 for the racer.

        They go with the stopping distance from v_max, so that a small drone in a room keeps such
        distances, and sees such numbers, as the racer does in a city.
        """
        return self.v_max**2 / (2 * self.a_max) / RACER_STOP

    @cached_property
    def boxes(self) -> Array:
        """Returns the obstacles as they stand: (M, 2, 3), or (M, 3, 3) if any of them is turned.

        See `geometry.turns`; it is what distances are computed from.
        """
        return turned(self.obstacles, self.yaw)

    @cached_property
    def tree(self) -> Tree:
        """Returns `boxes` in a tree, for questions about those that are near."""
        return Tree.of(self.boxes)

    @property
    def depots(self) -> Array:
        """Returns all depots (D, 3), the first one first; UAV m of a fleet has number m mod D."""
        return np.concatenate([self.depot[None], self.more_depots])

    @property
    def nodes(self) -> range:
        """Returns all nodes, of which those below 0 are depots: -1 is the depot, then -2..."""
        return range(-len(self.depots), len(self.items))

    def point(self, node: int) -> Array:
        """Returns the position (3,) of item `node`, of the depot for -1, or of others for -2..."""
        return self.items[node] if node >= 0 else self.depots[-1 - node]

    def tolerance(self, node: int) -> float:
        """Returns within how many metres of item `node` (or a depot, < 0) the UAV must rest."""
        return self.return_tolerance if node < 0 else self.epsilon

    # Input and output

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Reads a scene file; `find` also takes the name of a bundled scene.

        Raises:
            SceneError: the file is unreadable, is not a scene, or the scene is refused.
        """
        return cls(**parse(read_text(path), str(path)))

    @classmethod
    def find(cls, name: str | os.PathLike[str]) -> Scene:
        """Reads a file, or a bundled scene by a name such as `scenario_1`; see `load`."""
        bundled = asset_path("scenes", f"{name}.json")
        # Of a name that no file can have, `os.path` says that it is not there; `load` says why.
        known = not os.path.exists(name) and os.path.isfile(bundled)
        return cls.load(bundled if known else name)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Reads a scene from JSON text; raises what `load` raises."""
        return cls(**parse(text))

    def to_dict(self) -> dict[str, Any]:
        """Returns the JSON document of the scene, without keys that are not used."""
        document: dict[str, Any] = {
            "name": self.name,
            "seed": self.seed,
            "bounds": _box_dict(self.bounds),
            "depot": self.depot.tolist(),
            "items": self.items.tolist(),
            "obstacles": [
                _box_dict(box)
                | ({"yaw": yaw} if yaw != 0.0 else {})
                | ({"no_fly": True} if index in self.no_fly else {})
                for index, (box, yaw) in enumerate(
                    zip(self.obstacles, self.yaw.tolist(), strict=True)
                )
            ],
        }
        document |= {limit: getattr(self, limit) for limit in POSITIVE_LIMITS}
        more = self.more_depots.tolist()
        document |= {"more_depots": more} if more else {}
        moving = [box.to_dict() for box in self.moving]
        document |= {"moving": moving} if moving else {}
        for name in ("clearance", "separation"):
            document |= {name: getattr(self, name)} if getattr(self, name) else {}
        return document | ({} if self.origin is None else {"origin": self.origin.to_dict()})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the scene file, from which `load` reads an equal scene."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=1) + "\n", encoding="utf-8")

    def __eq__(self, other: object) -> bool:
        """Returns whether every field is equal."""
        return isinstance(other, Scene) and self.to_dict() == other.to_dict()

    def difference(self, other: Scene, keys: Collection[str] | None = None) -> str | None:
        """Returns the first key of the scene file in which another scene differs, or None.

        Both values are named, as in "items[3] is [1, 2, 3], not [1, 2, 4]". If `keys` are given,
        only they are compared.
        """
        first, second = self.to_dict(), other.to_dict()
        for key in first | second:
            own, its = first.get(key), second.get(key)
            if own == its or (keys is not None and key not in keys):
                continue
            if not isinstance(own, list) or not isinstance(its, list):
                told = ["left out" if value is None else value for value in (its, own)]
                return f"{key} is {told[0]}, not {told[1]}"
            if len(own) != len(its):
                return f"{key} has {len(its)} entries, not {len(own)}"
            index = next(i for i in range(len(own)) if own[i] != its[i])
            return f"{key}[{index}] is {its[index]}, not {own[index]}"
        return None

    def __hash__(self) -> int:
        """Returns a hash that agrees with equality."""
        return hash(json.dumps(self.to_dict()))

    # Rules

    def _check(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip() or not self.name.isprintable():
            raise SceneError("name", self.name, "must be printable text that is not blank")
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**63:
            raise SceneError("seed", self.seed, "must be an integer, at least 0 and below 2^63")
        ratio = self.slot / self.physics_step
        if ratio > MAX_SUBSTEPS + 0.5:
            raise SceneError(
                "physics_step",
                self.physics_step,
                f"must be at least slot / {MAX_SUBSTEPS} = {self.slot / MAX_SUBSTEPS:g} s",
            )
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
            raise SceneError(
                "physics_step", self.physics_step, f"must divide the slot of {self.slot} s evenly"
            )
        if not 0.0 <= self.clearance <= LIMIT_RANGE[1]:
            raise SceneError("clearance", self.clearance, "must be a number from 0 on")
        if self.separation and not 2 * self.uav_radius <= self.separation <= LIMIT_RANGE[1]:
            fix = f"must lie from 2 * uav_radius = {2 * self.uav_radius:g} to {LIMIT_RANGE[1]:g} m"
            raise SceneError("separation", self.separation, fix)
        self._check_bounds()
        self._check_obstacles()
        self._check_moving()
        self._check_points()

    def _check_bounds(self) -> None:
        low, high = self.bounds
        if np.any(low >= high):
            raise SceneError(
                "bounds", _box_dict(self.bounds), "min must be below max on every axis"
            )
        if np.any(high - low > MAX_EXTENT) or np.any(np.abs(self.bounds) > MAX_EXTENT):
            raise SceneError(
                "bounds", _box_dict(self.bounds), f"must lie within {MAX_EXTENT:g} m; use metres"
            )
        if np.any(high - low < 2 * self.uav_radius):
            raise SceneError(
                "bounds",
                _box_dict(self.bounds),
                f"must be at least 2 * uav_radius = {2 * self.uav_radius} m wide on every axis",
            )
        check_inside(self.depots, self.bounds)
        for name in ("epsilon", "return_tolerance"):
            value = getattr(self, name)
            if value >= np.linalg.norm(high - low):
                raise SceneError(name, value, "must be smaller than the bounds' diagonal")

    def _check_obstacles(self) -> None:
        if len(self.yaw) != len(self.obstacles):
            fix = f"needs a number for each of {len(self.obstacles)} obstacles"
            raise SceneError("yaw", self.yaw.tolist(), fix)
        if not set(self.no_fly) <= set(range(len(self.obstacles))):
            fix = f"must be indices of {len(self.obstacles)} obstacles, from 0"
            raise SceneError("no_fly", list(self.no_fly), fix)
        for index, box in enumerate(self.obstacles):
            field = f"obstacles[{index}]"
            if np.any(box[0] >= box[1]):
                raise SceneError(
                    field, _box_dict(box), "min must be below max on every axis; swap or widen them"
                )
            if not -360.0 <= self.yaw[index] <= 360.0:
                fix = "must lie between -360 and 360 degrees"
                raise SceneError(f"{field}.yaw", float(self.yaw[index]), fix)
        for index, hull in enumerate(around(self.boxes)):
            slack = MAX_EXTENT * 1e-14 if self.yaw[index] else 0.0  # Turning rounds.
            if np.any(hull[0] < self.bounds[0] - slack) or np.any(hull[1] > self.bounds[1] + slack):
                raise SceneError(
                    f"obstacles[{index}]", _box_dict(self.obstacles[index]),
                    "reaches outside the bounds; clip it or widen the bounds",
                )  # fmt: skip
        check_room(self.depots, self.boxes, self.reach, self._reach_text())

    def _reach_text(self) -> str:
        more = f" and clearance {self.clearance}" if self.clearance else ""
        return f"{self.uav_radius}{more}"

    def _check_moving(self) -> None:
        for index, box in enumerate(self.moving):
            field, path = f"moving[{index}]", np.array(box.path).reshape(-1, 3)
            for value in box.size:
                if not LIMIT_RANGE[0] <= value <= MAX_EXTENT:
                    fix = f"must be positive numbers up to {MAX_EXTENT:g} m"
                    raise SceneError(f"{field}.size", list(box.size), fix)
            if not LIMIT_RANGE[0] <= box.speed <= LIMIT_RANGE[1]:
                fix = f"must be a positive number from {LIMIT_RANGE[0]:g} to {LIMIT_RANGE[1]:g}"
                raise SceneError(f"{field}.speed", box.speed, fix)
            if len(path) < 2:
                raise SceneError(f"{field}.path", path.tolist(), "needs at least two points")
            for k, point in enumerate(path):
                if not np.all(np.isfinite(point)) or not _inside(point, self.bounds):
                    fix = "lies outside the bounds; move it inside"
                    raise SceneError(f"{field}.path[{k}]", point.tolist(), fix)
                if k > 0 and np.linalg.norm(point - path[k - 1]) < LIMIT_RANGE[0]:
                    fix = "is the point before it; leave one of them out"
                    raise SceneError(f"{field}.path[{k}]", point.tolist(), fix)
            check_moving_box(self.depots, box, self.reach, field)

    def _check_points(self) -> None:
        if len(self.items) == 0:
            raise SceneError("items", [], "needs at least one item [x, y, z]")
        for index, item in enumerate(self.items):
            field = f"items[{index}]"
            if not _inside(item, self.bounds):
                raise SceneError(field, item.tolist(), "lies outside the bounds; move it inside")
            distance = point_box_distance(item, self.boxes)
            for hit in np.flatnonzero(distance <= 0.0):
                raise SceneError(
                    field, item.tolist(), f"lies inside or on obstacles[{hit}]; move one of them"
                )
            for hit in np.flatnonzero(distance + self.epsilon < self.reach):
                raise SceneError(
                    field,
                    item.tolist(),
                    f"is {distance[hit]:.3g} m from obstacles[{hit}]: a body of radius "
                    f"{self._reach_text()} m cannot come within epsilon = {self.epsilon} m of it",
                )
        space = Space(self.bounds, self.tree, self.reach, self.depot, self.items, self.epsilon)
        more = f" and its clearance of {self.clearance} m" if self.clearance else ""
        check_open(space, self.more_depots, more)


def _inside(point: Array, bounds: Array) -> bool:
    return bool(np.all(point >= bounds[0]) and np.all(point <= bounds[1]))


def _box_dict(box: Array) -> dict[str, Any]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}
