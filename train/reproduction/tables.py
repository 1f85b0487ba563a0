"""Makes results.json, tables of plain numbers from flown cells, and text of means and shares.

Rows come as `uses` (dictionaries of `train.reproduction.plan.Use`) and `cells` (name -> entry of
`entry_of`). A cell that is not flown is missing from `cells`; a flight without success has no time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from scipy.stats import binomtest, t

from train.reproduction import orders
from train.reproduction.paper import SWEEP_SAVING, Scheme, reported
from train.reproduction.plan import ABLATION, PLANNERS, Cell, Plan, Sizes
from train.reproduction.running import result_of
from train.support.run_folder import versions

Row = dict[str, Any]
CONFIDENCE = 0.95
COPIED = (
    "success", "mission_time", "lower_bound", "bound_method", "ratio", "detour_time", "contacts",
    "train_seconds",
)  # fmt: skip


def document(
    out: Path, plan: Plan, sizes: Sizes, errors: Mapping[str, str], about: Mapping[str, Any]
) -> Row:
    """Return everything that was flown and counted, from which the page is written.

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
        "scenes": {
            label: {"name": scene.name, "seed": scene.seed, "items": len(scene.items),
                    "obstacles": len(scene.obstacles)}
            for label, scene in plan.scenes.items()
        },
        "uses": uses,
        "cells": cells,
        "not_flown": [name for name in plan.cells if name not in cells],
        "errors": dict(errors),
        "spreads": spreads(plan),
        "orders": orders.study(sizes.instances, about["seed"], SWEEP_SAVING),
        "tables": tables(uses, cells),
    }  # fmt: skip


def spreads(plan: Plan) -> dict[str, dict[str, float]]:
    """Return how the bounds of all orders of the bundled scenes are spread, by label."""
    flown = {use.scene: plan.cells[use.cell] for use in plan.uses
             if use.part != "random" and use.method == "random"}  # fmt: skip
    return {label: orders.spread(plan.scenes[cell.scene], cell.order)
            for label, cell in flown.items()}  # fmt: skip


def entry_of(cell: Cell, result: Mapping[str, Any]) -> Row:
    """Return what the tables and readers need of a cell's mission.json."""
    segments = result["segments"]
    updates = [segment["updates"] for segment in segments]
    return {
        "scene": cell.scene,
        "order": list(cell.order),
        "planner": cell.planner,
        "seed": cell.seed,
        **{key: result[key] for key in COPIED},
        "order_bound": sum(segment["lower_bound"] for segment in segments),
        "violations": sorted({violation["kind"] for violation in result["violations"]}),
        "segment_times": [segment["time"] for segment in segments],
        "updates": sum(updates) if None not in updates else None,
    }


def summary(values: Sequence[float]) -> Row:
    """Return count, mean and its 95% interval by Student's t (none for fewer than two values)."""
    count = len(values)
    found: Row = {"n": count, "mean": fmean(values) if values else None, "low": None, "high": None}
    if count > 1:
        error = float(np.std(values, ddof=1)) / math.sqrt(count)
        half = float(t.ppf(0.5 + CONFIDENCE / 2, count - 1)) * error
        found |= {"low": found["mean"] - half, "high": found["mean"] + half}
    return found


def rate(successes: int, count: int) -> Row:
    """Return a share and its exact 95% interval (Clopper and Pearson)."""
    if count == 0:
        return {"n": 0, "successes": 0, "share": None, "low": None, "high": None}
    exact = binomtest(successes, count).proportion_ci(CONFIDENCE, method="exact")
    return {
        "n": count,
        "successes": successes,
        "share": successes / count,
        "low": float(exact.low),
        "high": float(exact.high),
    }


def percent(share: float, digits: int = 1) -> str:
    """Return a share as text such as '12.3%'."""
    return f"{100 * share:.{digits}f}%"


def interval(row: Mapping[str, Any], digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Return mean and 95% interval of a `summary` as text; empty if it has no values."""
    if row["mean"] is None:
        return ""
    mean = f"{scale * row['mean']:.{digits}f}{unit}"
    if row["low"] is None:
        return mean
    return f"{mean} [{scale * row['low']:.{digits}f}, {scale * row['high']:.{digits}f}]"


def scene_table(uses: Sequence[Row], cells: Mapping[str, Row], scene: str) -> list[Row]:
    """Return a row for each scheme flown in a scene, over its training seeds."""
    schemes: dict[Scheme, list[Row]] = {}
    for use in uses:
        if use["scene"] == scene and use["cell"] in cells:
            scheme = (use["method"], use["planner"])
            schemes.setdefault(scheme, []).append(cells[use["cell"]])
    return [
        {"method": method, "planner": planner, "paper": reported(scene, (method, planner)),
         **_scheme(flights)}
        for (method, planner), flights in schemes.items()
    ]  # fmt: skip


def _scheme(cells: Sequence[Row]) -> Row:
    times = [cell["mission_time"] for cell in cells if cell["success"]]
    return {
        "order": cells[0]["order"],
        "order_bound": cells[0]["order_bound"],
        "time": summary(times),
        "times": times,
        "shortest": min(times, default=None),
        "longest": max(times, default=None),
        "success": rate(len(times), len(cells)),
        "contacts": sum(cell["contacts"] for cell in cells),
        "train_seconds": _training(cells)["mean"],
    }


def _training(cells: Sequence[Row]) -> Row:
    return summary([cell["train_seconds"] for cell in cells if cell["train_seconds"] is not None])


def random_table(uses: Sequence[Row], cells: Mapping[str, Row]) -> list[Row]:
    """Return a row for each layout ('all' too), planner and order over the random scenes."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for use in uses:
        if use["part"] == "random" and use["cell"] in cells:
            for layout in (use["scene"].split("_")[0], "all"):
                group = (layout, use["planner"], use["method"])
                groups.setdefault(group, []).append(cells[use["cell"]])
    wanted = itertools.product(("floating", "city", "all"), PLANNERS, ABLATION)
    return [
        {"layout": group[0], "planner": group[1], "method": group[2], **_group(groups[group])}
        for group in wanted
        if group in groups
    ]


def _group(cells: Sequence[Row]) -> Row:
    won = [cell for cell in cells if cell["success"]]
    ratios = [cell["ratio"] for cell in won]
    return {
        "success": rate(len(won), len(cells)),
        "time": summary([cell["mission_time"] for cell in won]),
        "lower_bound": fmean(cell["lower_bound"] for cell in cells),
        "ratio": summary(ratios),
        "worst_ratio": max(ratios, default=None),
        "contacts": sum(cell["contacts"] for cell in cells),
        "train_seconds": _training(cells),
    }


def paired(uses: Sequence[Row], cells: Mapping[str, Row], one: Scheme, two: Scheme) -> Row:
    """Return what share of scheme `two`'s time scheme `one` saves, over scenes both succeed in."""

    def won(scheme: Scheme) -> dict[str, Row]:
        return {
            use["scene"]: cells[use["cell"]]
            for use in uses
            if use["part"] == "random" and (use["method"], use["planner"]) == scheme
            and use["cell"] in cells and cells[use["cell"]]["success"]
        }  # fmt: skip

    first, second = won(one), won(two)
    both = [scene for scene in second if scene in first]
    savings = [1.0 - first[s]["mission_time"] / second[s]["mission_time"] for s in both]
    low, high = np.percentile(savings, [5, 95]).tolist() if savings else (None, None)
    return {
        "one": list(one),
        "two": list(two),
        "scenes": both,
        "savings": savings,
        "saving": summary(savings),
        "p5": low,
        "p95": high,
        "changed": sum(first[scene]["order"] != second[scene]["order"] for scene in both),
    }


def tables(uses: Sequence[Row], cells: Mapping[str, Row]) -> Row:
    """Return all tables by name."""

    def scenes(part: str) -> dict[str, list[Row]]:
        labels = dict.fromkeys(use["scene"] for use in uses if use["part"] == part)
        rows = {label: scene_table(uses, cells, label) for label in labels}
        return {label: found for label, found in rows.items() if found}

    def savings(first: str, second: str) -> Row:
        return {planner: paired(uses, cells, (first, planner), (second, planner))
                for planner in PLANNERS}  # fmt: skip

    policy = [cell for cell in cells.values() if cell["planner"] == "policy"]
    return {
        "scenarios": scenes("scenarios"),
        "sweep": [
            {"items": int(scene.removeprefix("sweep_")), "schemes": found}
            for scene, found in scenes("sweep").items()
        ],
        "random": random_table(uses, cells),
        "order_saving": savings("lkh", "random"),
        "time_order_saving": savings("lkh-time", "lkh"),
        "policy_saving": {
            planner: paired(uses, cells, ("lkh", "policy"), ("lkh", planner))
            for planner in PLANNERS[1:]
        },
        "policies": {
            **rate(sum(cell["success"] for cell in policy), len(policy)),
            "contacts": sum(cell["contacts"] for cell in policy),
        },
    }
