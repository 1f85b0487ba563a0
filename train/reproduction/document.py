"""results.json: everything that was flown and counted, from which the page is written."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mjcollect.scene.scene import Scene
from train.reproduction import orders
from train.reproduction.claims import claims
from train.reproduction.paper import DDPG, LKH_DDPG, RANDOM_ORDERS, SCENARIOS, SWEEP, saving
from train.reproduction.plan import Plan, Sizes
from train.reproduction.running import result_of
from train.reproduction.tables import entry_of, tables
from train.support.run_folder import versions


def machine() -> dict[str, Any]:
    """What the flights ran on, as far as results could depend on it."""
    model = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        names = [line.split(":", 1)[1] for line in lines if line.startswith("model name")]
        model = names[0].strip() if names else ""
    return {
        "cpus": os.cpu_count(),
        "processor": model or platform.machine(),
        "system": platform.system(),
    }


def collect(out: Path, plan: Plan) -> dict[str, dict[str, Any]]:
    """Entries of the cells that are flown, by name, in the plan's order."""
    found = {}
    for name, cell in plan.cells.items():
        result = result_of(out, cell)
        if result is not None:
            found[name] = entry_of(cell, result)
    return found


def cell_versions(out: Path, plan: Plan) -> list[dict[str, str]]:
    """The different sets of package versions that cells were flown with; one, if all is well."""
    found: list[dict[str, str]] = []
    for cell in plan.cells.values():
        result = result_of(out, cell)
        if result is not None and result["versions"] not in found:
            found.append(result["versions"])
    return found


def spreads(plan: Plan) -> dict[str, dict[str, float]]:
    """How the bounds of all orders of the bundled scenes are spread, by label.

    `share_as_long`: share of all orders whose bound is at least that of the random order flown.
    """
    found: dict[str, dict[str, float]] = {}
    labels = dict.fromkeys(use.scene for use in plan.uses if use.part in ("scenarios", "sweep"))
    for use in plan.uses:
        if use.scene not in labels or use.scene in found or use.method != "random":
            continue
        cell = plan.cells[use.cell]
        scene = plan.scenes[cell.scene]
        share = orders.share_as_long(scene, cell.order)
        found[use.scene] = {**orders.spread(scene), "share_as_long": share}
    return found


def _describe(scene: Scene) -> dict[str, Any]:
    return {"name": scene.name, "seed": scene.seed, "items": len(scene.items),
            "obstacles": len(scene.obstacles)}  # fmt: skip


def document(
    out: Path, plan: Plan, sizes: Sizes, errors: Mapping[str, str], about: Mapping[str, Any]
) -> dict[str, Any]:
    """Everything as one JSON document.

    Args:
        errors: by cell, what went wrong. about: entries on how the program was called.
    """
    cells = collect(out, plan)
    uses = [asdict(use) for use in plan.uses]
    sweep_saving = saving(SWEEP[LKH_DDPG][8][0], SWEEP[DDPG][8][0])
    found = {
        "program": "train.reproduce",
        **about,
        "sizes": {**asdict(sizes), "sweep": list(sizes.sweep)},
        "versions": versions(),
        "cell_versions": cell_versions(out, plan),
        "paper": {
            "scenarios": {scene: {"-".join(which): time for which, time in times.items()}
                          for scene, times in SCENARIOS.items()},
            "sweep": {"-".join(which): {str(k): list(span) for k, span in times.items()}
                      for which, times in SWEEP.items()},
            "random_orders": {scene: list(order) for scene, order in RANDOM_ORDERS.items()},
        },
        "scenes": {label: _describe(scene) for label, scene in plan.scenes.items()},
        "uses": uses,
        "cells": cells,
        "not_flown": [name for name in plan.cells if name not in cells],
        "errors": dict(errors),
        "spreads": spreads(plan),
        "orders": orders.study(sizes.instances, about["seed"], sweep_saving),
        "tables": tables(uses, cells),
    }  # fmt: skip
    return {**found, "claims": claims(found)}
