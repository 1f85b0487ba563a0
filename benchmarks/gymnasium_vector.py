"""Times Gymnasium's environments: single, N single ones in its SyncVectorEnv, and ours of N.

    OMP_NUM_THREADS=1 python -m benchmarks.gymnasium_vector --out docs/results/gymnasium.json

One segment, flown by random actions from starts all over the way, with resets in the same step.
The ways take turns. `raw` is the same batched simulation without Gymnasium: `Simulations.step`,
`reset` and `observe`. The ratio is that of rates per CPU-second, over SyncVectorEnv with as many
flights. Needs `pip install .[gym]`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import numpy as np
import tyro

from benchmarks.common import Output, Row, measure_rates, median_ratio, print_table, save
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.scene.order import first_blocked, plan_order
from mjcollect.scene.scene import Scene

SINGLE, SYNC, VECTOR, RAW = "single", "SyncVectorEnv", "vector", "raw"
NAME = "mjcollect.gym:mjcollect/Segment-v0"
COLUMNS = (
    ("way", "{way}"),
    ("flights", "{flights}"),
    ("steps per CPU-second", "{per_cpu_second:.0f}"),
    ("steps per second", "{per_second:.0f}"),
    ("over SyncVectorEnv", "{over_sync:.1f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Times the environments of Gymnasium."""

    scene: str = "scenario_1"
    """Scene file, or the name of a bundled scene."""
    flights: tuple[int, ...] = (1, 16, 256)
    """Numbers of flights in the vector environments."""
    steps: int = 512
    """Steps of flights in a round, or one of each if there are more flights."""
    rounds: int = 15
    """Rounds in which the ways take turns."""


def working(way: str, course: Course, count: int, steps: int) -> Callable[[], float]:
    """Returns what flies about so many steps and returns their number."""
    actions = np.random.default_rng(0).uniform(-1, 1, (64, count, 3)).astype(np.float32)
    slots = max(1, steps // count)
    if way == RAW:
        sims = Simulations([course], count, start="spread", threads=1)
        sims.reset()

        def slot(k: int) -> None:
            outcome = sims.step(actions[k % 64].astype(np.float64))
            sims.observe()
            sims.reset(np.flatnonzero(outcome.terminated | outcome.truncated))

    elif way == SINGLE:
        one = gymnasium.make(NAME, course=course, start="spread")
        one.reset(seed=0)

        def slot(k: int) -> None:
            _, _, terminated, truncated, _ = one.step(actions[k % 64, 0])
            if terminated or truncated:
                one.reset()

    else:
        sync = way == SYNC
        same_step = gymnasium.vector.AutoresetMode.SAME_STEP
        env = gymnasium.make_vec(
            NAME,
            count,
            "sync" if sync else "vector_entry_point",
            {"autoreset_mode": same_step} if sync else {},
            course=course,
            start="spread",
            threads=1,
        )
        env.reset(seed=0)

        def slot(k: int) -> None:
            env.step(actions[k % 64])

    def work() -> float:
        for k in range(slots):
            slot(k)
        return slots * count

    return work


def main(args: Args) -> None:
    """Measures, prints, saves."""
    scene = Scene.find(args.scene)
    order = plan_order(scene, "lkh")
    course = Course.segment(scene, order, first_blocked(scene, order))
    ways = {(SINGLE, 1): working(SINGLE, course, 1, args.steps)}
    for count in args.flights:
        for way in (SYNC, VECTOR, RAW):
            ways[way, count] = working(way, course, count, args.steps)
    for work in ways.values():
        work()  # compiles
    rates = measure_rates(ways, args.rounds)
    rows: list[Row] = []
    for (way, count), rate in rates.items():
        sync = rates.get((SYNC, count))
        rows.append(
            {
                "way": way,
                "flights": count,
                "per_cpu_second": float(np.median(rate.per_cpu_second)),
                "per_second": float(np.median(rate.per_second)),
                "over_sync": None
                if sync is None
                else median_ratio(rate.per_cpu_second, sync.per_cpu_second),
            }
        )
    print_table(rows, COLUMNS)
    save(args.out, {"results": rows}, args, {"gymnasium": gymnasium.__version__})


if __name__ == "__main__":
    main(tyro.cli(Args))
