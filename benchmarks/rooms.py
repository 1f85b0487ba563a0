"""Flies missions of a small drone in furnished rooms: policy, MPC and guidance law.

    python -m benchmarks.rooms --out docs/results/rooms.json

A room is 5 m wide and deep and 3 m high, with eight boxes half a metre or more apart, most of them
on the floor, and six items 0.2 m or more from them. Limits are those of `--vehicle crazyflie`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.common import Output, Row, grouped, print_table, save
from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight, fly, fly_law
from mjcollect.generate.place import VEHICLES
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import SHIPPED
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.support.mission_report import mission_result
from train.support.starting_policy import start_from

SIZE = np.array([5.0, 5.0, 3.0])  # metres
BOXES, BOX_GAP = 8, 0.5  # so many boxes at most, metres from one to the next
ITEMS, ITEM_GAP, APART = 6, 0.2, 0.5  # metres from boxes, and from one to the next
WALL = 0.15  # metres from the walls to an item
ON_FLOOR = 0.7  # share of the boxes
COLUMNS = (
    ("pilot", "{pilot}"),
    ("arrived", "{arrived} of {rooms}"),
    ("contacts", "{contacts}"),
    ("of detour time", "{mean:.3f}"),
    ("worst", "{worst:.3f}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Flies every pilot in every room."""

    rooms: int = 20
    """Number of rooms."""
    vehicle: str = "crazyflie"
    """Limits of the drone."""


def room(seed: int, vehicle: str) -> Scene:
    """Returns a furnished room."""
    rng = np.random.default_rng(seed)
    boxes: list[np.ndarray] = []
    for _ in range(2000):
        size = np.array([*rng.uniform(0.3, 1.0, 2), rng.uniform(0.4, 2.2)])
        low = rng.uniform(0.0, 1.0, 3) * (SIZE - size)
        low[2] *= rng.random() > ON_FLOOR
        box = np.stack([low, low + size])
        gaps = [np.maximum(np.maximum(box[0] - o[1], o[0] - box[1]), 0.0) for o in boxes]
        if all(np.linalg.norm(gap) >= BOX_GAP for gap in gaps):
            boxes.append(box)
        if len(boxes) == BOXES:
            break
    points: list[np.ndarray] = []
    while len(points) <= ITEMS:
        point = rng.uniform(WALL, SIZE - WALL)
        clear = point_box_distance(point, np.array(boxes)).min() >= ITEM_GAP
        if clear and all(np.linalg.norm(point - other) > APART for other in points):
            points.append(point)
    bounds = np.stack([np.zeros(3), SIZE])
    limits = VEHICLES[vehicle].limits
    return Scene(
        f"room_{seed}", seed, bounds, points[0], np.array(points[1:]), np.array(boxes), **limits
    )


@cache
def _shipped() -> Callable[[Course], Flight]:
    policy, _ = start_from(SHIPPED, LearnConfig())
    return lambda course: fly(course, [policy] * len(course.guidance), policy.observation)


PILOTS: dict[str, Callable[[Course], Flight]] = {
    "policy": lambda course: _shipped()(course),
    "mpc": lambda course: fly_planner(course, Mpc(course)),
    "guidance law": fly_law,
}


def measure(args: Args) -> list[Row]:
    """Flies all pilots in all rooms; returns a row for each flight."""
    rows: list[Row] = []
    for seed in tqdm(range(args.rooms)):
        scene = room(seed, args.vehicle)
        order = plan_order(scene, "lkh")
        course = Course.mission(scene, order)
        for pilot, flown in PILOTS.items():
            begun = time.perf_counter()
            flight = flown(course)
            seconds = time.perf_counter() - begun
            found = mission_result(course, order, "lkh", flight, [None] * (len(order) + 1), seed)
            keys = ("success", "contacts", "mission_time", "detour_time")
            rows.append({"room": seed, "pilot": pilot, "seconds": seconds})
            rows[-1] |= {key: found[key] for key in keys}
    return rows


def summary(rows: list[Row]) -> list[Row]:
    """Returns a row for each pilot; times are over the flights that arrived."""
    table = []
    for (pilot,), mine in grouped(rows, "pilot").items():
        won = [row["mission_time"] / row["detour_time"] for row in mine if row["success"]]
        entry = {"pilot": pilot, "arrived": len(won), "rooms": len(mine)}
        entry |= {"contacts": sum(row["contacts"] for row in mine)}
        table.append(entry | {"mean": statistics.mean(won), "worst": max(won)})
    return table


def main(args: Args) -> None:
    """Flies, prints, saves."""
    torch.set_num_threads(1)
    rows = measure(args)
    table = summary(rows)
    print_table(table, COLUMNS)
    save(args.out, {"results": rows, "summary": table}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
