"""Measures what another UAV in the same simulation costs: per UAV, against one UAV a simulation.

    OMP_NUM_THREADS=1 python -m benchmarks.fleet_simulation --out docs/results/fleet_simulation.json

The same number of UAVs flies in simulations of 1, 2, 4 and 8, which take turns. `physics` is MuJoCo
alone, with its search for contacts; `slot` a whole slot with rules, shield and observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro

from benchmarks.common import Output, Row, measure_rates, median_ratio, print_table, save
from mjcollect.envs.batch import Simulations
from mjcollect.fleet.episode import courses
from mjcollect.generate import generate
from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners.assignment import assign

COLUMNS = (
    ("UAVs in a simulation", "{uavs}"),
    ("simulations", "{simulations}"),
    ("UAV slots a second", "{per_second:.0f}"),
    ("cost of a slot per UAV over one", "{slot:.3f}"),
    ("cost of its physics", "{physics:.3f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Measures the cost of more UAVs in a simulation."""

    uavs: tuple[int, ...] = (1, 2, 4, 8)
    """Numbers of UAVs in a simulation; the first is the yardstick."""
    flights: int = 1024
    """Number of UAVs in all: 256 simulations of 4."""
    slots: int = 5
    """Slots in a round."""
    rounds: int = 15
    """Rounds in which the ways take turns."""


def work(sims: Simulations, slots: int, physics: bool) -> Callable[[], float]:
    """Returns what flies so many slots and returns the number of UAV slots."""
    rng = np.random.default_rng(0)
    action = rng.uniform(-0.3, 0.3, (sims.count, 3))

    def fly() -> float:
        sims.reset()
        for _ in range(slots):
            if physics:
                sims.roll(10.0 * action)
            else:
                sims.step(action)
                sims.observe()
        return sims.count * slots

    return fly


def main(args: Args) -> None:
    """Measures, prints, saves."""
    scene = generate(700_000, 24)
    cost, ways = travel_times(scene), {}
    for uavs in args.uavs:
        tours = assign(cost, uavs)
        sims = Simulations(courses(scene, tours), args.flights, threads=1, uavs=uavs)
        for physics in (False, True):
            ways[uavs, physics] = work(sims, args.slots, physics)
            ways[uavs, physics]()  # compiles
    rates = measure_rates(ways, args.rounds)

    def over_one(uavs: int, physics: bool) -> float:
        one, many = rates[args.uavs[0], physics], rates[uavs, physics]
        return median_ratio(one.per_cpu_second, many.per_cpu_second)

    rows: list[Row] = [
        {
            "uavs": uavs,
            "simulations": args.flights // uavs,
            "per_second": float(np.median(rates[uavs, False].per_second)),
            "slot": over_one(uavs, False),
            "physics": over_one(uavs, True),
        }
        for uavs in args.uavs
    ]
    print_table(rows, COLUMNS)
    save(args.out, {"results": rows}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
