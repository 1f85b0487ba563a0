"""Flies missions over generated scenes: learned policies, MPC and guidance law, side by side.

    python -m benchmarks.missions --floating 20 --city 10 --out docs/results/missions.json

Runs the learned ones as programs of their own, without videos: `policy` learns every mission from
scratch, `finetuned` from the policy that is shipped, and `shipped` flies that policy at once
(`train.fly`, also without plots). Their peers fly the same scene in the same order. Results are
saved after every mission; what the file already holds is not flown again.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from benchmarks.common import Row, grouped, load_rows, save
from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight, fly_law, record
from mjcollect.learning.policy import SHIPPED, policy_digest
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference.reference import Reference
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.reproduction.plan import Sizes, random_scenes
from train.support.markdown import markdown_table
from train.support.mission_report import mission_result

SHOWN = (
    "success", "mission_time", "lower_bound", "ratio", "detour_time", "contacts", "violations",
    "shield_share",
)  # fmt: skip
COLUMNS = (
    "layout", "order", "planner", "success", "contacts", "ratio mean", "worst",
    "of detour time mean", "worst", "decision (ms)", "seconds", "worst",
)  # fmt: skip
Planner = Literal["policy", "finetuned", "shipped", "mpc", "reference", "guidance"]


@dataclass(frozen=True)
class Args:
    """Flies every planner over every scene."""

    floating: int = 20
    """Number of generated scenes with floating boxes."""
    city: int = 10
    """Number of generated scenes with grounded boxes."""
    items: int = 8
    """Number of items in each scene."""
    first_seed: int = 5000
    """Seed of the first scene of each layout, from which seeds count up."""
    order: str = "lkh"
    """Visiting order: lkh, exact, random or given."""
    planners: tuple[Planner, ...] = ("policy", "mpc", "guidance")
    """Planners that fly; `policy`, `finetuned` and `shipped` are learned."""
    workers: int = 2
    """Processes that train a mission's segments side by side."""
    out: Path | None = None
    """JSON file for the results; missions that it holds already are not flown again."""


def fly_planned(kind: Callable[[Course], Any], course: Course) -> tuple[Flight, Row]:
    """Returns the flight of a planner made by `kind`, and how it decided."""
    planner, milliseconds = kind(course), []

    def decide(_: Any, task: Any) -> Any:
        begun = time.perf_counter()
        action = planner.action(task.episodes)
        milliseconds.append(1e3 * (time.perf_counter() - begun))
        return action

    flight = record(course, decide)
    how = {"counts": dict(planner.counts), "solver": dict(planner.statuses)}
    return flight, how | {"decision_ms": statistics.median(milliseconds)}


def run(scene: Scene, order: Sequence[int], program: Sequence[str], args: Args) -> tuple[Row, Row]:
    """Runs one of PROGRAMS; returns its result, and its memory, training and final pilot."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "scene.json", Path(folder) / "run"
        scene.save(path)
        command = [sys.executable, "-m", *program, "--scene", str(path), "--out", str(out)]
        command += ["--order", ",".join(map(str, order)), "--no-video"]
        if program[0] == "train.mission":
            command += ["--workers", str(args.workers)]
        with open(Path(folder) / "messages", "w") as messages:
            process = subprocess.Popen(command, stdout=messages, stderr=messages)
            peak = 0.0
            while process.poll() is None:
                peak = max(peak, memory(process.pid))
                # Reading the sizes takes a tenth of a second of a core.
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(3.0)
        if not (out / "mission.json").is_file():
            raise SystemExit((Path(folder) / "messages").read_text()[-2000:])
        result = json.loads((out / "mission.json").read_text())
    segments = result["segments"]
    return result, {
        "peak_gib": peak,
        "segment_train_seconds": [segment["train_seconds"] for segment in segments],
        "updates": [segment["updates"] for segment in segments],
        "flown_by": result.get("planner", "policy"),
    }


def memory(pid: int) -> float:
    """Returns the proportional set size of a process and its descendants, in GiB (Linux)."""
    total = 0.0
    with contextlib.suppress(OSError):
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
        total = int(rollup.split("Pss:")[1].split()[0]) / 2**20
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            total += sum(memory(int(child)) for child in children.read_text().split())
    return total


PROGRAMS = {
    "policy": ("train.mission", "--policy", "none"),
    "finetuned": ("train.mission",),
    "shipped": ("train.fly", "--no-plots"),
}
OF_SHIPPED = ("finetuned", "shipped")  # flown anew when another policy is shipped
PLANNERS: dict[str, Callable[[Course], tuple[Flight, Row]]] = {
    "mpc": partial(fly_planned, Mpc),
    "reference": partial(fly_planned, Reference),
    "guidance": lambda course: (fly_law(course), {}),
}


def scenes(args: Args) -> list[Scene]:
    """Returns all scenes."""
    sizes = Sizes(
        floating=args.floating, city=args.city, items=args.items, first_scene=args.first_seed
    )
    return list(random_scenes(sizes).values())


def fly_mission(scene: Scene, name: str, args: Args) -> Row:
    """Flies one mission by a planner, and returns its row of the results."""
    order = plan_order(scene, args.order, seed=scene.seed)
    course = None if name in PROGRAMS else Course.mission(scene, order)
    begun = time.perf_counter()
    if course is None:
        result, more = run(scene, order, PROGRAMS[name], args)
    else:
        flight, more = PLANNERS[name](course)
        untrained = [None] * (len(order) + 1)
        result = mission_result(course, order, args.order, flight, untrained, scene.seed)
    row = {"scene": scene.name, "layout": scene.name.split("_")[0], "planner": name}
    row |= {"order_method": args.order, "seed": scene.seed}
    row |= {key: result[key] for key in SHOWN}
    return row | {"seconds": time.perf_counter() - begun} | more


def missions(args: Args, rows: list[Row]) -> None:
    """Flies what `rows` does not hold yet, adds it and saves."""
    digests = dict.fromkeys(OF_SHIPPED, policy_digest(SHIPPED))
    for scene in scenes(args):
        for name in args.planners:
            key = scene.name, name, args.order
            old = grouped(rows, "scene", "planner", "order_method").get(key, [])
            if any(row.get("shipped") == digests.get(name) for row in old):
                continue
            row = fly_mission(scene, name, args)
            if name in digests:
                row["shipped"] = digests[name]
            rows[:] = [*(row for row in rows if row not in old), row]
            save(args.out, {"results": rows})
            flown = f"{row['mission_time']:.1f} s" if row["success"] else "no success"
            print(f"{scene.name}: {name}: {flown}, in {row['seconds']:.0f} s", flush=True)


def summary(rows: Sequence[Row]) -> list[str]:
    """Returns the lines of a table: a row for each layout, order and planner."""
    table = []
    for kind, mine in grouped(rows, "layout", "order_method", "planner").items():
        won = [row for row in mine if row["success"]]
        cells = [*kind, f"{len(won)} of {len(mine)}", str(sum(row["contacts"] for row in mine))]
        ratios = [row["ratio"] for row in won]
        detours = [row["mission_time"] / row["detour_time"] for row in won]
        for values in (ratios, detours):
            cells += [f"{statistics.mean(values):.4f}", f"{max(values):.4f}"] if won else ["", ""]
        timed = [row["decision_ms"] for row in mine if "decision_ms" in row]
        cells.append(f"{statistics.median(timed):.1f}" if timed else "")
        seconds = [row["seconds"] for row in mine]
        table.append([*cells, f"{statistics.median(seconds):.0f}", f"{max(seconds):.0f}"])
    return markdown_table(COLUMNS, table)


def main(args: Args) -> None:
    """Flies, saves, prints."""
    torch.set_num_threads(1)
    rows = load_rows(args.out)
    missions(args, rows)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main(tyro.cli(Args))
