"""Flies missions in ten squares of a real town, from the map file to the flight plan.

    python -m benchmarks.places --planners mpc guidance shipped --out docs/results/places.json

For each square the programs are run as a user runs them: `mjcollect import` makes the scene, with
items drawn at walls, on roofs and on the ground, and `train.fly` flies it and writes the plan.
Results are saved after every mission; what the file already holds is not flown again.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from benchmarks.common import Row, grouped, load_rows, print_table, save
from mjcollect.scene.scene import Scene

TOWN = Path(__file__).parents[1] / "examples" / "suzhou" / "buildings.geojson"
# Squares of 600 m side by side, three to a row; degrees of latitude and longitude.
CENTERS = tuple(
    (round(31.2928 + 0.00541 * row, 5), round(120.6003 + 0.00631 * column, 5))
    for row in range(4)
    for column in range(3)
)[:10]
KEPT = ("success", "mission_time", "lower_bound", "ratio", "detour_time", "contacts")
COLUMNS = (
    ("planner", "{planner}"),
    ("place", "{place}"),
    ("boxes", "{boxes}"),
    ("success", "{success}"),
    ("contacts", "{contacts}"),
    ("time", "{mission_time:.1f}"),
    ("of detour time", "{of_detour:.4f}"),
    ("seconds", "{seconds:.0f}"),
)
Planner = Literal["shipped", "mpc", "reference", "guidance"]


@dataclass(frozen=True)
class Args:
    """Flies every planner over every place."""

    buildings: Path = TOWN
    """Map file, GeoJSON or OpenStreetMap."""
    centers: tuple[tuple[float, float], ...] = CENTERS
    """Latitude and longitude of each square's centre."""
    size: float = 600.0
    """Side of each square (m)."""
    items: int = 8
    """Number of items in each square."""
    vehicle: str = "delivery"
    """Limits of the drone: delivery, racer or crazyflie."""
    planners: tuple[Planner, ...] = ("mpc",)
    """Planners that fly; `shipped` is the policy."""
    out: Path | None = None
    """JSON file for the results; missions that it holds already are not flown again."""


def run(command: list[str]) -> tuple[float, int]:
    """Runs one of the programs; returns the seconds that it took, and its exit code.

    Raises:
        SystemExit: it was refused.
    """
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True)
    if done.returncode == 2:
        raise SystemExit(done.stderr[-2000:])
    return time.perf_counter() - begun, done.returncode


def fly_place(number: int, planner: Planner, args: Args) -> Row:
    """Makes the scene of a place and flies it; returns its row of the results."""
    with tempfile.TemporaryDirectory() as folder:
        scene, out = Path(folder) / f"place_{number}.json", Path(folder) / "run"
        center = [str(degrees) for degrees in args.centers[number]]
        made, _ = run(
            [
                "mjcollect.generate.import_place", str(args.buildings), "--center", *center,
                "--size", str(args.size), "--random-items", str(args.items),
                "--seed", str(number), "--vehicle", args.vehicle, "--out", str(scene),
            ]
        )  # fmt: skip
        pilot = [] if planner == "shipped" else ["--planner", planner]
        flown, _ = run(
            [
                "train.fly", "--scene", str(scene), *pilot, "--no-video", "--no-plots",
                "--out", str(out),
            ]
        )  # fmt: skip
        result = json.loads((out / "mission.json").read_text())
        row: Row = {"place": number, "planner": planner, "boxes": len(Scene.load(scene).obstacles)}
        row |= {key: result[key] for key in KEPT}
        row["flown_by"] = result.get("planner", "policy")
        row["legs"] = [[leg["time"], leg["detour_time"]] for leg in result["segments"]]
        whole = result["mission_time"]
        row["of_detour"] = None if whole is None else whole / result["detour_time"]
        row["plan"] = (out / "mission.plan").is_file()
        return row | {"seconds": made + flown}


def main(args: Args) -> None:
    """Flies what the file does not hold yet, saves, prints."""
    rows = load_rows(args.out)
    for number in range(len(args.centers)):
        for planner in args.planners:
            if grouped(rows, "place", "planner").get((number, planner)):
                continue
            rows.append(fly_place(number, planner, args))
            save(args.out, {"results": rows}, args)
            print_table(rows[-1:], COLUMNS)
    print()
    print_table(rows, COLUMNS)
    for (planner,), mine in grouped(rows, "planner").items():
        won = [row for row in mine if row["success"] and not row["contacts"]]
        ratios = [row["of_detour"] for row in won] or [float("nan")]
        print(
            f"{planner}: {len(won)} of {len(mine)}, mean {statistics.mean(ratios):.4f}, worst "
            f"{max(ratios):.4f} of the detour time, {max(row['seconds'] for row in mine):.0f} s "
            "at most"
        )


if __name__ == "__main__":
    main(tyro.cli(Args))
