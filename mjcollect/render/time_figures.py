"""Draws charts over time: speed against the limits, and the course of learning.

Figures are made without pyplot, so that no global matplotlib state is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress
from mjcollect.scene.order import DEPOT, node_name

DPI = 120
# This is Okabe and Ito's palette, which the colour-blind can tell apart.
BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
SKY, YELLOW, BLACK = "#56B4E9", "#F0E442", "#222222"
LABEL: dict[str, Any] = {"size": 11, "color": BLACK}
# The learning figure has four panels and, at the right edge of the last, a second axis.
PANELS = ("episode return", "share", "time (s)", "critic loss", "actor loss")
# Each curve has a panel, a column of metrics.csv, a name in the legend and a colour.
CURVES = (
    (0, "episode_return", "episode return", BLUE),
    (1, "success_rate", "success, training", BLUE),
    (1, "eval_success_rate", "success, evaluation", GREEN),
    (1, "crash_rate", "crashes, training", RED),
    (1, "shield_share", "shield acts, of slots", PURPLE),
    (2, "best_time", "best, kept", "#C4C4C4"),
    (2, "eval_actor_time", "actor", BLUE),
    (2, "eval_average_time", "averaged actor", GREEN),
    (3, "critic_loss", "critic loss", BLUE),
    (4, "actor_loss", "actor loss", ORANGE),
)
# Where colours tell the segments of a mission apart, a panel can show one column only.
BY_SEGMENT = ("episode_return", "eval_success_rate", "eval_time", "critic_loss")


def figure(width: float, height: float) -> Figure:
    """Returns an empty white figure of so many inches, drawn by Agg."""
    made = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(made)
    return made


def save(made: Figure, path: Path) -> None:
    """Writes a figure as a PNG file, whatever the path's suffix."""
    made.savefig(path, format="png", dpi=DPI)


def flight_title(done: Progress) -> str:
    """Returns the scene's name, what was flown, time and path length in one line."""
    items, flown, name = len(done.order), done.trajectory, done.scene.name
    what = f"mission of {items} item{'s' if items > 1 else ''}"
    if done.segment is not None:
        what = done.segment_title(0)
    ended = "" if done.complete else ", not completed"
    name = name if len(name) <= 40 else name[:39] + "…"
    return f"{name}, {what}: {flown.duration:.2f} s, {flown.length:.0f} m{ended}"


def plot_speed(path: Path, done: Progress) -> Figure:
    """Draws a mission's speed and acceleration over time against their limits, with its stops.

    Args:
        path: PNG to write, 1440 by 840 pixels.
        done: what was flown.

    Returns:
        The figure, also written to `path`.
    """
    made, scene, trajectory = figure(12, 7), done.scene, done.trajectory
    upper, lower = made.subplots(2, 1, sharex=True)
    series = (
        (upper, trajectory.v, scene.v_max, "speed (m/s)", BLUE),
        (lower, trajectory.a, scene.a_max, "acceleration (m/s²)", GREEN),
    )
    for axes, values, limit, name, colour in series:
        size = np.linalg.norm(values, axis=1)
        axes.step(trajectory.t, size, where="post", color=colour, linewidth=1.4)
        axes.axhline(limit, color=RED, linestyle="--", linewidth=1.2)
        axes.annotate(
            f"limit {limit:g}", (1.0, limit), xycoords=("axes fraction", "data"), xytext=(6, 0),
            textcoords="offset points", va="center", color=RED, size=10.5, annotation_clip=False,
        )  # fmt: skip
        axes.set_ylabel(name, **LABEL)
        axes.set_ylim(0, max(limit, float(size.max())) * 1.12)
        plain(axes)
    if trajectory.duration > 0:
        lower.set_xlim(trajectory.t[0], trajectory.t[-1])
    for index, (node, row) in enumerate(zip(done.targets, done.rows, strict=False)):
        for axes in (upper, lower):
            axes.axvline(trajectory.t[row], color="#777777", linestyle=":", linewidth=1.1)
        if len(done.targets) <= 12 or node == DEPOT:
            upper.annotate(
                node_name(node), (trajectory.t[row], 1.0), size=9.5, color=BLACK,
                xycoords=("data", "axes fraction"), xytext=(0, 4 + 12 * (index % 2)),
                textcoords="offset points", ha="right",
            )  # fmt: skip
    lower.set_xlabel("time (s)", **LABEL)
    made.suptitle(flight_title(done), size=13.5, y=0.975)
    made.subplots_adjust(left=0.07, right=0.925, top=0.88, bottom=0.09, hspace=0.14)
    save(made, path)
    return made


def plot_learning(
    path: Path,
    rows: Sequence[Mapping[str, float]],
    *,
    bound: float | None = None,
    detour: float | None = None,
    law_time: float | None = None,
    mpc_time: float | None = None,
) -> Figure:
    """Draws return, success, time and losses against environment steps.

    Args:
        path: PNG to write, 1440 by 1080 pixels.
        rows: rows of metrics.csv, with NaN for what was not measured: env_steps, and the columns
            of `CURVES` as far as they are there. With a column `segment`, every segment gets its
            own line, of the columns `BY_SEGMENT`.
        bound, detour, law_time, mpc_time: seconds of lower bound, detour time, and flights of the
            guidance law and the MPC, drawn as levels among the evaluated times.

    Returns:
        The figure, also written to `path`.
    """
    columns = {name: np.array([row[name] for row in rows], dtype=float) for name in rows[0]}
    made = figure(12, 9)
    grid: Any = made.subplots(2, 2, sharex=True)
    for axes in grid.flat:
        plain(axes)
    twin = grid[1, 1].twinx()
    twin.spines[["top", "left"]].set_visible(False)
    panels = [*grid.flat, twin]
    for axes, label in zip(panels, PANELS, strict=True):
        axes.set_ylabel(label, **LABEL)
    bottom = 0.07
    if "segment" in columns:
        grid[0, 1].set_ylabel("success, evaluation", **LABEL)
        numbers = np.unique(columns["segment"])
        shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, len(numbers)))
        for number, shade in zip(numbers, shades, strict=True):
            its = {name: values[columns["segment"] == number] for name, values in columns.items()}
            for axes, name in zip(grid.flat, BY_SEGMENT, strict=True):
                _curve(axes, its, name, f"segment {number:g}", shade)
        lines = grid[0, 0].lines
        made.legend(handles=lines, loc="lower center", ncol=9, frameon=False, fontsize=9.5)
        bottom = 0.12 if len(lines) > 9 else 0.10
    else:
        for panel, name, label, colour in CURVES:
            _curve(panels[panel], columns, name, label, colour)
        levels = (
            (bound, "bound", RED, ":"),
            (detour, "detour", ORANGE, ":"),
            (mpc_time, "MPC", SKY, (0.0, (3.0, 3.0))),
            (law_time, "law", PURPLE, (3.0, (3.0, 3.0))),  # in the MPC's gaps, if they are equal
        )
        _levels(grid[1, 0], [level for level in levels if level[0] is not None])
        for axes in grid.flat:
            lines = [*axes.lines, *(twin.lines if axes is grid[1, 1] else ())]
            axes.legend(
                handles=lines, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                ncol=2 if len(lines) in (0, 4) else 3, frameon=False, fontsize=9.5,
                borderaxespad=0.1, columnspacing=1.1, handlelength=1.6,
            )  # fmt: skip
    twin.set_visible(bool(twin.lines))
    if np.any(columns.get("critic_loss", np.empty(0)) > 0):
        grid[1, 1].set_yscale("log")
    grid[0, 1].set_ylim(-0.03, 1.03)
    for axes in grid[1]:
        axes.set_xlabel("environment steps", **LABEL)
        axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))
    made.subplots_adjust(left=0.07, right=0.93, top=0.93, bottom=bottom, hspace=0.22, wspace=0.24)
    save(made, path)
    return made


def _curve(axes: Any, columns: Mapping[str, Array], name: str, label: str, colour: Any) -> None:
    """Draws a column, its gaps bridged; nothing where it is not there."""
    values = columns.get(name, np.empty(0))
    there = np.flatnonzero(np.isfinite(values))
    if len(there):
        # Evaluations are sparse, hence the markers; the best time lies wide behind the others.
        axes.plot(
            columns["env_steps"][there], values[there], label=label, color=colour, markersize=4,
            marker="o" if name.startswith("eval_") else None,
            linewidth=5.0 if name == "best_time" else 1.5,
        )  # fmt: skip


def _levels(axes: Any, levels: Sequence[tuple[float | None, str, str, Any]]) -> None:
    """Draws horizontal lines at values, with names and colours, which the legend shows."""
    if levels:
        values = np.array([level[0] for level in levels], dtype=float)
        data = np.concatenate([values, *(line.get_ydata() for line in axes.lines)])
        # What is far later than the levels runs out of the picture: they are what there is to beat.
        low, high = np.nanmin(data), min(np.nanmax(data), 1.5 * values.max())
        room = 0.06 * max(high - low, 0.02 * high, 0.1)
        axes.set_ylim(low - room, high + room)
    for value, name, colour, dashes in levels:
        label = f"{name} {value:.2f}"
        axes.axhline(value, color=colour, linestyle=dashes, linewidth=1.8, label=label)


def plain(axes: Any) -> None:
    """Draws a light grid behind the data, and no frame at the top and right."""
    axes.grid(color="#E3E3E3", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9.5)
