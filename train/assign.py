"""Shares a scene's items among several UAVs, so that the last one is home as early as possible.

    python -m train.assign --scene city_6 --uavs 2

It prints who collects what, in which order, and how long each takes along the shortest free paths.
Nothing is flown.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass

from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners.assignment import assign, makespan, tour_time
from mjcollect.planners.fleet_bound import fleet_bound
from mjcollect.scene.depots import depot_of
from mjcollect.scene.scene import Scene
from train.support.command_line import run_program
from train.support.markdown import markdown_table


@dataclass(frozen=True)
class Args:
    """Shares a scene's items among several UAVs that start from its depot, or its depots in turn.

    The times are estimates, along the shortest free paths among the boxes; UAVs do not get in each
    other's way. The bound holds for every flight, whatever it collects in which order.
    """

    scene: str
    """Names a scene file or a bundled scene."""
    uavs: int = 2
    """Sets the number of UAVs; some may stay at their depot."""
    seed: int = 0
    """Sets the seed of the search where there are more than 12 items."""
    json: bool = False
    """Prints JSON instead of a table."""


def main(argv: list[str] | None = None) -> int:
    """Runs the program and returns its exit code."""
    return run_program("train.assign", Args, share_items, argv)


def share_items(args: Args) -> int:
    """Shares, prints."""
    scene = Scene.find(args.scene)
    depots = len(scene.depots)
    cost = travel_times(scene, depots)
    tours = assign(cost, args.uavs, seed=args.seed, depots=depots)
    bound, method = fleet_bound(scene, args.uavs)
    last = makespan(cost, tours, depots)
    alone = makespan(cost, assign(cost, 1, depots=depots), depots)
    homes = [depot_of(uav, depots) for uav in range(args.uavs)]
    times = [tour_time(cost, tour, home, depots) for tour, home in zip(tours, homes, strict=True)]
    if args.json:
        document = {
            "scene": scene.name,
            "tours": tours,
            "depots": homes,
            "times": times,
            "makespan": last,
            "lower_bound": bound,
            "bound_method": method,
            "one_uav": alone,
        }
        print(json.dumps(document, indent=1))
        return 0
    rows = [
        [str(uav), " ".join(map(str, tour)) or "-", f"{time:.1f}"]
        for uav, (tour, time) in enumerate(zip(tours, times, strict=True))
    ]
    columns = ["UAV", "items in order", "time (s)"]
    if depots > 1:
        columns.append("depot")
        rows = [[*row, str(home)] for row, home in zip(rows, homes, strict=True)]
    print("\n".join(markdown_table(columns, rows)))
    print(
        f"\nThe last is home after {last:.1f} s, no flight earlier than {bound:.1f} s ({method})."
    )
    print(f"One UAV alone takes {alone:.1f} s.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
