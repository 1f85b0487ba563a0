"""Learns the first blocked segment of generated scenes with default settings: success and time.

    python -m benchmarks.segments --floating 5 --city 5 --out docs/results/segments.json

Prints a table; one training run per scene and seed, one after another. Before each, the time to
success is taken: from the scene file, guidance included, to the first evaluation in which every
start arrives, on average within 1.05 of `detour_time`.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.results import save
from mjcollect.envs.course import Course
from mjcollect.generate import generate
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.trainer import segment_trainer
from mjcollect.scene.bounds import detour_bound
from mjcollect.scene.order import first_blocked, plan_order, segments_table
from mjcollect.scene.scene import Scene
from train.segment import Args as SegmentArgs
from train.segment import train_segment

MARK = 1.05  # of detour_time
SHOWN = (
    "time", "lower_bound", "detour_time", "law_time", "mpc_time", "success_rate", "best_mean_time",
    "last_mean_time", "last_success_rate", "shield_share", "train_seconds", "updates",
)  # fmt: skip


@dataclass(frozen=True)
class Args:
    """Train one segment in each of several scenes."""

    floating: int = 5
    """Generated scenes of floating boxes."""
    city: int = 5
    """Generated scenes of grounded boxes."""
    items: int = 6
    """Items in each."""
    first_seed: int = 1000
    """Scene seeds count up from here."""
    seed: int = 0
    """Seed of the training."""
    out: Path | None = None
    """JSON file for the results."""


def scenes(args: Args) -> list[Scene]:
    """Scenes with at least one blocked segment, seeds counting up."""
    found: list[Scene] = []
    for layout, wanted in (("floating", args.floating), ("city", args.city)):
        seed, have = args.first_seed, 0
        while have < wanted:
            scene = generate(seed, args.items, layout=layout)
            seed += 1
            if any(row["blocked"] for row in segments_table(scene, plan_order(scene, "lkh"))):
                found.append(scene)
                have += 1
    return found


def to_mark(scene: Scene, seed: int) -> dict[str, float | None]:
    """Seconds and updates to success within MARK, none if it is never reached."""
    begun = time.perf_counter()
    order = plan_order(scene, "lkh")
    course = Course.segment(scene, order, first_blocked(scene, order))
    limit = MARK * detour_bound(scene, *course.nodes, course.guidance[0].length)
    trainer = segment_trainer(course, LearnConfig(), seed)
    found: dict[str, float | None] = {"mark_seconds": None, "mark_updates": None}
    for _ in trainer.run():
        if not trainer.rows:  # not evaluated yet
            continue
        last = trainer.rows[-1]
        if last["eval_success_rate"] == 1.0 and last["eval_mean_time"] <= limit:
            seconds = time.perf_counter() - begun
            found = {"mark_seconds": seconds, "mark_updates": last["update"]}
            break
    trainer.close()
    return found


def main(args: Args) -> None:
    """Train, print, save."""
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for number, scene in enumerate(scenes(args)):
            path, out = Path(folder) / f"{number}.json", Path(folder) / f"run{number}"
            scene.save(path)
            mark = to_mark(scene, args.seed)
            train_segment(SegmentArgs(scene=str(path), out=out, seed=args.seed, video=False))
            result = json.loads((out / "segment.json").read_text())
            results.append({"success": result["success"]} | {k: result[k] for k in SHOWN})
            results[-1] |= {"scene": scene.name, "segment": first_blocked(scene, result["order"])}
            results[-1] |= mark
    print("| scene | segment | success | time (s) | of detour | rate | trained (s) | to mark (s) |")
    print("|---|---|---|---|---|---|---|---|")
    ratios = []
    for row in results:
        ratio = row["time"] / row["detour_time"] if row["success"] else float("nan")
        ratios += [ratio] if row["success"] else []
        flown = f"{row['time']:.1f}" if row["success"] else "-"
        mark = "-" if row["mark_seconds"] is None else f"{row['mark_seconds']:.1f}"
        print(
            f"| {row['scene']} | {row['segment']} | {row['success']} | {flown} | {ratio:.3f} "
            f"| {row['success_rate']:.2f} | {row['train_seconds']:.0f} | {mark} |"
        )
    if ratios:
        print(f"\n{len(ratios)} of {len(results)} succeeded; time over detour time: median "
              f"{statistics.median(ratios):.3f}, worst {max(ratios):.3f}")  # fmt: skip
    marks = [row["mark_seconds"] or float("inf") for row in results]
    print(f"seconds to success within {MARK} of detour time: "
          f"median {statistics.median(marks):.1f}, worst {max(marks):.1f}")  # fmt: skip
    save(args.out, {"results": results}, arguments=dataclasses.asdict(args))


if __name__ == "__main__":
    main(tyro.cli(Args))
