"""What is flown: cells, each one flight, and what each is used for.

A cell is a scene, a visiting order, a planner and, for learned policies, a training seed. Methods
that give the same order share a cell, and so do scenes that differ only in their name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from mjcollect.generate import generate
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.reproduction.paper import RANDOM_ORDERS

Planner = Literal["policy", "mpc", "guidance", "reference"]
PLANNERS: tuple[Planner, ...] = get_args(Planner)
Part = Literal["scenarios", "sweep", "random"]
PARTS: tuple[Part, ...] = get_args(Part)
ABLATION = ("random", "lkh", "lkh-time")  # orders flown over the random scenes
Order = tuple[int, ...]


@dataclass(frozen=True)
class Sizes:
    """How much a reproduction flies.

    Attributes:
        training_seeds: how often each policy of scenarios 1 and 2 is trained; all others once.
        sweep: the numbers of items K along which mission time is shown.
        floating, city: how many random scenes of each layout there are.
        items: how many items each random scene has.
        first_scene: the seed of the first random scene of each layout.
        instances: how many random instances have their orders compared without a flight.
    """

    training_seeds: int = 3
    sweep: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    floating: int = 20
    city: int = 6
    items: int = 8
    first_scene: int = 7000
    instances: int = 20_000


@dataclass(frozen=True)
class Cell:
    """One flight that a reproduction makes.

    Attributes:
        scene: label of the scene in `Plan.scenes`.
        order: the items in order of visit.
        planner: what flies, one of `PLANNERS`.
        seed: seed of the training, 0 where nothing is trained.
    """

    scene: str
    order: Order
    planner: str
    seed: int

    @property
    def name(self) -> str:
        """The cell's name, unique within a plan, and the name of its folder."""
        trained = f"-seed{self.seed}" if self.planner == "policy" else ""
        return f"{self.scene}-{self.planner}-{'.'.join(map(str, self.order))}{trained}"


@dataclass(frozen=True)
class Use:
    """A place in a table that a cell fills.

    Attributes:
        part: which of `PARTS` the table belongs to.
        scene: the scene's label there, such as sweep_4.
        method: how the order was found: lkh, lkh-time, random or given.
        planner, seed: those of the cell.
        cell: the cell's name.
    """

    part: str
    scene: str
    method: str
    planner: str
    seed: int
    cell: str


@dataclass
class Plan:
    """Scenes by label, cells by name, and their uses in the order of the tables."""

    scenes: dict[str, Scene] = field(default_factory=dict)
    cells: dict[str, Cell] = field(default_factory=dict)
    uses: list[Use] = field(default_factory=list)

    def add_scene(self, label: str, scene: Scene) -> str:
        """Add a scene unless one is there that differs only in name and seed.

        Returns:
            The label that it is flown under.
        """
        for known, other in self.scenes.items():
            if replace(scene, name=other.name, seed=other.seed) == other:
                return known
        self.scenes[label] = scene
        return label

    def add(
        self, part: str, label: str, scene: Scene, methods: Mapping[str, Order],
        schemes: Sequence[tuple[str, str]], seeds: Sequence[int],
    ) -> None:  # fmt: skip
        """Add one use for each scheme (order method, planner) and, if it learns, training seed."""
        flown = self.add_scene(label, scene)
        for method, planner in schemes:
            if method not in methods:
                continue
            for seed in seeds if planner == "policy" else [0]:
                cell = Cell(flown, methods[method], planner, seed)
                self.cells.setdefault(cell.name, cell)
                self.uses.append(Use(part, label, method, planner, seed, cell.name))


def first_items(scene: Scene, count: int) -> Scene:
    """Return the same scene with its first `count` items only."""
    return replace(scene, name=f"{scene.name}_K{count}", items=np.array(scene.items[:count]))


def random_scenes(sizes: Sizes) -> dict[str, Scene]:
    """Return the generated scenes by label."""
    made = [
        generate(sizes.first_scene + number, sizes.items, layout=layout)
        for layout, count in (("floating", sizes.floating), ("city", sizes.city))
        for number in range(count)
    ]
    return {scene.slug: scene for scene in made}


def sweep_random_order(count: int) -> Order:
    """Return the order of the sweep without LKH: the look-alike's, cut to its first K items.

    At K = 4, where the sweep is scenario 2, it is that scenario's.
    """
    if count == 4:
        return RANDOM_ORDERS["scenario_2"]
    order = [item for item in RANDOM_ORDERS["sweep_8"] if item < count]
    if count < 3:  # one tour only; flown in its usual direction
        order.sort()
    return tuple(order)


def make_plan(sizes: Sizes, seed: int, time_orders: Mapping[str, Order]) -> Plan:
    """Return the plan of everything that the page shows.

    Args:
        sizes: how much is flown.
        seed: training seeds and random orders count up from it.
        time_orders: LKH's order at obstacle-aware cost by label of the random scenes; scenes that
            are missing go without.
    """
    plan = Plan()
    learnt = [(method, "policy") for method in ("lkh", "random")]
    peers = [("given", "mpc"), ("random", "mpc"), ("lkh", "mpc")]
    peers += [(method, name) for name in PLANNERS[2:] for method in ("random", "lkh")]
    seeds = range(seed, seed + sizes.training_seeds)
    for label in ("scenario_1", "scenario_2"):
        scene = Scene.find(label)
        orders = _orders(scene, RANDOM_ORDERS[label])
        plan.add("scenarios", label, scene, orders, [*learnt, *peers], seeds)
    whole = Scene.find("sweep_8")
    for count in sizes.sweep:
        scene = first_items(whole, count)
        orders = _orders(scene, sweep_random_order(count))
        plan.add("sweep", f"sweep_{count}", scene, orders, [*learnt, *peers], [seed])
    ablation = [(method, planner) for planner in PLANNERS for method in ABLATION]
    for label, scene in random_scenes(sizes).items():
        orders = _orders(scene, plan_order(scene, "random", seed=seed + scene.seed))
        if label in time_orders:
            orders["lkh-time"] = time_orders[label]
        plan.add("random", label, scene, orders, ablation, [seed])
    return plan


def _orders(scene: Scene, drawn: Order) -> dict[str, Order]:
    return {
        "lkh": plan_order(scene, "lkh"),
        "random": drawn,
        "given": tuple(range(len(scene.items))),
    }
