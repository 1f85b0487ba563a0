"""Flies segments that no policy was trained on or chosen by.

    python -m benchmarks.unseen --out docs/results/unseen.json

Flies `--segments` generated segments of each layout, 5 to 60 boxes, scaled by 0.3 to 1, from rest
at the segment's start and with no disturbance, by the policy and by the guidance law alone.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro

from benchmarks.common import Output, Row, grouped, in_processes, save, segment_course
from mjcollect.envs.recording import fly, fly_law
from mjcollect.generate import LAYOUTS
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.scene.bounds import detour_bound
from train.generalist import HELD_OUT

FIRST = HELD_OUT + 20_000  # no other benchmark flies these segments
MARK = 1.08  # median flight time over detour time that a policy should reach in every layout


@dataclass(frozen=True)
class Args(Output):
    """Flies segments never seen before."""

    policy: Path = SHIPPED
    """Policy that flies: shipped, or a file."""
    segments: int = 200
    """Number of segments of each layout."""
    workers: int = 2
    """Processes that fly side by side."""


def fly_segment(file: Path, job: tuple[str, int]) -> Row | None:
    """Returns a segment's flights by policy and law; None where the guidance finds no way."""
    layout, number = job
    course = segment_course(0, number, layout)
    if course is None:
        return None
    policy = TrainedPolicy.load(file)
    flights = {"policy": fly(course, [policy], policy.observation), "law": fly_law(course)}
    detour = detour_bound(course.scene, *course.nodes, course.guidance[0].length)
    row: Row = {"layout": layout, "segment": number, "detour_time": detour}
    for pilot, flight in flights.items():
        row[pilot] = {
            "success": flight.success,
            "contact": flight.contacts > 0,
            "time": flight.trajectory.duration if flight.success else None,
        }
    return row


def summary(rows: Sequence[Row]) -> list[Row]:
    """Returns arrivals, contacts, median and worst time over detour time, by layout and pilot."""
    found = []
    for (layout,), mine in grouped(rows, "layout").items():
        for pilot in ("policy", "law"):
            times = [
                row[pilot]["time"] / row["detour_time"] for row in mine if row[pilot]["success"]
            ]
            found.append(
                {
                    "layout": layout,
                    "pilot": pilot,
                    "segments": len(mine),
                    "arrived": len(times),
                    "contacts": sum(row[pilot]["contact"] for row in mine),
                    "median": float(np.median(times)) if times else None,
                    "mean": float(np.mean(times)) if times else None,
                    "worst": max(times, default=None),
                }
            )
    return found


def main(args: Args) -> int:
    """Flies, counts, saves; returns 1 if the policy misses 98% of arrivals or MARK in a layout."""
    jobs = [(name, FIRST + k) for name in LAYOUTS for k in range(args.segments)]
    work = partial(fly_segment, weights_file(args.policy))
    rows = [row for row in in_processes(work, jobs, args.workers) if row is not None]
    found, refused = summary(rows), len(jobs) - len(rows)
    content = {"policy": policy_digest(args.policy), "refused": refused}
    save(args.out, {**content, "summary": found, "segments": rows}, args)
    print(f"{refused} of {len(jobs)} segments refused: the guidance finds no way")
    for row in found:
        times = [f"{key} {row[key]:.4f}" for key in ("median", "mean", "worst") if row["arrived"]]
        print(
            f"{row['layout']:>9} {row['pilot']:>6}: {row['arrived']} of {row['segments']} arrive, "
            f"{row['contacts']} contacts, of detour time: {', '.join(times) or '-'}"
        )
    good = [
        row["arrived"] >= 0.98 * row["segments"] and row["arrived"] and row["median"] <= MARK
        for row in found
        if row["pilot"] == "policy"
    ]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
