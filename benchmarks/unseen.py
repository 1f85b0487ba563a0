"""Segments that no policy was trained on or chosen by, flown at once.

    python -m benchmarks.unseen --out docs/results/unseen.json

Flies `--segments` generated segments of each layout, 5 to 60 boxes, scaled by 0.3 to 1, from rest
at the segment's start and with no disturbance, by the policy and by the guidance law alone.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.results import save
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.generate import LAYOUTS
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.scene.bounds import detour_bound
from train.generalist import HELD_OUT
from train.jobs.processes import importing_pool
from train.jobs.segment_pool import draw_segment

FIRST = HELD_OUT + 20_000
MARK = 1.08  # of detour time


@dataclass(frozen=True)
class Args:
    """Fly segments never seen before."""

    policy: Path = SHIPPED
    """The policy's file."""
    segments: int = 200
    """Segments of each layout."""
    seed: int = 0
    """Seed of the scenes; that of the policy's training, whose scenes have other numbers."""
    workers: int = 2
    """Processes."""
    out: Path | None = None
    """JSON file for the results."""


def fly(course: Course, policy: TrainedPolicy | None) -> tuple[bool, bool, float]:
    """Success, contact and seconds of a flight from rest at the start; by the law if None."""
    sims = Simulations([course], 1, rules=Rules(policy.observation if policy else "guided"))
    sims.place(np.array([0]), *course.starts("point", 1, np.random.default_rng(0)))
    slots, success, contact, ended = 0, False, False, False
    while not ended:
        if policy is None:
            action = sims.episodes.guidance_action()
        else:
            action = policy(sims.observe().astype(np.float32))
        outcome = sims.step(action)
        slots += 1
        success, contact = bool(outcome.success[0]), bool(outcome.slot.contact[0])
        ended = bool(outcome.terminated[0] | outcome.truncated[0])
    sims.close()
    return success, contact, slots * course.scene.slot


def segment(file: Path, seed: int, job: tuple[str, int]) -> dict[str, Any] | None:
    """A segment flown by both; None where the guidance finds no way."""
    torch.set_num_threads(1)
    layout, number = job
    leg = draw_segment(seed, number, layout)
    with tempfile.TemporaryDirectory() as nowhere:
        try:
            course = leg.course(Path(nowhere))
        except GuidanceError:
            return None
    detour = detour_bound(course.scene, *course.nodes, course.guidance[0].length)
    row: dict[str, Any] = {"layout": layout, "segment": number, "detour_time": detour}
    for name, policy in (("policy", TrainedPolicy.load(file)), ("law", None)):
        success, contact, seconds = fly(course, policy)
        row[name] = {"success": success, "contact": contact, "time": seconds if success else None}
    return row


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """By layout and pilot: arrivals, contacts, median and worst time over detour time."""
    found = []
    for layout in dict.fromkeys(row["layout"] for row in rows):
        for pilot in ("policy", "law"):
            mine = [row for row in rows if row["layout"] == layout]
            won = [row for row in mine if row[pilot]["success"]]
            times = [row[pilot]["time"] / row["detour_time"] for row in won]
            found.append(
                {
                    "layout": layout, "pilot": pilot, "segments": len(mine), "arrived": len(times),
                    "contacts": sum(row[pilot]["contact"] for row in mine),
                }
                | {
                    name: float(of(times)) if times else None
                    for name, of in (("median", np.median), ("mean", np.mean), ("worst", np.max))
                }
            )  # fmt: skip
    return found


def main(args: Args) -> int:
    """Fly, count, save; 1 if a layout misses the mark of 98% and 1.08 of detour time."""
    jobs = [(name, FIRST + k) for name in LAYOUTS for k in range(args.segments)]
    with importing_pool(args.workers) as pool:
        flown = pool.map(partial(segment, weights_file(args.policy), args.seed), jobs)
        rows = [row for row in tqdm(flown, total=len(jobs)) if row is not None]
    found = summary(rows)
    save(
        args.out,
        {"policy": policy_digest(args.policy), "refused": len(jobs) - len(rows), "summary": found,
         "segments": rows},
        arguments=json.loads(json.dumps(asdict(args), default=str)),
    )  # fmt: skip
    print(f"{len(jobs) - len(rows)} of {len(jobs)} segments refused: the guidance finds no way")
    for row in found:
        times = [f"{key} {row[key]:.4f}" for key in ("median", "mean", "worst") if row["arrived"]]
        print(
            f"{row['layout']:>9} {row['pilot']:>6}: {row['arrived']} of {row['segments']} arrive, "
            f"{row['contacts']} contacts, of detour time: {', '.join(times) or '-'}"
        )
    mine = [row for row in found if row["pilot"] == "policy"]
    arrive = all(row["arrived"] >= 0.98 * row["segments"] > 0 for row in mine)
    good = arrive and all(row["median"] <= MARK for row in mine)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
