"""Compares backup manoeuvres of the shield: which costs least time.

    python -m benchmarks.shield --out docs/results/shield.json

A command is allowed if a way to stop is left after it; which ways are tried decides how often the
shield acts. Each set of manoeuvres flies the same generated segments, by the same policy, in a
process of its own. Times are compared on the segments in which all of them arrive.
"""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import Output, save, segment_course
from mjcollect.envs.recording import Flight, fly
from mjcollect.generate import LAYOUTS
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from train.generalist import HELD_OUT
from train.jobs.processes import importing_pool

FIRST = HELD_OUT + 60_000  # no other benchmark flies these segments
# Slots for which a command is held before braking, shares of it beside full braking (1 is the
# command itself, which is not allowed by then, and stands for none), and at how many obstacles it
# is deflected.
MANOEUVRES: dict[str, tuple[tuple[int, ...], tuple[float, ...], int]] = {
    "full braking": ((0,), (1.0,), 0),
    "and partial braking": ((0,), (0.75, 0.5, 0.25), 0),
    "and the command held on, as round a corner": ((0, 2, 4, 8), (1.0,), 0),
    "both of these": ((0, 2, 4, 8), (0.75, 0.5, 0.25), 0),
    "and deflected at one obstacle": ((0, 2, 4, 8), (0.75, 0.5, 0.25), 1),
    "and at a second one (ours)": ((0, 2, 4, 8), (0.75, 0.5, 0.25), 2),
}


@dataclass(frozen=True)
class Args(Output):
    """Compares backup manoeuvres."""

    policy: Path = SHIPPED
    """Policy that flies: shipped, or a file."""
    segments: int = 60
    """Number of segments of each layout."""


def fly_segments(args: Args, name: str) -> list[Flight]:
    """Flies every segment by one set of manoeuvres, in a process that has not flown before."""
    # The module; the package's attribute of that name is the function.
    rule: Any = importlib.import_module("mjcollect.flight.shield")
    # The first flight compiles them into the code.
    rule.HELD, rule.BENT, rule.TIMES = MANOEUVRES[name]
    policy = TrainedPolicy.load(weights_file(args.policy))
    numbers = range(FIRST, FIRST + args.segments)
    courses = (segment_course(0, n, layout) for layout in LAYOUTS for n in numbers)
    return [fly(course, [policy], policy.observation) for course in courses if course is not None]


def fly_apart(args: Args, name: str) -> list[Flight]:
    """Flies in a process with a cache of its own, since its rule is compiled otherwise."""
    with tempfile.TemporaryDirectory() as cache, importing_pool(1) as pool:
        os.environ["NUMBA_CACHE_DIR"] = cache  # for the process, which starts at `submit`
        return pool.submit(fly_segments, args, name).result()


def main(args: Args) -> int:
    """Flies by every set of manoeuvres, compares, saves; returns 0."""
    flown = {name: fly_apart(args, name) for name in MANOEUVRES}
    all_arrive = [
        all(flight.success for flight in flights) for flights in zip(*flown.values(), strict=True)
    ]
    rows = []
    for name, flights in flown.items():
        times = [
            f.trajectory.duration for f, all_do in zip(flights, all_arrive, strict=True) if all_do
        ]
        slots = [bent for flight in flights for bent in flight.shielded]
        rows.append(
            {
                "manoeuvres": name,
                "segments": len(flights),
                "arrived": sum(flight.success for flight in flights),
                "contacts": sum(flight.contacts for flight in flights),
                "mean_time": float(np.mean(times)),
                "shield_share": sum(slots) / len(slots),
            }
        )
    compared = sum(all_arrive)
    found = {"policy": policy_digest(args.policy), "compared": compared, "rows": rows}
    save(args.out, found, args)
    for row in rows:
        print(
            f"{row['manoeuvres']:>44}: {row['arrived']} of {row['segments']} arrive, "
            f"{row['contacts']} contacts, {row['mean_time']:.2f} s where all do "
            f"({compared}), bent in {row['shield_share']:.2%} of slots"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
