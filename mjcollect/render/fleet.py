"""Holds the flights of a fleet for pictures: who collects what, in which colour, how far apart."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress, progress
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, SKY, YELLOW
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import SHIELD_FILE, Trajectory, load_shield

FLEET_FILE = "fleet.json"
# Okabe and Ito's eight colours, those that stand out from white and from the grey world first. A
# ninth UAV has the first one's colour again, and only its name tells them apart.
UAV_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY, BLACK, YELLOW)


UAV_SCALE = 8.0  # The quadrotor, 0.6 m wide in a scene of a kilometre, is enlarged so much,
UAV_WIDTH = 0.6  # unless two of them would touch in the picture.


class FlownPart(NamedTuple):
    """Holds what one UAV flew: its part of the scene, and (n, 2) seconds in which the shield acted.

    The part's items are numbered in the order of visit.
    """

    scene: Scene
    trajectory: Trajectory
    shielded: Array


@dataclass(frozen=True)
class FleetProgress:
    """Holds flights in one scene that all begin at t = 0: those of a fleet, or a single one.

    Nodes have the numbers of the whole scene. Where `reached` is asked for, it is the number of
    targets that each flight has reached, (M,).

    Attributes:
        scene: where they were flown, with all items.
        flights: the flight of each UAV that flew, M in all, in a scene whose depot is its place.
        shielded: of each flight (n, 2) seconds from begin to end of the times the shield acted.
        uavs: the numbers of these UAVs; none for a single flight that is no fleet's.
        asked: number of UAVs that there were, those without items too.
        makespan: s until the last one was home; None if not all flights were successes.
        lower_bound: s that no makespan can be less than; 0 if unknown.
        separation_limit: m that two UAVs' centres have to keep apart.
    """

    scene: Scene
    flights: tuple[Progress, ...]
    shielded: tuple[Array, ...]
    uavs: tuple[int, ...] = ()
    asked: int = 1
    makespan: float | None = None
    lower_bound: float = 0.0
    separation_limit: float = 0.0

    @classmethod
    def alone(cls, flown: Progress, shielded: Array | None = None) -> FleetProgress:
        """Returns a single flight, which is shown as one and not as a fleet of one UAV."""
        none = np.empty((0, 2)) if shielded is None else shielded
        return cls(flown.scene, (flown,), (none,))

    @property
    def is_alone(self) -> bool:
        """Returns whether this is a single flight that is no fleet's."""
        return not self.uavs

    @property
    def idle(self) -> tuple[int, ...]:
        """Returns the numbers of the UAVs that have no items and stay where they are."""
        return () if self.is_alone else tuple(sorted({*range(self.asked)} - {*self.uavs}))

    @property
    def uav_scale(self) -> float:
        """Returns by how much quadrotors are enlarged; two that keep apart never touch."""
        return min(UAV_SCALE, max(1.0, float(self.gaps.min()) / UAV_WIDTH))

    @cached_property
    def lead(self) -> int:
        """Returns the index 0..M-1 of the flight that takes longest, which is followed."""
        return int(np.argmax([flown.trajectory.duration for flown in self.flights]))

    @property
    def duration(self) -> float:
        """Returns the seconds until the last flight ends."""
        return self.flights[self.lead].trajectory.duration

    @property
    def complete(self) -> bool:
        """Returns whether every UAV reached all its targets."""
        return all(flown.complete for flown in self.flights)

    @property
    def arrivals(self) -> tuple[int, ...]:
        """Returns how many targets each flight reached in the end."""
        return tuple(len(flown.rows) for flown in self.flights)

    @property
    def title(self) -> str:
        """Returns how many UAVs fly for how many items: '3 UAVs, 8 items'."""
        flying, items = len(self.flights), len(self.scene.items)
        uavs = f"{flying} of {self.asked}" if self.idle else f"{flying}"
        return f"{uavs} UAV{'s' * (self.asked > 1)}, {items} item{'s' * (items > 1)}"

    def name(self, m: int) -> str:
        """Returns the name of the UAV of flight `m`."""
        return f"UAV {self.uavs[m]}"

    def colour(self, m: int) -> str:
        """Returns the colour of flight `m` as '#RRGGBB'."""
        return UAV_COLOURS[self.uavs[m] % len(UAV_COLOURS)]

    def collected(self, reached: Sequence[int]) -> int:
        """Returns how many items are collected by all of them."""
        flights = zip(self.flights, reached, strict=True)
        return sum(len(flown.collected(count)) for flown, count in flights)

    def target(self, reached: Sequence[int]) -> int | None:
        """Returns the node that the lead flies to; None if it has reached all."""
        flown, count = self.flights[self.lead], reached[self.lead]
        if count == len(flown.targets):
            return None
        node = flown.targets[count]
        return self.home(self.lead) if node == DEPOT else node

    def home(self, m: int) -> int:
        """Returns the depot of flight `m` as a node of the whole scene, -1 or below."""
        away = np.linalg.norm(self.scene.depots - self.flights[m].scene.depot, axis=1)
        return DEPOT - int(away.argmin())

    def state(self, node: int, reached: Sequence[int]) -> tuple[str, int | None]:
        """Returns what a node is, as `Progress.state` does, and the flight that it belongs to.

        The lead's depot is its own; an item that nobody collects, or another depot, is no flight's.
        """
        if node <= DEPOT:
            if node != self.home(self.lead):
                return "depot", None
            return self.flights[self.lead].state(DEPOT, reached[self.lead]), self.lead
        for m, (flown, count) in enumerate(zip(self.flights, reached, strict=True)):
            if node in flown.order:
                return flown.state(node, count), m
        return "item", None

    @cached_property
    def gaps(self) -> Array:
        """Returns the least distance (R,) in m between any two UAVs from each row to the next.

        There is a row for each of the lead's. UAVs fly straight between rows, and rest where their
        flight ended. It is inf if there is only one UAV.
        """
        rows = len(self.flights[self.lead].trajectory)
        least = np.full(rows, np.inf)
        at = [flown.trajectory.x for flown in self.flights]
        paths = [np.concatenate([x, np.tile(x[-1], (rows - len(x), 1))]) for x in at]
        for one, other in combinations(paths, 2):
            offset = other - one
            step = np.diff(offset, axis=0, append=offset[-1:])
            square = np.maximum(np.sum(step**2, axis=1), 1e-300)
            share = np.clip(-np.sum(offset * step, axis=1) / square, 0.0, 1.0)
            gap = np.linalg.norm(offset + share[:, None] * step, axis=1)
            least = np.minimum(least, gap)
        return least


def fleet_progress(
    scene: Scene, result: Mapping[str, Any], parts: Sequence[FlownPart]
) -> FleetProgress:
    """Finds the arrivals of a fleet's flights.

    Args:
        scene: the whole scene. result: the document of fleet.json.
        parts: what the UAVs flew, in the order of the result's `missions`.

    Raises:
        KeyError, TypeError, ValueError: the result is not as in fleet.json, nobody flew, or parts
            do not fit it.
    """
    if not parts:
        raise ValueError("missions: is empty: no UAV flew")
    flights = []
    for entry, (part, trajectory, _) in zip(result["missions"], parts, strict=True):
        order = tuple(int(item) for item in entry["items"])
        if not set(order) <= set(range(len(scene.items))):
            raise ValueError(f"items: {list(order)}: must lie in 0..{len(scene.items) - 1}")
        found = progress(part, trajectory, range(len(order)))
        own = replace(
            scene, depot=part.depot, return_tolerance=part.return_tolerance,
            more_depots=part.more_depots,
        )  # fmt: skip
        nodes = (DEPOT, *order, DEPOT)
        flights.append(replace(found, scene=own, order=order, nodes=nodes))
    return FleetProgress(
        scene,
        tuple(flights),
        tuple(np.reshape(part.shielded, (-1, 2)) for part in parts),
        uavs=tuple(int(entry["uav"]) for entry in result["missions"]),
        asked=int(result["uavs"]),
        makespan=result["makespan"],
        lower_bound=float(result["lower_bound"]),
        separation_limit=float(result["separation_limit"]),
    )


def load_fleet(folder: str | os.PathLike[str]) -> FleetProgress:
    """Reads the flights of a fleet's run folder: scene.json, fleet.json, and the UAVs' folders.

    Raises:
        OSError, SceneError, KeyError, TypeError, ValueError: the folder is not a readable run.
    """
    folder = Path(folder)
    result = json.loads((folder / FLEET_FILE).read_text(encoding="utf-8"))
    parts = []
    for entry in result["missions"]:
        own = folder / entry["folder"]
        parts.append(
            FlownPart(
                Scene.load(own / "scene.json"),
                Trajectory.load(own / "trajectory.csv"),
                load_shield(own / SHIELD_FILE),
            )
        )
    return fleet_progress(Scene.load(folder / "scene.json"), result, parts)
