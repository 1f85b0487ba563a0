"""Flies whole missions in disturbed air: how often everything comes home.

    python -m benchmarks.disturbed_missions --out docs/results/disturbed_missions.json

The scenes are generated, half of them floating and half of them cities, with K items in LKH's
order. Wind, gusts, gain, delay and noise are a share of the greatest of `benchmarks.robustness`;
each flight meets as many boxes, which move at the same share of 10 m/s across segments drawn at
random. Nothing is trained and nothing is tried again.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks.common import Output, Row, grouped, in_processes, print_table, save
from benchmarks.robustness import GREATEST
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import ENDS, by_policies, fly_batch
from mjcollect.envs.episode import Rules
from mjcollect.generate import LAYOUTS, generate
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.policy import DISTURBED, TrainedPolicy, policy_digest, weights_file
from mjcollect.scene.bounds import mission_bound
from mjcollect.scene.order import plan_order
from train.reproduction.tables import summary as mean_and_interval

FIRST = 3_000_000  # seeds of the scenes from here on
PILOTS = ("policy", "adaptive law")
COLUMNS = (
    ("pilot", "{pilot}"),
    ("missions", "{missions}"),
    ("flights", "{flights}"),
    ("home with everything", "{home:.1%}"),
    ("95%", "{low:.1%} to {high:.1%}"),
    ("standing box", "{standing box:.1%}"),
    ("moving box", "{moving box:.1%}"),
    ("out of bounds", "{out of bounds:.1%}"),
    ("too late", "{too late:.1%}"),
    ("time / lower bound", "{time:.3f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Flies whole missions in disturbed air."""

    scenes: int = 50
    """Number of scenes."""
    items: int = 8
    """Number K of items in each."""
    obstacles: int = 20
    """Number of boxes in each."""
    flights: int = 4
    """Flights of each mission, by each pilot."""
    share: float = 0.5
    """Share of the greatest disturbances."""
    policy: Path = DISTURBED
    """Policy that flies: disturbed, shipped, or a file."""
    workers: int = 2
    """Processes that fly side by side."""


def fly_mission(args: Args, number: int) -> list[Row]:
    """Returns how the flights of one mission ended; no rows where the guidance finds no way."""
    torch.set_num_threads(1)
    layout = LAYOUTS[number % len(LAYOUTS)]
    scene = generate(FIRST + number, args.items, args.obstacles, layout)
    order = plan_order(scene, "lkh")
    try:
        course = Course.mission(scene, order)
    except GuidanceError:
        return []
    policy = TrainedPolicy.load(weights_file(args.policy))
    bound, rows = mission_bound(scene)[0], []
    for pilot in PILOTS:
        if pilot == "policy":
            observation, fly_by = policy.observation, by_policies([policy])
        else:
            observation, fly_by = "guided", Simulations.law
        level = GREATEST.times(args.share)
        flown = fly_batch(
            course, fly_by, Rules(observation), level, args.flights, number, bar=False
        )
        times = [each.flight.trajectory.duration / bound for each in flown.flights
                 if each.ended == "home"]  # fmt: skip
        rows.append({"pilot": pilot, "scene": number, "layout": layout, **flown.ended,
                     "flights": args.flights, "times": times})  # fmt: skip
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """Returns the shares of the ends of all flights, with 95% intervals over the missions."""
    found = []
    for (pilot,), mine in grouped(rows, "pilot").items():
        ends = Counter[str]()
        for row in mine:
            ends.update({end: row[end] for end in ENDS})
        count = sum(row["flights"] for row in mine)
        home = mean_and_interval([row["home"] / row["flights"] for row in mine])
        times = [float(np.mean(row["times"])) for row in mine if row["times"]]
        found.append(
            {
                "pilot": pilot,
                "missions": len(mine),
                "flights": count,
                **{end: ends[end] / count for end in ENDS},
                "low": home["low"],
                "high": None if home["high"] is None else min(home["high"], 1.0),
                "time": float(np.mean(times)) if times else None,
            }
        )
    return found


def main(args: Args) -> None:
    """Flies, counts, prints, saves."""
    work = partial(fly_mission, args)
    rows = [row for found in in_processes(work, range(args.scenes), args.workers) for row in found]
    found = summary(rows)
    save(args.out, {"policy": policy_digest(args.policy), "summary": found, "missions": rows}, args)
    print_table(found, COLUMNS)


if __name__ == "__main__":
    main(tyro.cli(Args))
