"""Missions over generated scenes: learned policies, MPC and guidance law, side by side.

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
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.results import save
from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight, fly_law, record
from mjcollect.generate import generate
from mjcollect.learning.policy import SHIPPED, policy_digest
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference.reference import Reference
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.support.mission_report import mission_result

SHOWN = (
    "success", "mission_time", "lower_bound", "ratio", "detour_time", "contacts", "violations",
    "shield_share",
)  # fmt: skip
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
    first_seed: int = 5000
    """Scene seeds count up from here."""
    order: str = "lkh"
    """Visiting order: lkh, exact, random or given."""
    planners: tuple[str, ...] = ("policy", "mpc", "guidance")
    """Which planners fly: policy, finetuned, shipped, mpc, reference, guidance."""
    workers: int = 2
    """Processes that train a mission's segments side by side."""
    seed: int = 0
    """Seed of the training."""
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


def fly_reference(course: Course) -> tuple[Flight, Row]:
    """The flight of the whole mission planned ahead, and how it was planned."""
    reference = Reference(course)
    flight = record(course, lambda _, task: reference.action(task.episodes))
    return flight, {"counts": dict(reference.counts), "solver": dict(reference.statuses)}


def run(scene: Scene, program: Sequence[str], args: Args) -> tuple[Row, Row]:
    """The result of one of PROGRAMS; its memory, its training times, who flew in the end."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "scene.json", Path(folder) / "run"
        scene.save(path)
        command = [sys.executable, "-m", *program, "--scene", str(path), "--out", str(out)]
        command += ["--order", args.order, "--no-video"]
        if program[0] == "train.mission":
            command += ["--workers", str(args.workers)]
        with open(Path(folder) / "messages", "w") as messages:
            process = subprocess.Popen(
                [*command, "--seed", str(args.seed)], stdout=messages, stderr=messages
            )
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
    """Proportional set size of a process and its descendants, in GiB (Linux)."""
    total = 0
    with contextlib.suppress(OSError):
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
        total = int(rollup.split("Pss:")[1].split()[0])
        for child in Path(f"/proc/{pid}/task").glob("*/children"):
            total += sum(int(memory(int(other)) * 2**20) for other in child.read_text().split())
    return total / 2**20


PROGRAMS = {
    "policy": ("train.mission", "--policy", "none"),
    "finetuned": ("train.mission",),
    "shipped": ("train.fly", "--no-plots"),
}
OF_SHIPPED = ("finetuned", "shipped")  # flown anew when another policy is shipped
PLANNERS: dict[str, Callable[[Course], tuple[Flight, Row]]] = {
    "mpc": fly_mpc,
    "reference": fly_reference,
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
    shipped = policy_digest(SHIPPED)
    done = {
        (row["scene"], row["planner"], row["order_method"])
        for row in rows
        if row.get("shipped") == (shipped if row["planner"] in OF_SHIPPED else None)
    }
    for scene in scenes(args):
        todo = [name for name in args.planners if (scene.name, name, args.order) not in done]
        if not todo:
            continue
        order = plan_order(scene, args.order, seed=scene.seed)
        course = Course.mission(scene, order)
        for name in todo:
            begun = time.perf_counter()
            if name in PROGRAMS:
                result, more = run(scene, PROGRAMS[name], args)
            else:
                flight, more = PLANNERS[name](course)
                untaught = [None] * (len(order) + 1)
                result = mission_result(course, order, args.order, flight, untaught, scene.seed)
            seconds = time.perf_counter() - begun
            row = {"scene": scene.name, "layout": scene.name.split("_")[0], "planner": name}
            row |= {"order_method": args.order, "seed": scene.seed}
            row |= {key: result[key] for key in SHOWN} | {"seconds": seconds} | more
            if name in OF_SHIPPED:
                row["shipped"] = shipped
            same = ("scene", "planner", "order_method")  # flown by another policy
            rows[:] = [old for old in rows if any(old[key] != row[key] for key in same)]
            rows.append(row)
            save(args.out, {"results": rows})
            time_flown = f"{row['mission_time']:.1f} s" if row["success"] else "no success"
            print(f"{scene.name}: {name}: {time_flown}, in {seconds:.0f} s", flush=True)


def summary(rows: list[Row]) -> list[str]:
    """Lines of a table: a row for each layout, order and planner."""
    lines = [
        "| layout | order | planner | success | contacts | ratio mean | worst "
        "| of detour time mean | worst | decision (ms) | seconds | worst |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
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
        cells.append(f"{statistics.median(row['seconds'] for row in mine):.0f}")
        cells.append(f"{max(row['seconds'] for row in mine):.0f}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main(args: Args) -> None:
    """Fly, save, print."""
    torch.set_num_threads(1)
    known = [*PROGRAMS, *PLANNERS]
    unknown = sorted(set(args.planners) - set(known))
    if unknown:
        raise SystemExit(f"--planners: {unknown[0]}: must be one of {', '.join(known)}")
    rows: list[Row] = []
    if args.out and args.out.is_file():
        rows = json.loads(args.out.read_text())["results"]
    missions(args, rows)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main(tyro.cli(Args))
