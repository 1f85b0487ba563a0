"""The scene: an immutable description of one collection problem, read from and written to JSON.

Paper section II: a cube with box obstacles (6)-(8), a depot (4), items (5) and the limits (2)-(3).
Every impossible or suspicious scene is refused with a `SceneError` that names field, value and fix.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from mjcollect.geometry import Array, point_box_distance

MAX_EXTENT = 1e5  # metres; beyond this, 1e-6 m is no longer resolved along a mission
POSITIVE_LIMITS = (
    "v_max",
    "a_max",
    "epsilon",
    "slot",
    "return_tolerance",
    "uav_radius",
    "physics_step",
)

Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class SceneError(ValueError):
    """A scene was refused. The message names the field, the value and the fix."""

    def __init__(self, field: str, value: object, fix: str) -> None:
        """Keep the three parts as attributes and join them into one message."""
        self.field, self.value, self.fix = field, value, fix
        super().__init__(f"{field}: {_short(value)}: {fix}")


class _Box(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    min: Point
    max: Point


class _SceneFile(BaseModel):
    """The JSON document, key for key; every further rule is in `Scene._check`."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: Annotated[str, Field(min_length=1, max_length=100)]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    bounds: _Box
    depot: Point
    items: list[Point]
    obstacles: list[_Box]
    v_max: FiniteFloat
    a_max: FiniteFloat
    epsilon: FiniteFloat
    slot: FiniteFloat
    return_tolerance: FiniteFloat
    uav_radius: FiniteFloat = 0.5
    physics_step: FiniteFloat = 0.02


@dataclass(frozen=True, eq=False)
class Scene:
    """One collection problem. Lengths in metres, times in seconds; arrays are read-only.

    Attributes:
        name: label, used for run folders.
        seed: seed that made the scene (0 if made by hand).
        bounds: (2, 3), minimum and maximum corner; inclusive for the body's centre.
        depot: (3,), start and end of the mission.
        items: (K, 3), K >= 1.
        obstacles: (M, 2, 3), boxes as minimum and maximum corner.
        v_max, a_max: norm limits of speed (m/s) and acceleration (m/s^2), eq. (2)-(3).
        epsilon: collection radius, eq. (5).
        slot: length of a slot, the paper's delta.
        return_tolerance: how near to the depot the mission must end.
        uav_radius: radius of the body; no point of it may touch a box.
        physics_step: MuJoCo time step; divides the slot.
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

    def __post_init__(self) -> None:
        """Freeze the arrays and refuse what cannot be flown.

        Raises:
            SceneError: naming field, value and fix.
        """
        shapes = {"bounds": (2, 3), "depot": (3,), "items": (-1, 3), "obstacles": (-1, 2, 3)}
        for field, shape in shapes.items():
            try:
                array = np.array(getattr(self, field), dtype=np.float64).reshape(shape)
            except (TypeError, ValueError):
                raise SceneError(
                    field, getattr(self, field), f"needs numbers of shape {shape}"
                ) from None
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        self._check()

    # Derived

    @property
    def substeps(self) -> int:
        """Physics steps in a slot (n)."""
        return round(self.slot / self.physics_step)

    def point(self, node: int) -> Array:
        """Position (3,) of item `node`, or of the depot for -1."""
        return self.depot if node < 0 else self.items[node]

    def tolerance(self, node: int) -> float:
        """How near to item `node` (or the depot, -1) the UAV must come to rest, in metres."""
        return self.return_tolerance if node < 0 else self.epsilon

    # Input and output

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Read a scene file.

        Raises:
            SceneError: the file is unreadable, is not a scene, or the scene is refused.
        """
        path = Path(path)
        if path.is_dir():
            raise SceneError("scene file", str(path), "is a folder; name the JSON file in it")
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise SceneError(
                "scene file",
                str(path),
                "does not exist; check the path, or make one with python -m mjcollect.generate",
            ) from None
        except UnicodeDecodeError:
            raise SceneError(
                "scene file", str(path), "is not UTF-8 text; save it as such"
            ) from None
        except OSError as error:
            raise SceneError(
                "scene file", str(path), f"cannot be read: {error.strerror}; check it"
            ) from None
        return cls.from_json(text)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Scene from JSON text; see `load`."""
        try:
            document = json.loads(
                text, object_pairs_hook=_no_twice, parse_constant=_no_constant, parse_float=_finite
            )
        except json.JSONDecodeError as error:
            raise SceneError(
                "scene file",
                text[max(0, error.pos - 20) : error.pos + 20],
                f"is not valid JSON at line {error.lineno} column {error.colno} ({error.msg}); "
                "complete or correct it",
            ) from None
        except RecursionError:
            raise SceneError("scene file", text[:20], "is nested too deeply; flatten it") from None
        if not isinstance(document, dict):
            raise SceneError(
                "scene file", document, "must hold one JSON object with the keys of a scene"
            )
        try:
            parsed = _SceneFile.model_validate_json(json.dumps(document))
        except ValidationError as error:
            raise _from_pydantic(error) from None
        flat = parsed.model_dump()
        flat["bounds"] = [parsed.bounds.min, parsed.bounds.max]
        flat["obstacles"] = [[box.min, box.max] for box in parsed.obstacles]
        return cls(**flat)

    def to_dict(self) -> dict[str, Any]:
        """The JSON document of the scene, all keys written out."""
        document: dict[str, Any] = {
            "name": self.name,
            "seed": self.seed,
            "bounds": _box_dict(self.bounds),
            "depot": self.depot.tolist(),
            "items": self.items.tolist(),
            "obstacles": [_box_dict(box) for box in self.obstacles],
        }
        return document | {limit: getattr(self, limit) for limit in POSITIVE_LIMITS}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene file; `load` gives back an equal scene."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=1) + "\n", encoding="utf-8")

    def __eq__(self, other: object) -> bool:
        """Equal when every field is."""
        return isinstance(other, Scene) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        """Hash that agrees with equality."""
        return hash(json.dumps(self.to_dict()))

    # Rules

    def _check(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip() or not self.name.isprintable():
            raise SceneError("name", self.name, "must be printable text that is not blank")
        for limit in POSITIVE_LIMITS:
            value = getattr(self, limit)
            if not np.isfinite(value) or value <= 0:
                raise SceneError(limit, value, "must be a positive number")
        ratio = self.slot / self.physics_step
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
            raise SceneError(
                "physics_step", self.physics_step, f"must divide the slot of {self.slot} s evenly"
            )
        if round(ratio) > 1000:
            raise SceneError(
                "physics_step",
                self.physics_step,
                f"must be at least slot / 1000 = {self.slot / 1000} s",
            )
        for field in ("bounds", "depot", "items", "obstacles"):
            array = getattr(self, field)
            if not np.all(np.isfinite(array)):
                raise SceneError(field, array.tolist(), "must be finite numbers")
        self._check_bounds()
        self._check_obstacles()
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
        if not _inside(self.depot, self.bounds):
            raise SceneError(
                "depot", self.depot.tolist(), "lies outside the bounds; move it inside"
            )
        for name in ("epsilon", "return_tolerance"):
            value = getattr(self, name)
            if value >= np.linalg.norm(high - low):
                raise SceneError(name, value, "must be smaller than the bounds' diagonal")

    def _check_obstacles(self) -> None:
        for index, box in enumerate(self.obstacles):
            field = f"obstacles[{index}]"
            if np.any(box[0] >= box[1]):
                raise SceneError(
                    field, _box_dict(box), "min must be below max on every axis; swap or widen them"
                )
            if not (_inside(box[0], self.bounds) and _inside(box[1], self.bounds)):
                raise SceneError(
                    field, _box_dict(box), "reaches outside the bounds; clip it or widen the bounds"
                )
        distance = point_box_distance(self.depot, self.obstacles)
        for index in np.flatnonzero(distance < self.uav_radius):
            raise SceneError(
                "depot",
                self.depot.tolist(),
                f"is {distance[index]:.3g} m from obstacles[{index}], closer than the body's radius "
                f"uav_radius = {self.uav_radius} m; move the depot or the obstacle",
            )

    def _check_points(self) -> None:
        if len(self.items) == 0:
            raise SceneError("items", [], "needs at least one item [x, y, z]")
        for index, item in enumerate(self.items):
            field = f"items[{index}]"
            if not _inside(item, self.bounds):
                raise SceneError(field, item.tolist(), "lies outside the bounds; move it inside")
            distance = point_box_distance(item, self.obstacles)
            for hit in np.flatnonzero(distance <= 0.0):
                raise SceneError(
                    field, item.tolist(), f"lies inside or on obstacles[{hit}]; move one of them"
                )
            for hit in np.flatnonzero(distance + self.epsilon < self.uav_radius):
                raise SceneError(
                    field,
                    item.tolist(),
                    f"is {distance[hit]:.3g} m from obstacles[{hit}]: a body of radius "
                    f"{self.uav_radius} m cannot come within epsilon = {self.epsilon} m of it",
                )
        return

        for node in walled_in(self):
            field = "depot" if node < 0 else f"items[{node}]"
            raise SceneError(
                field,
                self.point(node).tolist(),
                "is walled in: obstacles close it off from "
                + ("every item" if node < 0 else "the depot")
                + "; open a passage wider than the body or move it",
            )


def _inside(point: Array, bounds: Array) -> bool:
    return bool(np.all(point >= bounds[0]) and np.all(point <= bounds[1]))


def _box_dict(box: Array) -> dict[str, Any]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    text = " ".join(text.split())
    return text if len(text) <= 90 else text[:87] + "..."


def _no_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise SceneError(twice, document[twice], "the key appears twice in one object; keep one")
    return document


def _no_constant(text: str) -> NoReturn:
    raise SceneError("number", text, "is not a JSON number; write a finite one")


def _finite(text: str) -> float:
    value = float(text)
    if not np.isfinite(value):
        raise SceneError("number", text, "is too large; write a finite number")
    return value


_FIXES = {
    "missing": "is missing; add it (docs/scene-format.md lists every key)",
    "extra_forbidden": "is not a known key; remove or rename it",
    "too_long": "has too many entries; a point is [x, y, z]",
    "too_short": "has too few entries; a point is [x, y, z]",
}


def _from_pydantic(error: ValidationError) -> SceneError:
    """The first problem as field, value and fix."""
    problem = error.errors(include_url=False)[0]
    field = ""
    for part in problem["loc"]:
        field += f"[{part}]" if isinstance(part, int) else f"{'.' if field else ''}{part}"
    kind = problem["type"]
    value = "(absent)" if kind == "missing" else problem["input"]
    if kind == "missing" and isinstance(problem["input"], list):
        return SceneError(field, problem["input"], "a point needs three numbers [x, y, z]")
    return SceneError(field, value, _FIXES.get(kind, problem["msg"].replace("Input ", "")))


if __name__ == "__main__":
    from mjcollect.inspect_scene import main

    raise SystemExit(main())
