"""Makes a scene of a real place: buildings in a square become turned boxes."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from mjcollect.generate.buildings import Building
from mjcollect.generate.footprints import EXCESS, Rectangle, cover, polygons
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import from_axes, turned
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.place import Frame, Origin
from mjcollect.scene.scene import Scene

HEIGHT = 10.0  # metres of a building whose file does not say
CEILING = 120.0  # metres; flights stay below
BESIDE = (0.3, 2.0)  # Items that are drawn lie so many metres from walls, roofs and ground.
KINDS = ("wall", "roof", "ground")  # They are drawn in turn.
DRAWS = 2_000  # After so many refused draws there is no room for an item.
NEARBY = 2.0  # degrees; farther from the centre a file is of another place


@dataclass(frozen=True)
class Vehicle:
    """Holds the limits of a drone: v_max, a_max, epsilon, slot, radius, physics step (SI)."""

    v_max: float
    a_max: float
    epsilon: float
    slot: float
    uav_radius: float
    physics_step: float

    @property
    def limits(self) -> dict[str, Any]:
        """Returns the limits as keys of a scene; it comes home as near as it comes to an item."""
        return vars(self) | {"return_tolerance": self.epsilon}


VEHICLES = {
    "racer": Vehicle(50.0, 20.0, 5.0, 0.2, 0.5, 0.02),  # the suite's own
    "delivery": Vehicle(15.0, 5.0, 1.5, 0.2, 0.6, 0.02),
    "crazyflie": Vehicle(1.5, 3.0, 0.15, 0.1, 0.07, 0.01),
}


@dataclass
class Summary:
    """Counts what became of a file's buildings.

    Attributes:
        buildings: in the square. elsewhere: outside of it. other: features without area.
        repaired: names of those whose rings crossed. unknown: those without a height.
        cut: those higher than the ceiling.
        boxes: what they became. area, added: m² of footprints, and of what boxes add to them.
    """

    buildings: int = 0
    elsewhere: int = 0
    other: int = 0
    repaired: list[str] = field(default_factory=list)
    unknown: int = 0
    cut: int = 0
    boxes: int = 0
    area: float = 0.0
    added: float = 0.0

    def lines(self, height: float) -> list[str]:
        """Returns the summary as lines of text; `height` is that of buildings without one (m)."""
        share = self.added / max(self.area, 1e-9)
        out = [
            f"{self.buildings} buildings in the square, {self.elsewhere} outside of it",
            f"{self.boxes} boxes, which cover {self.area:.0f} m² and add {share:.1%}",
        ]
        if self.other:
            out.append(f"{self.other} features are no areas")
        out += self.mended()
        if self.unknown:
            out.append(f"{self.unknown} without a height; they count as {height:g} m high")
        if self.cut:
            out.append(f"{self.cut} higher than the ceiling, cut off there")
        return out

    def mended(self) -> list[str]:
        """Returns a line that names what was repaired, if anything was."""
        if not self.repaired:
            return []
        names = ", ".join(self.repaired[:5]) + (", ..." if len(self.repaired) > 5 else "")
        return [f"{len(self.repaired)} with crossing rings, repaired: {names}"]


def boxes_of(
    buildings: Iterable[Building | None], frame: Frame, size: float, ceiling: float = CEILING,
    height: float = HEIGHT, excess: float = EXCESS, needed: bool = True,
) -> tuple[Array, Array, Summary]:  # fmt: skip
    """Returns boxes (M, 2, 3), their yaw (M,) and what became of the buildings.

    Args:
        frame: of the square's centre. size: the square's sides (m). ceiling: m above ground.
        height: of buildings that have none (m). excess: as in `footprints.cover`.
        needed: whether there must be any in the square.

    Raises:
        SceneError: no building lies in the square; the message says what the file holds instead.
    """
    window, summary = shapely.box(-size / 2, -size / 2, size / 2, size / 2), Summary()
    boxes: list[Array] = []
    yaws: list[float] = []
    seen: list[Array] = []
    for building in buildings:
        if building is None:
            summary.other += 1
            continue
        if shapely.is_empty(building.outline):
            raise SceneError("map file: feature", building.name, "has no outline; remove it")
        seen.append(np.array(building.outline.bounds))
        if not _is_near(seen[-1], frame):
            summary.elsewhere += 1
            continue
        outline = shapely.transform(building.outline, lambda at: _level(frame, at))
        if not shapely.is_valid(outline):
            outline = shapely.make_valid(outline)
            summary.repaired.append(building.name)
        parts = polygons(shapely.intersection(outline, window))
        if not parts:
            summary.elsewhere += 1
            continue
        top = height if building.height is None else building.height
        summary.buildings += 1
        summary.unknown += building.height is None
        summary.cut += top > ceiling
        if building.base >= min(top, ceiling):
            continue
        for part in parts:
            summary.area += part.area
            for rectangle in cover(part, excess, window):
                boxes.append(_box(rectangle, building.base, min(top, ceiling)))
                yaws.append(rectangle.yaw)
    if summary.buildings == 0 and needed:
        raise _nothing_there(seen, frame, size)
    summary.boxes = len(boxes)
    summary.added = float(sum(np.prod(np.diff(box, axis=0)[0, :2]) for box in boxes)) - summary.area
    return np.array(boxes).reshape(-1, 2, 3), np.array(yaws), summary


def _level(frame: Frame, degrees: Array) -> Array:
    """Returns points (n, 2) in m of longitudes and latitudes (n, 2)."""
    return frame.local(np.c_[degrees[:, 1], degrees[:, 0], np.zeros(len(degrees))])[:, :2]


def _box(rectangle: Rectangle, base: float, top: float) -> Array:
    low, high = rectangle.centre - rectangle.half, rectangle.centre + rectangle.half
    return np.array([[*low, base], [*high, top]])


def _is_near(bounds: Array, frame: Frame) -> bool:
    """Returns whether an outline is where a projection about the origin makes sense."""
    here = np.array([frame.origin.longitude, frame.origin.latitude])
    return bool(np.all(np.abs(bounds[:2] - here) < NEARBY))


def _nothing_there(seen: Sequence[Array], frame: Frame, size: float) -> SceneError:
    """Returns an error that says what a file holds instead of buildings in the square."""
    if not seen:
        return SceneError("map file", "no polygon", "holds no area; export footprints of buildings")
    every = np.array(seen)
    (west, south), (east, north) = every[:, :2].min(axis=0), every[:, 2:].max(axis=0)
    reach = f"longitude {west:.5g} to {east:.5g}, latitude {south:.5g} to {north:.5g}"
    here = frame.origin
    if max(abs(west), abs(east)) > 180 or max(abs(south), abs(north)) > 90:
        fix = "is not in degrees; convert it to WGS 84, e.g. ogr2ogr -t_srs EPSG:4326"
    elif (
        abs((west + east) / 2 - here.latitude) < NEARBY
        and abs((south + north) / 2 - here.longitude) < NEARBY
        and abs(here.latitude - here.longitude) > 2 * NEARBY
    ):
        fix = "has longitude and latitude the other way round; GeoJSON gives longitude first"
    else:
        fix = f"has no building within {size / 2:g} m of --center; its middle is " + (
            f"{(south + north) / 2:.6f} {(west + east) / 2:.6f}"
        )
    return SceneError("map file", reach, fix)


def place_scene(
    name: str, origin: Origin, boxes: Array, yaw: Array, size: float, ceiling: float,
    vehicle: Vehicle, depot: Array | None = None, items: Array | None = None,
    random_items: int = 0, seed: int = 0, clearance: float = 0.0, zones: int = 0,
) -> Scene:  # fmt: skip
    """Returns the scene of a place.

    Args:
        zones: so many of the boxes, the last ones, are no-fly zones.
        clearance: to keep from buildings (m).
        depot: (3,) m; by default a free place on the ground near the centre. items: (K, 3) m.
        random_items: so many are drawn at walls, on roofs and on the ground besides.

    Raises:
        SceneError: there is no room, or the scene is refused.
    """
    rng, half = np.random.default_rng(seed), size / 2
    bounds = np.array([[-half, -half, 0.0], [half, half, ceiling]])
    standing = turned(boxes, yaw)
    if depot is None:
        depot = _free_place(rng, standing, vehicle.uav_radius + clearance, half)
    points = [] if items is None else list(items)
    for k in range(random_items):
        kind = KINDS[k % len(KINDS)]
        points.append(_item(rng, kind, standing, bounds, vehicle, clearance, len(boxes) - zones))
    return Scene(
        name, seed, bounds, depot, np.array(points).reshape(-1, 3), boxes, origin=origin, yaw=yaw,
        clearance=clearance, no_fly=tuple(range(len(boxes) - zones, len(boxes))), **vehicle.limits,
    )  # fmt: skip


def _free_place(rng: np.random.Generator, boxes: Array, radius: float, half: float) -> Array:
    """Returns a place on the ground that is free all around, as near to the centre as is found."""
    for reach in np.linspace(0.0, half - radius, 60):
        for _ in range(40):
            point = np.array([*rng.uniform(-reach, reach, 2), radius])
            if point_box_distance(point, boxes).min(initial=np.inf) >= radius + 2.0:
                return np.round(point, 3)
    raise SceneError("--depot", "none", "there is no free place on the ground; give LAT LON ALT")


def _item(
    rng: np.random.Generator, kind: str, boxes: Array, bounds: Array, vehicle: Vehicle,
    clearance: float, bodies: int,
) -> Array:  # fmt: skip
    """Draws an item at a wall, on a roof or on the ground, where the body can come near it."""
    for _ in range(DRAWS):
        away = rng.uniform(*BESIDE)
        if kind == "ground" or bodies == 0:
            point = np.array([*rng.uniform(bounds[0, :2], bounds[1, :2]), away])
        else:
            box = boxes[rng.integers(bodies)]
            low, high = box[0], box[1]
            local = rng.uniform(low, high)
            if kind == "roof":
                local[2] = high[2] + away
            else:
                axis, side = rng.integers(2), rng.integers(2)
                local[axis] = (low[axis] - away) if side == 0 else (high[axis] + away)
            point = from_axes(local, box)
        point = np.round(point, 3)
        inside = np.all(point >= bounds[0]) and np.all(point <= bounds[1])
        gap = point_box_distance(point, boxes).min(initial=np.inf)
        reach = vehicle.uav_radius + clearance
        stands = inside and _can_stand(rng, point, boxes, bounds, vehicle.epsilon / 2, reach)
        if stands and gap >= BESIDE[0] / 2:
            return point
    raise SceneError("--random-items", kind, f"no room for an item by the {kind}; ask for fewer")


def _can_stand(
    rng: np.random.Generator, item: Array, boxes: Array, bounds: Array, near: float, reach: float
) -> bool:
    """Returns whether a body fits that is `near` m or less from an item and `reach` from boxes."""
    away = rng.normal(size=(60, 3))
    away *= rng.random((60, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True)
    points = np.clip(item + np.r_[[[0, 0, 0]], away] * near, *bounds)
    beside = boxes[point_box_distance(item, boxes) < near + reach]
    gap = point_box_distance(points[:, None], beside).min(axis=1, initial=np.inf)
    return bool(np.any(gap >= reach))


def read_items(path: Any, frame: Frame) -> Array:
    """Returns items (K, 3) in m of a CSV file: latitude, longitude, height above ground.

    Raises:
        SceneError: a row is no place; the message names it.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError("--items", str(path), f"cannot be read ({error})") from None
    places = []
    for number, row in enumerate(rows, start=1):
        try:
            latitude, longitude, height = map(float, row)
        except ValueError:
            if number == 1:
                continue  # the header
            fix = "needs latitude, longitude and metres above ground"
            raise SceneError(f"--items: row {number}", ",".join(row), fix) from None
        places.append([latitude, longitude, height + frame.origin.altitude])
    if not places:
        raise SceneError("--items", str(path), "holds no item")
    return np.round(frame.local(places), 3)
