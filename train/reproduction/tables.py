"""From flown cells to tables: plain numbers, nothing formatted.

Rows come as `uses` (dictionaries of `train.reproduction.plan.Use`) and `cells` (name -> entry of
`entry_of`). A cell that is not flown is missing from `cells`; a flight without success has no time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np
from scipy.stats import binomtest, t

from train.reproduction.paper import SCENARIOS, SWEEP
from train.reproduction.plan import ABLATION, PLANNERS, Cell

Row = dict[str, Any]
CONFIDENCE = 0.95


def entry_of(cell: Cell, result: Mapping[str, Any]) -> Row:
    """What is kept of a cell's mission.json."""
    segments = result["segments"]
    updates = [segment["updates"] for segment in segments]
    return {
        "scene": cell.scene,
        "order": list(cell.order),
        "planner": cell.planner,
        "seed": cell.seed,
        "success": result["success"],
        "mission_time": result["mission_time"],
        "lower_bound": result["lower_bound"],
        "bound_method": result["bound_method"],
        "order_bound": sum(segment["lower_bound"] for segment in segments),
        "ratio": result["ratio"],
        "detour_time": result["detour_time"],
        "contacts": result["contacts"],
        "violations": sorted({violation["kind"] for violation in result["violations"]}),
        "segment_times": [segment["time"] for segment in segments],
        "train_seconds": result["train_seconds"],
        "updates": sum(updates) if None not in updates else None,
    }


def summary(values: Sequence[float]) -> Row:
    """Count, mean and its 95% interval by Student's t (none for fewer than two values)."""
    count = len(values)
    if count == 0:
        return {"n": 0, "mean": None, "low": None, "high": None}
    mean = fmean(values)
    if count == 1:
        return {"n": 1, "mean": mean, "low": None, "high": None}
    error = float(np.std(values, ddof=1)) / math.sqrt(count)
    half = float(t.ppf(0.5 + CONFIDENCE / 2, count - 1)) * error
    return {"n": count, "mean": mean, "low": mean - half, "high": mean + half}


def rate(successes: int, count: int) -> Row:
    """A share and its exact 95% interval (Clopper and Pearson)."""
    if count == 0:
        return {"n": 0, "successes": 0, "share": None, "low": None, "high": None}
    interval = binomtest(successes, count).proportion_ci(CONFIDENCE, method="exact")
    return {
        "n": count,
        "successes": successes,
        "share": successes / count,
        "low": float(interval.low),
        "high": float(interval.high),
    }


def flown(
    uses: Sequence[Row], cells: Mapping[str, Row], where: Callable[[Row], bool]
) -> list[tuple[Row, Row]]:
    """Pairs of use and cell that fit and are flown."""
    return [(use, cells[use["cell"]]) for use in uses if where(use) and use["cell"] in cells]


def _scheme(rows: Sequence[tuple[Row, Row]]) -> Row:
    """One scheme in one scene, over its training seeds."""
    times = [cell["mission_time"] for _, cell in rows if cell["success"]]
    training = [cell["train_seconds"] for _, cell in rows if cell["train_seconds"] is not None]
    return {
        "order": rows[0][1]["order"],
        "order_bound": rows[0][1]["order_bound"],
        "time": summary(times),
        "times": times,
        "shortest": min(times, default=None),
        "longest": max(times, default=None),
        "success": rate(len(times), len(rows)),
        "contacts": sum(cell["contacts"] for _, cell in rows),
        "train_seconds": fmean(training) if training else None,
    }


def scene_table(uses: Sequence[Row], cells: Mapping[str, Row], part: str, scene: str) -> list[Row]:
    """A row for each scheme (order method, planner) of a scene, the paper's time beside it."""
    fitting = flown(uses, cells, lambda use: use["part"] == part and use["scene"] == scene)
    schemes = dict.fromkeys((use["method"], use["planner"]) for use, _ in fitting)
    table = []
    for method, planner in schemes:
        rows = [pair for pair in fitting if (pair[0]["method"], pair[0]["planner"])
                == (method, planner)]  # fmt: skip
        paper = reported(part, scene, method, planner)
        table.append({"method": method, "planner": planner, "paper": paper, **_scheme(rows)})
    return table


def reported(part: str, scene: str, method: str, planner: str) -> list[float] | None:
    """The paper's time of a scheme as [low, high], None if it gives none."""
    if part == "scenarios":
        time = SCENARIOS[scene].get((method, planner))
        return None if time is None else [time, time]
    if part == "sweep":
        times = SWEEP.get((method, planner), {}).get(int(scene.removeprefix("sweep_")))
        return None if times is None else list(times)
    return None


def layout_of(scene: str) -> str:
    """Layout of a random scene from its label."""
    return scene.split("_")[0]


def random_table(uses: Sequence[Row], cells: Mapping[str, Row]) -> list[Row]:
    """A row for each layout ('all' too), planner and order method over the random scenes."""
    fitting = flown(uses, cells, lambda use: use["part"] == "random")
    layouts = dict.fromkeys(layout_of(use["scene"]) for use, _ in fitting)
    table = []
    for layout in [*layouts, "all"]:
        for planner in PLANNERS:
            for method in ABLATION:
                rows = [
                    cell for use, cell in fitting
                    if layout in ("all", layout_of(use["scene"]))
                    and (use["planner"], use["method"]) == (planner, method)
                ]  # fmt: skip
                if rows:
                    group = {"layout": layout, "planner": planner, "method": method}
                    table.append({**group, **_group(rows)})
    return table


def _group(cells: Sequence[Row]) -> Row:
    won = [cell for cell in cells if cell["success"]]
    ratios = [cell["ratio"] for cell in won]
    training = [cell["train_seconds"] for cell in cells if cell["train_seconds"] is not None]
    return {
        "success": rate(len(won), len(cells)),
        "time": summary([cell["mission_time"] for cell in won]),
        "lower_bound": fmean(cell["lower_bound"] for cell in cells),
        "ratio": summary(ratios),
        "worst_ratio": max(ratios, default=None),
        "contacts": sum(cell["contacts"] for cell in cells),
        "train_seconds": summary(training),
    }


def paired(
    uses: Sequence[Row], cells: Mapping[str, Row], one: tuple[str, str], two: tuple[str, str]
) -> Row:
    """Share of the time of scheme `two` that scheme `one` saves, over random scenes both flew.

    Args:
        one, two: order method and planner.
    """
    fitting = flown(uses, cells, lambda use: use["part"] == "random")
    times: dict[tuple[str, str], dict[str, Row]] = {one: {}, two: {}}
    for use, cell in fitting:
        scheme = (use["method"], use["planner"])
        if scheme in times and cell["success"]:
            times[scheme][use["scene"]] = cell
    both = [scene for scene in times[two] if scene in times[one]]
    first, second = [times[one][s] for s in both], [times[two][s] for s in both]
    pairs = list(zip(first, second, strict=True))
    savings = [1.0 - a["mission_time"] / b["mission_time"] for a, b in pairs]
    low, high = np.percentile(savings, [5, 95]) if savings else (None, None)
    return {
        "one": list(one),
        "two": list(two),
        "scenes": both,
        "savings": savings,
        "saving": summary(savings),
        "p5": None if low is None else float(low),
        "p95": None if high is None else float(high),
        "changed": sum(a["order"] != b["order"] for a, b in pairs),
    }


def tables(uses: Sequence[Row], cells: Mapping[str, Row]) -> Row:
    """All tables."""
    scenes = list(dict.fromkeys(use["scene"] for use in uses if use["part"] == "sweep"))
    sweep = [
        {"items": int(scene.removeprefix("sweep_")), "schemes": found}
        for scene in scenes
        if (found := scene_table(uses, cells, "sweep", scene))
    ]
    policy = [cell for cell in cells.values() if cell["planner"] == "policy"]
    return {
        "scenarios": {
            scene: found
            for scene in SCENARIOS
            if (found := scene_table(uses, cells, "scenarios", scene))
        },
        "sweep": sweep,
        "random": random_table(uses, cells),
        "order_saving": {
            planner: paired(uses, cells, ("lkh", planner), ("random", planner))
            for planner in PLANNERS
        },
        "time_order_saving": {
            planner: paired(uses, cells, ("lkh-time", planner), ("lkh", planner))
            for planner in PLANNERS
        },
        "policy_saving": {
            planner: paired(uses, cells, ("lkh", "policy"), ("lkh", planner))
            for planner in PLANNERS[1:]
        },
        "policies": {
            **rate(sum(cell["success"] for cell in policy), len(policy)),
            "contacts": sum(cell["contacts"] for cell in policy),
        },
    }
