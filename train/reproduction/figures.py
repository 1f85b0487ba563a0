"""Draws the figures: flights, time against K, the ablation, the saving by ordering."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.render.path_figures import (
    MOST_PIECES,
    axes_3d,
    axes_top,
    draw_boxes_3d,
    draw_boxes_top,
)
from mjcollect.render.time_figures import (
    BLACK,
    BLUE,
    GREEN,
    LABEL,
    ORANGE,
    PURPLE,
    RED,
    figure,
    plain,
    save,
)
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from train.reproduction.paper import (
    DDPG,
    LKH_DDPG,
    MPC,
    ORDER_NAMES,
    PLANNER_NAMES,
    SCENARIOS,
    SCHEMES,
    SWEEP,
    scheme_name,
)
from train.reproduction.plan import ABLATION, PLANNERS, Order, Plan
from train.reproduction.running import cell_folder
from train.reproduction.tables import percent

GREY = "#C9CFD6"
SWEEP_LINES = [
    (LKH_DDPG, GREEN, "o"),
    (DDPG, BLUE, "s"),
    (MPC, RED, "^"),
    (("lkh", "mpc"), ORANGE, "v"),
    (("lkh", "reference"), BLACK, "D"),
]
STYLES: tuple[tuple[str, Any], ...] = (
    (GREEN, "-"),
    (BLUE, (0, (5, 2))),
    (RED, (0, (1.5, 1.5))),
)
Document = Mapping[str, Any]


def draw(out: Path, plan: Plan, doc: Document) -> dict[str, str]:
    """Draw every figure for which there are flights into the folder `out`.

    Returns:
        The files' names by what they show.
    """
    drawn = {}
    for scene in SCENARIOS:
        flights = flights_of(out, plan, scene)
        if flights:
            drawn[scene] = f"schemes_{scene}.png"
            title = f"{scene} (look-alike): the paper's three schemes"
            plot_schemes(out / drawn[scene], plan.scenes[scene], title, flights)
    charts = (
        ("sweep", plot_sweep, doc["tables"]["sweep"]),
        ("ablation", plot_ablation, doc["tables"]["random"]),
        ("savings", plot_savings, doc["orders"]),
    )
    for shown, plot, table in charts:
        if table:
            drawn[shown] = f"{shown}.png"
            plot(out / drawn[shown], doc)
    return drawn


def flights_of(out: Path, plan: Plan, scene: str) -> dict[str, tuple[Order, Trajectory]]:
    """Return order and flight of each of the paper's schemes, by its name.

    Of several training seeds the first that was flown counts.
    """
    found: dict[str, tuple[Order, Trajectory]] = {}
    for scheme in SCHEMES:
        for use in plan.uses:
            if (use.part, use.scene, use.method, use.planner) == ("scenarios", scene, *scheme):
                cell = plan.cells[use.cell]
                path = cell_folder(out, cell).path / "trajectory.csv"
                name = scheme_name(*scheme)
                if name not in found and path.is_file():
                    found[name] = (cell.order, Trajectory.load(path))
    return found


def plot_schemes(
    path: Path, scene: Scene, title: str, flights: Mapping[str, tuple[Order, Trajectory]]
) -> None:
    """Draw up to three flights of one scene over each other, in 3D on the left, from above right.

    Args:
        path: PNG to write, 1800 by 960 pixels.
        flights: order and flight by the scheme's name.
    """
    made = figure(15, 8)
    low, high = scene.bounds
    space = axes_3d(made, (0.0, 0.09, 0.50, 0.85), low, high)
    top = axes_top(made, (0.555, 0.14, 0.425, 0.78), low, high)
    draw_boxes_3d(space, scene.boxes)
    draw_boxes_top(top, scene)
    handles = []
    for number, (name, (order, flight)) in enumerate(flights.items()):
        x = np.concatenate([flight.x[:: max(1, len(flight.x) // MOST_PIECES)], flight.x[-1:]])
        colour, dashes = STYLES[number]
        style: Mapping[str, Any] = {
            "color": colour, "linestyle": dashes, "linewidth": 2.6 - 0.3 * number,
            "zorder": 4 + number,
        }  # fmt: skip
        label = f"{name}: {flight.duration:.1f} s (order {', '.join(map(str, order))})"
        handles += space.plot(*x.T, label=label, **style)
        top.plot(*x.T[:2], **style)
    for node in range(DEPOT, len(scene.items)):
        point = scene.point(node)
        marker: Mapping[str, Any] = {
            "color": BLACK, "marker": "s" if node == DEPOT else "o", "s": 55, "edgecolor": "white",
            "zorder": 9,
        }  # fmt: skip
        space.scatter(*point, depthshade=False, **marker)
        top.scatter(*point[:2], clip_on=False, **marker)
        name = "depot" if node == DEPOT else str(node)
        above = point + (high - low) * [0, 0, 0.03]
        space.text(*above, name, ha="center", zorder=10, size=10)
        top.annotate(name, point[:2], xytext=(6, 6), textcoords="offset points", zorder=10, size=10)
    made.suptitle(title, fontsize=14, y=0.975)
    made.legend(handles=handles, loc="lower center", ncol=3, frameon=False, fontsize=10)
    save(made, path)


def plot_sweep(path: Path, doc: Document) -> None:
    """Draw mission time against K beside the paper's points, before the range of all bounds."""
    axes: Any = figure(11, 7).add_axes((0.08, 0.1, 0.89, 0.82))
    entries = doc["tables"]["sweep"]
    spread = {entry["items"]: doc["spreads"][f"sweep_{entry['items']}"] for entry in entries}
    items = sorted(spread)
    axes.fill_between(
        items, [spread[k]["p5"] for k in items], [spread[k]["p95"] for k in items], color=GREY,
        alpha=0.5, linewidth=0, label="bounds of all orders, 5th to 95th percentile",
    )  # fmt: skip
    axes.plot(items, [spread[k]["best"] for k in items], color="#777777", linestyle=":",
              label="bound of the best order")  # fmt: skip
    for which, colour, marker in SWEEP_LINES:
        rows = [(entry["items"], row["time"]["mean"]) for entry in entries
                for row in entry["schemes"]
                if (row["method"], row["planner"]) == which and row["time"]["n"]]  # fmt: skip
        if rows:
            axes.plot(*zip(*rows, strict=True), color=colour, marker=marker, markersize=6,
                      linewidth=1.8, label=scheme_name(*which))  # fmt: skip
        for number, (k, (low, high)) in enumerate(SWEEP.get(which, {}).items()):
            label = f"{SCHEMES[which]}, paper" if number == 0 else None
            axes.errorbar(
                k, (low + high) / 2, yerr=(high - low) / 2 or None, color=colour, marker=marker,
                markersize=10, markerfacecolor="none", markeredgewidth=1.6, capsize=4,
                linestyle="", label=label,
            )  # fmt: skip
    axes.set_xlabel("number of items K", **LABEL)
    axes.set_ylabel("mission time (s)", **LABEL)
    axes.set_xticks(range(1, 9))
    axes.set_ylim(bottom=0)
    _finish(path, axes, "Mission time against K: look-alike scene, paper's points hollow")


def plot_ablation(path: Path, doc: Document) -> None:
    """Draw the mean time over the lower bound by order and planner, with 95% intervals."""
    axes: Any = figure(11, 6.5).add_axes((0.08, 0.11, 0.89, 0.78))
    rows = {(row["planner"], row["method"]): row["ratio"] for row in doc["tables"]["random"]
            if row["layout"] == "all" and row["ratio"]["n"]}  # fmt: skip
    planners = [planner for planner in PLANNERS if any(key[0] == planner for key in rows)]
    width = 0.8 / len(ABLATION)
    for number, (method, colour) in enumerate(zip(ABLATION, (BLUE, GREEN, ORANGE), strict=True)):
        there = [k for k, planner in enumerate(planners) if (planner, method) in rows]
        ratios = [rows[planners[k], method] for k in there]
        places = [k + (number - 1) * width for k in there]
        errors = [0.0 if r["low"] is None else r["mean"] - r["low"] for r in ratios]
        heights = [ratio["mean"] - 1.0 for ratio in ratios]
        bars = axes.bar(places, heights, 0.92 * width, bottom=1.0, yerr=errors, capsize=3,
                        color=colour, label=ORDER_NAMES[method],
                        error_kw={"linewidth": 1.1})  # fmt: skip
        axes.bar_label(bars, [f"{ratio['mean']:.3f}" for ratio in ratios], padding=3, size=9)
    axes.axhline(1.0, color=BLACK, linewidth=0.9)
    axes.set_xticks(range(len(planners)), [PLANNER_NAMES[planner] for planner in planners])
    axes.set_ylabel("mission time / lower bound", **LABEL)
    axes.margins(y=0.08)
    scenes = len({use["scene"] for use in doc["uses"] if use["part"] == "random"})
    title = f"Order and planner over {scenes} random scenes, 95% intervals"
    _finish(path, axes, title, ncol=3, loc="upper right", bbox_to_anchor=(1.0, 1.08))


def plot_savings(path: Path, doc: Document) -> None:
    """Draw what share of the time the best order saves: over random instances, and as flown."""
    axes: Any = figure(11, 6.5).add_axes((0.08, 0.11, 0.89, 0.78))
    orders = doc["orders"]
    edges = 100 * np.array(orders["histogram"]["edges"])
    counts = np.array(orders["histogram"]["counts"])
    shares = 100 * counts / counts.sum()
    axes.stairs(shares, edges, fill=True, color=GREY,
                label=f"{orders['instances']} random instances, K = 8, straight legs")  # fmt: skip
    top = float(shares.max())
    colours = (GREEN, RED, PURPLE, BLACK)
    items = doc["sizes"]["items"]
    for number, (planner, colour) in enumerate(zip(PLANNERS, colours, strict=True)):
        pair = doc["tables"]["order_saving"][planner]
        if pair["savings"]:
            level = -0.07 * top * (number + 1)
            axes.plot(100 * np.array(pair["savings"]), np.full(len(pair["savings"]), level), "|",
                      color=colour, markersize=13, markeredgewidth=1.6,
                      label=f"flown: {PLANNER_NAMES[planner]}, K = {items}")  # fmt: skip
    paper = 100 * orders["paper_saving"]
    axes.axvline(paper, color=RED, linestyle="--", linewidth=1.4)
    text = (f"paper, K = 8: {paper:.1f}%\n"
            f"({percent(orders['share_paper_saving'], 2)} of instances save as much)")  # fmt: skip
    axes.annotate(text, (paper, 0.75 * top), xytext=(6, 0), textcoords="offset points", color=RED,
                  size=10)  # fmt: skip
    axes.axhline(0, color=BLACK, linewidth=0.8)
    axes.set_xlabel("saving of LKH over a random order (%)", **LABEL)
    axes.set_ylabel("share of instances (%)", **LABEL)
    axes.set_ylim(-0.36 * top, 1.08 * top)
    axes.set_yticks([tick for tick in axes.get_yticks() if 0 <= tick <= 1.08 * top])
    _finish(path, axes, "Saving by ordering", loc="upper left")


def _finish(path: Path, axes: Any, title: str, **legend: Any) -> None:
    axes.legend(**{"frameon": False, "fontsize": 9.5, **legend})
    axes.figure.suptitle(title, fontsize=13)
    plain(axes)
    save(axes.figure, path)
