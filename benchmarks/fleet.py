"""Flies fleets in generated scenes: does the last UAV come home as soon as it would alone?

    OMP_NUM_THREADS=1 python -m benchmarks.fleet --out docs/results/fleet.json
    OMP_NUM_THREADS=1 python -m benchmarks.fleet --curve --out docs/results/fleet_curve.json
    OMP_NUM_THREADS=1 python -m benchmarks.fleet --sweep --out docs/results/fleet_sweep.json

Each fleet is flown twice: all UAVs in one scene, and each tour without the others, from the same
place at the depot and by the same pilot. The verifier judges both. --curve flies the same scenes
with 1 to 8 UAVs, --sweep the paper's sweep of 8 items with 1 to 3.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from benchmarks.common import Output, Row, grouped, in_processes, load_rows, print_table, save
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import courses
from mjcollect.fleet.flight import FleetFlight, fly_fleet
from mjcollect.generate import generate
from mjcollect.guidance.travel_times import travel_times
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, weights_file
from mjcollect.planners.assignment import assign, makespan
from mjcollect.planners.fleet_bound import fleet_bound
from mjcollect.verify import least_gaps, verify, verify_separation
from train.fleets.fly import pilot_of
from train.fleets.report import Sharing

FIRST = 700_000  # no other benchmark and no training draws these scenes
COLUMNS = (
    ("layout", "{layout}"),
    ("items", "{items}"),
    ("UAVs", "{uavs}"),
    ("pilot", "{pilot}"),
    ("scenes", "{scenes}"),
    ("successes", "{successes}"),
    ("nearest (m)", "{nearest:.2f}"),
    ("makespan (s)", "{makespan:.1f}"),
    ("over bound, mean", "{of_bound:.3f}"),
    ("over alone, mean", "{of_alone:.4f}"),
    ("worst", "{of_alone_worst:.4f}"),
    ("speed-up", "{speed_up:.2f}"),
    ("shield", "{shielded:.2%}"),
    ("made room", "{made_room:.2%}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Flies fleets in generated scenes."""

    planners: tuple[str, ...] = ("policy", "mpc", "guidance")
    """What flies: policy, mpc, guidance."""
    policy: Path = SHIPPED
    """Policy that flies: shipped, or a file."""
    floating: int = 20
    """Number of floating scenes."""
    city: int = 10
    """Number of city scenes."""
    items: int = 24
    """Number of items in a scene."""
    uavs: tuple[int, ...] = (3,)
    """Numbers of UAVs."""
    curve: bool = False
    """Flies with 1 to 8 UAVs."""
    sweep: bool = False
    """Flies the paper's sweep of 8 items, in floating scenes of 20 boxes, with 1 to 3 UAVs."""
    workers: int = 2
    """Processes that fly side by side."""


def flown_by(sharing: Sharing, planner: str, policies: list[TrainedPolicy]) -> FleetFlight:
    """Returns a flight of a fleet by a new pilot."""
    pilot, observation = pilot_of(planner, sharing, policies, explore=True)
    return fly_fleet(sharing.courses, pilot, Rules(observation))


def measure(
    file: Path, uavs: Sequence[int], job: tuple[str, int, int, tuple[str, ...]]
) -> list[Row]:
    """Returns how a scene was flown by fleets of several sizes and by several pilots."""
    layout, number, items, planners = job
    scene, rows = generate(FIRST + number, items, layout=layout), []
    cost = travel_times(scene)
    for count in uavs:
        begun = time.perf_counter()
        tours = tuple(tour for tour in assign(cost, count) if tour)
        about: Row = {"layout": layout, "scene": number, "items": items, "uavs": count}
        about["seconds_assignment"] = time.perf_counter() - begun
        about["assigned"] = makespan(cost, tours)
        about["lower_bound"], about["bound_method"] = fleet_bound(scene, count)
        sharing = Sharing(scene, count, tours, courses(scene, tours))
        for planner in planners:
            policies = [TrainedPolicy.load(file)] if planner == "policy" else []
            rows.append({**about, "pilot": planner, **compare(sharing, planner, policies)})
    return rows


def compare(sharing: Sharing, planner: str, policies: list[TrainedPolicy]) -> Row:
    """Returns how a fleet flew, and how its UAVs fly without the others."""
    flown = flown_by(sharing, planner, policies)
    tracks = [flight.trajectory for flight in flown.flights]
    gaps = [float(least_gaps(one, two).min()) for k, two in enumerate(tracks) for one in tracks[:k]]
    alone = [
        flown_by(Sharing(sharing.scene, 1, (tour,), (course,)), planner, policies)
        for tour, course in zip(sharing.tours, sharing.courses, strict=True)
    ]
    success = flown.success and not verify_separation(sharing.scene, tracks)
    for course, track in zip(sharing.courses, tracks, strict=True):
        success = success and not verify(course.scene, track, range(len(course.scene.items)))
    each = [flight.makespan for flight in alone] if all(f.success for f in alone) else []
    return {
        "success": success,
        "ended": flown.ended,
        "makespan": flown.makespan,
        "alone": max(each, default=None),
        "times": [track.duration for track in tracks],
        "times_alone": each,
        "nearest": min(gaps, default=None),
        "shielded": statistics.mean(flight.shield_share for flight in flown.flights),
        "made_room": statistics.mean(flown.made_room),
    }


def summary(rows: list[Row]) -> list[Row]:
    """Returns a row for each layout, number of UAVs and pilot; times are those of successes."""
    table = []
    one = {
        (row["layout"], row["items"], row["scene"], row["pilot"]): row["makespan"]
        for row in rows
        if row["uavs"] == 1 and row["success"]
    }
    for key, mine in grouped(rows, "layout", "items", "uavs", "pilot").items():
        good = [row for row in mine if row["success"]]
        alone = [row["makespan"] / row["alone"] for row in good if row["alone"] is not None]
        faster = []
        for row in good:
            other = one.get((row["layout"], row["items"], row["scene"], row["pilot"]))
            faster += [] if other is None else [other / row["makespan"]]
        found = dict(zip(("layout", "items", "uavs", "pilot"), key, strict=True))

        def mean(values: list[float]) -> float | None:
            return statistics.mean(values) if values else None

        table.append(
            {
                **found,
                "scenes": len(mine),
                "successes": len(good),
                "nearest": min((r["nearest"] for r in mine if r["nearest"]), default=None),
                "makespan": mean([row["makespan"] for row in good]),
                "of_bound": mean([row["makespan"] / row["lower_bound"] for row in good]),
                "of_alone": mean(alone),
                "of_alone_worst": max(alone, default=None),
                "speed_up": mean(faster),
                "shielded": mean([row["shielded"] for row in mine]),
                "made_room": mean([row["made_room"] for row in mine]),
            }
        )
    return table


def main(args: Args) -> None:
    """Flies what is not in the file of results yet, prints, saves."""
    uavs, items = args.uavs, args.items
    scenes = [("floating", k) for k in range(args.floating)]
    scenes += [("city", k) for k in range(args.city)]
    if args.curve:
        uavs = tuple(range(1, 9))
    if args.sweep:
        uavs, items, scenes = (1, 2, 3), 8, scenes[: args.floating]
    rows = load_rows(args.out)
    there = {(row["layout"], row["scene"]) for row in rows}
    jobs = [(*scene, items, args.planners) for scene in scenes if scene not in there]
    work = partial(measure, weights_file(args.policy), uavs)
    for found in in_processes(work, jobs, args.workers):
        rows += found
        save(args.out, {"results": rows, "summary": summary(rows)}, args)
    print_table(summary(rows), COLUMNS)


if __name__ == "__main__":
    main(tyro.cli(Args))
