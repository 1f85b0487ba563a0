"""Synthetic cells: a results document without a single flight, its times chosen by the test."""

from functools import cache

from mjcollect.scene.order import plan_order
from train.reproduction import orders
from train.reproduction.plan import Sizes, make_plan, random_scenes
from train.reproduction.tables import entry_of, spreads, tables

SIZES = Sizes(training_seeds=2, sweep=(1, 2, 4, 6, 8), floating=5, city=2, items=3, instances=300)
TOURS = [(0, 1, 2), (0, 2, 1), (1, 0, 2)]
# Another tour than LKH's, in the floating scenes only.
TIME_ORDERS = {
    label: next(tour for tour in TOURS if tour != plan_order(scene, "lkh"))
    for label, scene in random_scenes(SIZES).items()
    if label.startswith("floating")
}


@cache
def plan_of_all():
    return make_plan(SIZES, 0, TIME_ORDERS)


@cache
def computed():
    """What depends on no flight: spreads, study, and each cell's bounds."""
    plan = plan_of_all()
    best = {label: float(orders.all_bounds(scene)[0]) for label, scene in plan.scenes.items()}
    bounds = {name: (orders.order_bound(plan.scenes[cell.scene], cell.order), best[cell.scene])
              for name, cell in plan.cells.items()}  # fmt: skip
    return spreads(plan), orders.study(SIZES.instances, 0, 0.457), bounds


def mission(cell, factor, success=True):
    """A mission.json with what the tables read."""
    bound, best = computed()[2][cell.name]
    time = factor * bound
    learns = cell.planner == "policy"
    count = len(cell.order) + 1
    segments = [{"lower_bound": bound / count, "time": time / count,
                 "updates": 100 if learns else None}] * count  # fmt: skip
    return {
        "order": list(cell.order),
        "success": success,
        "mission_time": time if success else None,
        "lower_bound": best,
        "bound_method": "held-karp-exact",
        "ratio": time / best if success else None,
        "detour_time": bound,
        "contacts": 0 if success else 3,
        "violations": [] if success else [{"kind": "contact"}],
        "segments": segments,
        "train_seconds": 60.0 if learns else None,
        "versions": {},
    }


def synthetic(factor, success=lambda cell: True):
    """The document of a run whose flights take `factor(cell)` times the bound of their order."""
    plan = plan_of_all()
    cells = {}
    for name, cell in plan.cells.items():
        cells[name] = entry_of(cell, mission(cell, factor(cell), success(cell)))
    uses = [vars(use) for use in plan.uses]
    return {
        "sizes": {"items": SIZES.items},
        "uses": uses,
        "cells": cells,
        "spreads": computed()[0],
        "orders": computed()[1],
        "tables": tables(uses, cells),
    }
