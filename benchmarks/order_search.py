"""Orders items by the free local search, against the best order (few items) or LKH's (many).

    OMP_NUM_THREADS=1 python -m benchmarks.order_search --out docs/results/local_search.json

Scenes are generated, in turn floating and city; the cost is the least time round the boxes.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.common import Output, Row, grouped, print_table, save
from mjcollect.generate import LAYOUTS, generate
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.travel_times import travel_times
from mjcollect.scene.shortest_tour import (
    ITERATIONS,
    MAX_EXACT,
    held_karp,
    lkh_order,
    search_order,
)

SIZES = (8, 12, 24, 50, 100)
COLUMNS = (
    ("items", "{items}"),
    ("against", "{against}"),
    ("iterations per item", "{iterations}"),
    ("scenes", "{scenes}"),
    ("search over it, mean", "{mean:.4f}"),
    ("worst", "{worst:.4f}"),
    ("as short or shorter", "{as_short}"),
    ("CPU-seconds of the search", "{seconds:.2f}"),
    ("of the other", "{other_seconds:.2f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Measures how short the tours of the local search are."""

    scenes: int = 20
    """Number of scenes of each size."""
    iterations: tuple[int, ...] = (ITERATIONS // 4, ITERATIONS)
    """Iterations for each item, after which the search ends."""


def tour_cost(cost: Array, order: list[int]) -> float:
    """Returns the cost of a closed tour from the depot, node 0, through items."""
    nodes = np.array([0, *(item + 1 for item in order), 0])
    return float(cost[nodes[:-1], nodes[1:]].sum())


def exact_order(cost: Array) -> list[int]:
    """Returns the best order."""
    return list(held_karp(cost)[1])


def timed(solve: Callable[[], list[int]]) -> tuple[list[int], float]:
    """Returns an order, and the CPU-seconds that it took."""
    begun = time.process_time()
    order = solve()
    return order, time.process_time() - begun


def measure(args: Args) -> list[Row]:
    """Returns a row for each scene and number of iterations."""
    rows = []
    search_order(np.ones((4, 4)))  # imports PyVRP
    for items in SIZES:
        for seed in tqdm(range(args.scenes), desc=f"{items} items"):
            layout = LAYOUTS[seed % len(LAYOUTS)]
            cost = travel_times(generate(seed, items, layout=layout))
            exact = items <= MAX_EXACT
            other, other_seconds = timed(partial(exact_order if exact else lkh_order, cost))
            for iterations in args.iterations:
                found, seconds = timed(partial(search_order, cost, iterations=iterations))
                row: Row = {"items": items, "layout": layout, "seed": seed}
                row |= {"against": "exact" if exact else "lkh", "iterations": iterations}
                row |= {"search": tour_cost(cost, found), "other": tour_cost(cost, other)}
                rows.append(row | {"seconds": seconds, "other_seconds": other_seconds})
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """Returns a row for each size and number of iterations."""
    table = []
    for (items, iterations), mine in grouped(rows, "items", "iterations").items():
        ratios = [row["search"] / row["other"] for row in mine]
        entry: Row = {"items": items, "against": mine[0]["against"], "iterations": iterations}
        entry |= {"scenes": len(mine), "mean": statistics.mean(ratios), "worst": max(ratios)}
        entry["as_short"] = sum(ratio <= 1 + 1e-6 for ratio in ratios)
        for key in ("seconds", "other_seconds"):
            entry[key] = statistics.mean(row[key] for row in mine)
        table.append(entry)
    return table


def main(args: Args) -> None:
    """Measures, prints, saves."""
    rows = measure(args)
    table = summary(rows)
    print_table(table, COLUMNS)
    save(args.out, {"results": rows, "summary": table}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
