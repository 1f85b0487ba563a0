"""Makes a scene of real buildings: `mjcollect import FILE --center LAT LON --out my.json`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

try:
    import shapely  # noqa: F401 - what is imported next needs it
except ImportError:
    raise ImportError(
        "real places need Shapely, pyproj and osmium: pip install 'mjcollect[geo]'"
    ) from None

from mjcollect.generate.buildings import read_buildings
from mjcollect.generate.footprints import EXCESS
from mjcollect.generate.place import (
    CEILING,
    HEIGHT,
    VEHICLES,
    boxes_of,
    place_scene,
    read_items,
)
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.place import Frame, Origin

SIZE = 600.0  # metres
SIZES = (10.0, 20_000.0)  # A square has sides in this range (m).


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 2 if there is no such place in the file."""
    args = _parser().parse_args(argv)
    try:
        if args.out.exists() and not args.overwrite:
            raise SceneError("--out", str(args.out), "exists; add --overwrite or name another file")
        _check(args)
        latitude, longitude = args.center
        origin = Origin(latitude, longitude, args.altitude)
        frame = Frame(origin)
        boxes, yaw, summary = boxes_of(
            read_buildings(args.file), frame, args.size, args.ceiling, args.height, args.excess
        )
        zones = 0
        if args.no_fly is not None:
            more, turned, found = boxes_of(
                read_buildings(args.no_fly), frame, args.size, args.ceiling, args.ceiling,
                args.excess, needed=False,
            )  # fmt: skip
            zones, boxes, yaw = len(more), np.concatenate([boxes, more]), np.append(yaw, turned)
        depot = None
        if args.depot is not None:
            place = [*args.depot[:2], args.depot[2] + origin.altitude]
            depot = np.round(frame.local(place), 3)
        items = None if args.items is None else read_items(args.items, frame)
        vehicle = VEHICLES[args.vehicle]
        scene = place_scene(
            args.name or args.out.stem, origin, boxes, yaw, args.size, args.ceiling, vehicle, depot,
            items, args.random_items, args.seed, args.clearance, zones,
        )  # fmt: skip
        args.out.parent.mkdir(parents=True, exist_ok=True)
        scene.save(args.out)
    except (SceneError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        name = error.filename or args.out
        print(f"error: {name}: cannot be used: {error.strerror}", file=sys.stderr)
        return 2
    print(f"{args.out}: {len(scene.items)} items")
    if args.no_fly is not None:
        print("\n".join([f"{found.buildings} no-fly zones, {zones} boxes", *found.mended()]))
    print("\n".join(summary.lines(args.height)))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mjcollect import",
        description="Makes a scene file of the buildings in a square of a map. Terrain is flat.",
        usage=argparse.SUPPRESS,  # errors in one line
    )
    add = parser.add_argument
    add("file", type=Path, help="Map: GeoJSON, CityJSON or OpenStreetMap (.osm, .pbf).")
    add(
        "--center", type=float, nargs=2, required=True, metavar=("LAT", "LON"),
        help="Middle of the square, in degrees; the scene's origin.",
    )  # fmt: skip
    add("--size", type=float, default=SIZE, help=f"Sides of the square in metres ({SIZE:g}).")
    add("--out", type=Path, required=True, help="Scene file to write.")
    add("--name", help="Name of the scene; that of the file by default.")
    add("--altitude", type=float, default=0.0, help="Metres of the ground above sea level (0).")
    add(
        "--depot", type=float, nargs=3, metavar=("LAT", "LON", "ALT"),
        help="Depot; ALT in metres above ground. A free place near the centre by default.",
    )  # fmt: skip
    add("--items", type=Path, help="CSV file: latitude, longitude, metres above ground.")
    add(
        "--random-items", type=int, default=0, metavar="N",
        help="Draws N items by walls, above roofs and above the ground, 0.3 to 2 m from them.",
    )  # fmt: skip
    add("--seed", type=int, default=0, help="Seed of what is drawn (0).")
    add(
        "--vehicle", choices=list(VEHICLES), default="delivery",
        help="Drone whose limits the scene takes (delivery).",
    )  # fmt: skip
    add(
        "--no-fly", type=Path, metavar="FILE",
        help="GeoJSON polygons where none may fly, from `min_height` to `height`, in metres above "
        "ground; without these from the ground to the ceiling.",
    )  # fmt: skip
    add("--clearance", type=float, default=0.0, help="Metres to keep from buildings (0).")
    add("--ceiling", type=float, default=CEILING, help=f"Metres above ground ({CEILING:g}).")
    add(
        "--height", type=float, default=HEIGHT,
        help=f"Metres of buildings whose height is not known ({HEIGHT:g}).",
    )  # fmt: skip
    add(
        "--excess", type=float, default=EXCESS,
        help=f"Share of its area that boxes may add to a building ({EXCESS:g}).",
    )  # fmt: skip
    add("--overwrite", action="store_true", help="Replaces an existing file.")
    return parser


def _check(args: argparse.Namespace) -> None:
    """Raises a SceneError for a number out of range."""
    for name, value, least, most in (
        ("--size", args.size, *SIZES),
        ("--ceiling", args.ceiling, 1.0, 10_000.0),
        ("--clearance", args.clearance, 0.0, 1_000.0),
        ("--height", args.height, 0.1, 1_000.0),
        ("--excess", args.excess, 0.01, 100.0),
        ("--random-items", args.random_items, 0, 10_000),
        ("--seed", args.seed, 0, 2**63 - 1),
    ):
        if not least <= value <= most:
            raise SceneError(name, value, f"must lie between {least:g} and {most:g}")
    if args.items is None and args.random_items == 0:
        raise SceneError("--items", "none", "give --items FILE or --random-items N")


if __name__ == "__main__":
    raise SystemExit(main())
