"""Learns the first blocked segment of generated scenes with default settings: success and time.

    python -m benchmarks.segments --floating 5 --city 5 --out docs/results/segments.json

Prints a table; one training run per scene and seed, one after another. Before each, the time to
success is taken: from the scene file, guidance included, to the first evaluation in which every
start arrives, on average within 1.05 of `detour_time`.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

import tyro

from benchmarks.common import Output, Row, print_table, save
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
KEPT = (
    "success", "time", "lower_bound", "detour_time", "law_time", "mpc_time", "success_rate",
    "best_mean_time", "last_mean_time", "last_success_rate", "shield_share", "train_seconds",
    "updates",
)  # fmt: skip
COLUMNS = (
    ("scene", "{scene}"),
    ("segment", "{segment}"),
    ("success", "{success}"),
    ("time (s)", "{time:.1f}"),
    ("of detour", "{ratio:.3f}"),
    ("rate", "{success_rate:.2f}"),
    ("trained (s)", "{train_seconds:.0f}"),
    ("to mark (s)", "{mark_seconds:.1f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Trains one segment in each of several scenes."""

    floating: int = 5
    """Number of generated scenes with floating boxes."""
    city: int = 5
    """Number of generated scenes with grounded boxes."""
    items: int = 6
    """Number of items in each scene."""
    first_seed: int = 1000
    """Seed from which each layout's seeds count up."""
    seed: int = 0
    """Seed of the training."""


def blocked_scenes(args: Args, layout: str) -> Iterator[Scene]:
    """Yields scenes with at least one blocked segment, in the order of their seeds."""
    for seed in count(args.first_seed):
        scene = generate(seed, args.items, layout=layout)
        if any(row["blocked"] for row in segments_table(scene, plan_order(scene, "lkh"))):
            yield scene


def to_mark(scene: Scene, seed: int) -> dict[str, float | None]:
    """Returns seconds and updates to success within MARK, None if it is never reached."""
    begun = time.perf_counter()
    order = plan_order(scene, "lkh")
    course = Course.segment(scene, order, first_blocked(scene, order))
    limit = MARK * detour_bound(scene, *course.nodes, course.guidance[0].length)
    trainer = segment_trainer(course, LearnConfig(), seed)
    try:
        for _ in trainer.run():
            last = trainer.rows[-1] if trainer.rows else {"eval_success_rate": 0.0}
            if last["eval_success_rate"] == 1.0 and last["eval_mean_time"] <= limit:
                seconds = time.perf_counter() - begun
                return {"mark_seconds": seconds, "mark_updates": last["update"]}
    finally:
        trainer.close()
    return {"mark_seconds": None, "mark_updates": None}


def learn(scene: Scene, seed: int) -> Row:
    """Learns the scene's first blocked segment by the program; returns what it reached."""
    mark = to_mark(scene, seed)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "scene.json", Path(folder) / "run"
        scene.save(path)
        train_segment(SegmentArgs(scene=str(path), out=out, seed=seed, video=False))
        result = json.loads((out / "segment.json").read_text())
    kept = {key: result[key] for key in KEPT}
    return kept | {"scene": scene.name, "segment": result["segment"]} | mark


def main(args: Args) -> None:
    """Trains, prints, saves."""
    results = [
        learn(scene, args.seed)
        for layout, wanted in (("floating", args.floating), ("city", args.city))
        for scene in islice(blocked_scenes(args, layout), wanted)
    ]
    won = [row for row in results if row["success"]]
    ratios = {row["scene"]: row["time"] / row["detour_time"] for row in won}
    print_table([row | {"ratio": ratios.get(row["scene"])} for row in results], COLUMNS)
    if ratios:
        print(
            f"\n{len(ratios)} of {len(results)} succeeded; time over detour time: median "
            f"{statistics.median(ratios.values()):.3f}, worst {max(ratios.values()):.3f}"
        )
    marks = [row["mark_seconds"] or float("inf") for row in results]
    print(
        f"seconds to success within {MARK} of detour time: "
        f"median {statistics.median(marks):.1f}, worst {max(marks):.1f}"
    )
    save(args.out, {"results": results}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
