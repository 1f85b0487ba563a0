"""Draws every figure for which there are flights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjcollect.trajectory import Trajectory
from train.reproduction.figures import (
    figure_names,
    plot_ablation,
    plot_savings,
    plot_sweep,
    scheme_name,
)
from train.reproduction.flights import Flown, plot_schemes
from train.reproduction.paper import SCENARIOS, SCHEMES
from train.reproduction.plan import Plan
from train.reproduction.running import cell_folder
from train.support.run_folder import RunFolder


def draw(folder: RunFolder, plan: Plan, doc: Mapping[str, Any]) -> dict[str, str]:
    """Draw into the folder; file names by what they show."""
    drawn = {}
    for shown, name in figure_names(list(SCENARIOS)).items():
        if shown in SCENARIOS:
            flights = flights_of(folder, plan, shown)
            if flights:
                scene = plan.scenes[shown]
                title = f"{shown} (look-alike): the paper's three schemes"
                folder.write(name, lambda part, s=scene, t=title, f=flights:  # type: ignore[misc]
                             plot_schemes(part, s, t, f))  # fmt: skip
                drawn[shown] = name
        elif shown == "sweep" and doc["tables"]["sweep"]:
            folder.write(name, lambda part: plot_sweep(part, doc))
            drawn[shown] = name
        elif shown == "ablation" and doc["tables"]["random"]:
            folder.write(name, lambda part: plot_ablation(part, doc))
            drawn[shown] = name
        elif shown == "savings":
            folder.write(name, lambda part: plot_savings(part, doc))
            drawn[shown] = name
    return drawn


def flights_of(folder: RunFolder, plan: Plan, scene: str) -> list[Flown]:
    """The three schemes' flights, each of the first training seed that was flown."""
    found: dict[tuple[str, str], Flown] = {}
    for use in plan.uses:
        scheme = (use.method, use.planner)
        if use.part != "scenarios" or use.scene != scene or scheme not in SCHEMES:
            continue
        cell = plan.cells[use.cell]
        path = cell_folder(folder.path, cell).path / "trajectory.csv"
        if scheme not in found and path.is_file():
            record = Trajectory.load(path)
            found[scheme] = Flown(scheme_name(*scheme), cell.order, record)
    return [found[scheme] for scheme in SCHEMES if scheme in found]
