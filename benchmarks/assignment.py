"""Shares items among UAVs: the search against all sharings, its time, and the lower bound.

    OMP_NUM_THREADS=1 python -m benchmarks.assignment --out docs/results/assignment.json

Scenes are generated floating ones, costs the least times of straight legs, without their boxes.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

import tyro
from tqdm import tqdm

from benchmarks.common import Output, Row, grouped, print_table, save
from mjcollect.generate import generate
from mjcollect.planners.assignment import assign, exact_assignment, makespan, search_assignment
from mjcollect.planners.fleet_bound import fleet_bound
from mjcollect.scene.bounds import leg_bounds
from mjcollect.scene.shortest_tour import MAX_EXACT

COLUMNS = (
    ("items", "{items}"),
    ("UAVs", "{uavs}"),
    ("scenes", "{scenes}"),
    ("search over exact, worst", "{of_exact}"),
    ("makespan over bound, mean", "{of_bound:.3f}"),
    ("worst", "{of_bound_worst:.3f}"),
    ("speed-up", "{speed_up:.2f}"),
    ("seconds", "{seconds:.2f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Measures how well and how fast items are shared."""

    small: int = 100
    """Number of scenes of each size that allows all sharings to be tried."""
    large: int = 10
    """Number of scenes of each larger size."""


def measure(args: Args) -> list[Row]:
    """Returns a row for each scene."""
    sizes = [(8, 2, args.small), (10, 3, args.small), (24, 3, args.large), (50, 4, args.large)]
    rows = []
    for items, uavs, scenes in sizes:
        for seed in tqdm(range(scenes), desc=f"{items} items, {uavs} UAVs"):
            scene = generate(seed, items, layout="floating")
            cost = leg_bounds(scene)
            cost = (cost + cost.T) / 2
            begun = time.perf_counter()
            found = makespan(cost, search_assignment(cost, uavs))
            seconds = time.perf_counter() - begun
            alone = makespan(cost, assign(cost, 1))
            row: Row = {"items": items, "uavs": uavs, "seed": seed, "makespan": found}
            row |= {"seconds": seconds, "alone": alone, "bound": fleet_bound(scene, uavs)[0]}
            row["exact"] = None
            if items <= MAX_EXACT:
                row["exact"] = makespan(cost, exact_assignment(cost, uavs))
            rows.append(row)
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """Returns a row for each size."""
    table = []
    for (items, uavs), mine in grouped(rows, "items", "uavs").items():
        exact = [row["makespan"] / row["exact"] for row in mine if row["exact"] is not None]
        bound = [row["makespan"] / row["bound"] for row in mine]
        entry: Row = {"items": items, "uavs": uavs, "scenes": len(mine)}
        entry["of_exact"] = f"{max(exact):.4f}" if exact else "-"
        entry |= {"of_bound": statistics.mean(bound), "of_bound_worst": max(bound)}
        entry["speed_up"] = statistics.mean(row["alone"] / row["makespan"] for row in mine)
        table.append(entry | {"seconds": max(row["seconds"] for row in mine)})
    return table


def main(args: Args) -> None:
    """Measures, prints, saves."""
    rows = measure(args)
    table = summary(rows)
    print_table(table, COLUMNS)
    save(args.out, {"results": rows, "summary": table}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
