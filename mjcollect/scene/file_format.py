"""Reads a scene file's text and checks its keys and types; all other rules are in `scene.scene`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from mjcollect.scene.assets import asset_path

_MAX_DIGITS = 300  # Longer integers are read as floats, see `_integer`.
Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class SceneError(ValueError):
    """Says that a scene was refused; the message names the field, the value and the fix."""

    def __init__(self, field: str, value: object, fix: str) -> None:
        """Keeps the three parts as attributes and joins them into one message."""
        self.field, self.value, self.fix = field, value, fix
        super().__init__(printable(f"{field}: {_short(value)}: {fix}"))


class _Box(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    min: Point
    max: Point


class _Obstacle(_Box):
    yaw: FiniteFloat = 0.0
    no_fly: bool = False


class _MovingBox(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    size: Point
    path: list[Point]
    speed: FiniteFloat


class _Origin(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    latitude: FiniteFloat
    longitude: FiniteFloat
    altitude: FiniteFloat = 0.0
    crs: Annotated[str, Field(max_length=1000)] = ""


class _SceneFile(BaseModel):
    """Lists the JSON document key for key; every further rule is in `Scene._check`."""

    model_config = ConfigDict(extra="forbid", strict=True)
    name: Annotated[str, Field(min_length=1, max_length=100)]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    bounds: _Box
    depot: Point
    items: list[Point]
    obstacles: list[_Obstacle]
    v_max: FiniteFloat
    a_max: FiniteFloat
    epsilon: FiniteFloat
    slot: FiniteFloat
    return_tolerance: FiniteFloat
    uav_radius: FiniteFloat = 0.5
    physics_step: FiniteFloat = 0.02
    clearance: FiniteFloat = 0.0
    separation: FiniteFloat = 0.0
    more_depots: list[Point] = []
    moving: list[_MovingBox] = []
    origin: _Origin | None = None


def _bundled() -> str:
    return ", ".join(sorted(file.stem for file in asset_path("scenes").glob("*.json")))


def read_text(path: str | os.PathLike[str]) -> str:
    """Returns the text of a scene file.

    Raises:
        SceneError: the file does not exist or cannot be read.
    """
    path = Path(path)
    try:
        return path.read_text(encoding="utf-8")
    except IsADirectoryError:
        raise SceneError("scene file", str(path), "is a folder; name the JSON file in it") from None
    except FileNotFoundError:
        raise SceneError(
            "scene file",
            str(path),
            f"does not exist; check the path, name a bundled scene ({_bundled()}), or make "
            "one with python -m mjcollect.generate",
        ) from None
    except UnicodeDecodeError:
        raise SceneError("scene file", str(path), "is not UTF-8 text; save it as such") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        reason = getattr(error, "strerror", None) or error
        raise SceneError("scene file", str(path), f"cannot be read: {reason}; check it") from None


def parse(text: str, path: str | None = None) -> dict[str, Any]:
    """Returns the fields of a scene from JSON text, types checked and boxes as [min, max].

    Messages name the file's `path`, if there is one, where the text is no JSON.

    Raises:
        SceneError: the text is not JSON, or a key is missing, unknown, repeated or of a wrong type.
    """
    try:
        document = json.loads(text, object_pairs_hook=_no_twice, parse_int=_integer)
    except json.JSONDecodeError as error:
        near = text[max(0, error.pos - 20) : error.pos + 20]
        raise SceneError(
            "scene file",
            near if path is None else f"{path}: {near}",
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
    flat["yaw"] = [box.yaw for box in parsed.obstacles]
    flat["no_fly"] = [index for index, box in enumerate(parsed.obstacles) if box.no_fly]
    return flat


def printable(text: str) -> str:
    """Returns text of a file fit for a terminal: control characters become escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


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


def _integer(text: str) -> int | float:
    """Reads an integer, a long one as a float: Python's own refusal would not name the field."""
    return int(text) if len(text) <= _MAX_DIGITS else float(text)


_FIXES = {
    "missing": "is missing; add it (docs/scene-format.md lists every key)",
    "extra_forbidden": "is not a known key; remove or rename it",
    "too_long": "has too many entries; a point is [x, y, z]",
    "too_short": "has too few entries; a point is [x, y, z]",
}


def _from_pydantic(error: ValidationError) -> SceneError:
    """Returns the first problem as field, value and fix."""
    problem = error.errors(include_url=False)[0]
    place, kind = list(problem["loc"]), problem["type"]
    if kind == "missing" and isinstance(problem["input"], list):
        place.pop()  # names the point, not the coordinate that it lacks
    field = ""
    for part in place:
        field += f"[{part}]" if isinstance(part, int) else f"{'.' if field else ''}{part}"
    if len(place) < len(problem["loc"]):
        return SceneError(field, problem["input"], "a point needs three numbers [x, y, z]")
    value = "(absent)" if kind == "missing" else problem["input"]
    fix = _FIXES.get(kind, problem["msg"].replace("Input ", ""))
    return SceneError(field or "scene file", value, fix)
