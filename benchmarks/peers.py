"""Flies planners without training over generated scenes: mission time, ratio, success, contacts.

    python -m benchmarks.peers --floating 20 --city 10 --out docs/results/peers.json

Results are saved after every mission; what the file already holds is not flown again.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from mjcollect.course import Course
from mjcollect.generate import generate
from mjcollect.planners.mpc import Mpc
from mjcollect.scene import Scene
from mjcollect.tour import plan_order
from train.flight_recorder import Flight, fly_law, record
from train.mission_report import mission_result
from train.runs import versions

SHOWN = ("success", "mission_time", "lower_bound", "ratio", "detour_time", "contacts", "violations")
Row = dict[str, Any]


@dataclass(frozen=True)
class Args:
    """Fly every planner over every scene."""

    floating: int = 20
    """Generated scenes of floating boxes."""
    city: int = 10
    """Generated scenes of grounded boxes."""
    items: int = 8
    """Items in each."""
    first_seed: int = 3000
    """Scene seeds count up from here."""
    order: str = "lkh"
    """Visiting order: lkh, exact, random or given."""
    planners: tuple[str, ...] = ("mpc", "guidance")
    """Which planners fly: mpc, guidance."""
    out: Path | None = None
    """JSON file for the results, and to go on from."""


def fly_mpc(course: Course) -> tuple[Flight, Row]:
    """The MPC's flight, and how it decided."""
    mpc, milliseconds = Mpc(course), []

    def decide(task: Any) -> Any:
        begun = time.perf_counter()
        action = mpc.action(task.episodes)
        milliseconds.append(1e3 * (time.perf_counter() - begun))
        return action

    flight = record(course, lambda _, task: decide(task))
    more = {"counts": dict(mpc.counts), "solver": dict(mpc.statuses)}
    return flight, more | {"decision_ms": statistics.median(milliseconds)}


PLANNERS: dict[str, Callable[[Course], tuple[Flight, Row]]] = {
    "mpc": fly_mpc,
    "guidance": lambda course: (fly_law(course), {}),
}


def scenes(args: Args) -> list[Scene]:
    """All scenes, of each layout with seeds counting up."""
    return [
        generate(args.first_seed + number, args.items, layout=layout)
        for layout, count in (("floating", args.floating), ("city", args.city))
        for number in range(count)
    ]


def missions(args: Args, rows: list[Row]) -> None:
    """Fly what `rows` does not hold yet, add it and save."""
    done = {(row["scene"], row["planner"], row["order_method"]) for row in rows}
    for scene in scenes(args):
        todo = [name for name in args.planners if (scene.name, name, args.order) not in done]
        if not todo:
            continue
        order = plan_order(scene, args.order, seed=scene.seed)
        course = Course.mission(scene, order)
        for name in todo:
            begun = time.perf_counter()
            flight, more = PLANNERS[name](course)
            seconds = time.perf_counter() - begun
            untaught = [None] * (len(order) + 1)
            result = mission_result(course, order, args.order, flight, untaught, scene.seed)
            row = {"scene": scene.name, "layout": scene.name.split("_")[0], "planner": name}
            row |= {"order_method": args.order, "seed": scene.seed}
            row |= {key: result[key] for key in SHOWN} | {"seconds": seconds} | more
            rows.append(row)
            save(args, rows)
            time_flown = f"{row['mission_time']:.1f} s" if row["success"] else "no success"
            print(f"{scene.name}: {name}: {time_flown}, in {seconds:.0f} s", flush=True)


def save(args: Args, rows: list[Row]) -> None:
    """Write the results whole, through a temporary file."""
    if args.out is None:
        return
    args.out.parent.mkdir(parents=True, exist_ok=True)
    document = {
        "machine": {"cpus": os.cpu_count(), "processor": platform.machine()},
        "versions": versions(),
        "results": rows,
    }
    part = args.out.with_suffix(".part")
    part.write_text(json.dumps(document, indent=1) + "\n")
    os.replace(part, args.out)


def summary(rows: list[Row]) -> list[str]:
    """Lines of a table: a row for each layout, order and planner."""
    lines = [
        "| layout | order | planner | success | contacts | ratio mean | worst "
        "| of detour time mean | worst | decision (ms) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    kinds = dict.fromkeys((row["layout"], row["order_method"], row["planner"]) for row in rows)
    for kind in kinds:
        mine = [r for r in rows if (r["layout"], r["order_method"], r["planner"]) == kind]
        won = [row for row in mine if row["success"]]
        cells = [*kind, f"{len(won)} of {len(mine)}", str(sum(row["contacts"] for row in mine))]
        ratios = [row["ratio"] for row in won]
        detours = [row["mission_time"] / row["detour_time"] for row in won]
        for values in (ratios, detours):
            cells += [f"{statistics.mean(values):.4f}", f"{max(values):.4f}"] if won else ["", ""]
        timed = [row["decision_ms"] for row in mine if "decision_ms" in row]
        cells.append(f"{statistics.median(timed):.1f}" if timed else "")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main(args: Args) -> None:
    """Fly, save, print."""
    torch.set_num_threads(1)
    unknown = sorted(set(args.planners) - set(PLANNERS))
    if unknown:
        raise SystemExit(f"--planners: {unknown[0]}: must be one of {', '.join(PLANNERS)}")
    rows: list[Row] = []
    if args.out and args.out.is_file():
        rows = json.loads(args.out.read_text())["results"]
    missions(args, rows)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main(tyro.cli(Args))
