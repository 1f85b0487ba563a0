"""Makes results.json: everything that was flown and counted, from which the page is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mjcollect.scene.scene import Scene
from train.reproduction import orders
from train.reproduction.paper import SWEEP_SAVING
from train.reproduction.plan import Plan, Sizes
from train.reproduction.running import result_of
from train.reproduction.tables import entry_of, tables
from train.support.run_folder import versions


def spreads(plan: Plan) -> dict[str, dict[str, float]]:
    """Return how the bounds of all orders of the bundled scenes are spread, by label."""
    flown = {use.scene: plan.cells[use.cell] for use in plan.uses
             if use.part != "random" and use.method == "random"}  # fmt: skip
    return {label: orders.spread(plan.scenes[cell.scene], cell.order)
            for label, cell in flown.items()}  # fmt: skip


def _describe(scene: Scene) -> dict[str, Any]:
    return {"name": scene.name, "seed": scene.seed, "items": len(scene.items),
            "obstacles": len(scene.obstacles)}  # fmt: skip


def document(
    out: Path, plan: Plan, sizes: Sizes, errors: Mapping[str, str], about: Mapping[str, Any]
) -> dict[str, Any]:
    """Return everything as one JSON document.

    Args:
        out: folder of the flown cells.
        plan, sizes: what was to be flown.
        errors: what went wrong, by cell.
        about: entries on how the program was called.
    """
    found = {name: result_of(out, cell) for name, cell in plan.cells.items()}
    results = {name: result for name, result in found.items() if result is not None}
    cells = {name: entry_of(plan.cells[name], result) for name, result in results.items()}
    flown_with = {str(result["versions"]): result["versions"] for result in results.values()}
    uses = [asdict(use) for use in plan.uses]
    return {
        "program": "train.reproduce",
        **about,
        "sizes": {**asdict(sizes), "sweep": list(sizes.sweep)},
        "versions": versions(),
        "cell_versions": list(flown_with.values()),  # one, if all is well
        "scenes": {label: _describe(scene) for label, scene in plan.scenes.items()},
        "uses": uses,
        "cells": cells,
        "not_flown": [name for name in plan.cells if name not in cells],
        "errors": dict(errors),
        "spreads": spreads(plan),
        "orders": orders.study(sizes.instances, about["seed"], SWEEP_SAVING),
        "tables": tables(uses, cells),
    }
