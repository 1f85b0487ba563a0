"""Measures slots per second of batched simulations against the number of boxes in the scene.

    OMP_NUM_THREADS=1 python -m benchmarks.boxes --out docs/results/boxes.json

The scenes are towns: buildings on streets, with flights between them at a height of 20 m. `dense`
has all of them in one square kilometre; `wide` has a thousand to the square kilometre. All
simulations fly random actions from starts all around the way, and the scenes take turns, so that a
busy machine slows all of them alike.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import tyro

from benchmarks.common import Output, Row, measure_rates, median_ratio, print_table, save
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.scene.scene import Scene

KILOMETRE = 1000.0
WIDEST = 40.0  # A building has at most this side (m).
COLUMNS = (
    ("town", "{town}"),
    ("boxes", "{boxes:,}"),
    ("side (m)", "{side:.0f}"),
    ("slots per second", "{slots_per_second:,.0f}"),
    ("of the fewest", "{of_fewest:.2f}"),
    ("mj_step alone", "{raw_of_fewest:.2f}"),
    ("guidance (s)", "{guidance_seconds:.1f}"),
    ("memory (MiB)", "{memory_mib:.0f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Measures how fast simulations are among few and among many boxes."""

    boxes: tuple[int, ...] = (20, 100, 300, 1000, 3000)
    """Numbers of boxes."""
    count: int = 256
    """Number of simulations side by side."""
    rounds: int = 9
    """Number of rounds, in each of which all scenes have a turn."""
    slots: int = 12
    """Slots that each simulation flies in a turn."""


def town(count: int, side: float, seed: int = 0) -> Scene:
    """Returns a scene of `count` buildings in a square; depot and item are over crossings."""
    rng = np.random.default_rng(seed)
    blocks = int(np.ceil(np.sqrt(count + 20)))
    pitch = side / blocks
    cells = rng.permutation(blocks**2)[:count]
    middle = (np.stack([cells // blocks, cells % blocks], axis=1) + 0.5) * pitch
    half = rng.uniform(0.15, 0.32, (count, 2)) * min(pitch, WIDEST)
    height = rng.uniform(10.0, 60.0, (count, 1))
    floor = np.zeros((count, 1))
    boxes = np.stack(
        [np.hstack([middle - half, floor]), np.hstack([middle + half, height])], axis=1
    )
    start = blocks // 2
    ends = np.array([[start, start], [start + max(1, blocks // 10), start + max(1, blocks // 7)]])
    points = np.hstack([ends * pitch, np.full((2, 1), 20.0)])
    bounds = np.array([[0.0, 0.0, 0.0], [side, side, 150.0]])
    return Scene("town", seed, bounds, points[0], points[1:], boxes)


def flying(scene: Scene, args: Args) -> tuple[Simulations, Callable[[], int], float]:
    """Returns simulations in a scene, what flies them, and the seconds that guidance took."""
    begun = time.perf_counter()
    course = Course.segment(scene, (0,), 0)
    took = time.perf_counter() - begun
    sims = Simulations([course], args.count, start="spread", threads=1)
    sims.reset()
    rng = np.random.default_rng(0)

    def fly() -> int:
        for _ in range(args.slots):
            outcome = sims.step(rng.uniform(-1.0, 1.0, (args.count, 3)))
            sims.reset(np.flatnonzero(outcome.terminated | outcome.truncated))
            sims.observe()
        return args.slots * args.count

    return sims, fly, took


def rolling(sims: Simulations, slots: int) -> int:
    """Lets MuJoCo step alone from where the simulations are."""
    for _ in range(slots):
        sims.roll(np.zeros((sims.count, 3)))
    return slots * sims.count


def measure(args: Args) -> list[Row]:
    """Lets all scenes take turns; returns a row for each."""
    flying(town(args.boxes[0], KILOMETRE), args)[1]()  # compiles
    sides: dict[str, Callable[[int], float]] = {
        "dense": lambda count: KILOMETRE,
        "wide": lambda count: KILOMETRE * np.sqrt(count / 1000.0),
    }
    ways: dict[tuple[str, int, str], Callable[[], float]] = {}
    rows: list[Row] = []
    for kind, side in sides.items():
        for count in args.boxes:
            sims, fly, took = flying(town(count, side(count)), args)
            ways[kind, count, "flown"] = fly
            ways[kind, count, "raw"] = partial(rolling, sims, args.slots)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            rows.append({"town": kind, "boxes": count, "side": side(count)})
            rows[-1] |= {"guidance_seconds": took, "memory_mib": memory}
    rates = measure_rates(ways, args.rounds)
    for row in rows:
        kind, count, fewest = row["town"], row["boxes"], args.boxes[0]
        for way, key in (("flown", "of_fewest"), ("raw", "raw_of_fewest")):
            own, few = rates[kind, count, way], rates[kind, fewest, way]
            row[key] = median_ratio(own.per_cpu_second, few.per_cpu_second)
        row["slots_per_second"] = statistics.median(rates[kind, count, "flown"].per_second)
    return rows


def main(args: Args) -> None:
    """Measures, prints, saves."""
    rows = measure(args)
    print_table(rows, COLUMNS)
    save(args.out, {"results": rows}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
