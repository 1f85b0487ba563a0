"""Charts over time: speed against the limits, and the course of learning.

Figures are made without pyplot, so that no global matplotlib state is touched.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import progress
from mjcollect.scene.order import node_name
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

DPI = 120
# Okabe and Ito's palette: told apart by the colour-blind.
BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
SKY, BLACK = "#56B4E9", "#222222"
APART = 0.055  # of a panel's height, between the labels of two levels
LABEL: dict[str, Any] = {"size": 11, "color": BLACK}
# Panels of the learning figure: columns with their name in the legend, colour and marker.
# Evaluations are sparse, hence the markers.
Column = tuple[str, str, str, str | None]
RETURN: list[Column] = [("episode_return", "episode return", BLUE, None)]
RATES: list[Column] = [
    ("success_rate", "success, training", BLUE, None),
    ("eval_success_rate", "success, evaluation", GREEN, "o"),
    ("crash_rate", "crashes, training", RED, None),
    ("shield_share", "shield acts, of slots", PURPLE, None),
]
KEPT: Column = ("best_time", "best, kept", "#C4C4C4", None)  # wide, behind the others
TIME: list[Column] = [KEPT, ("eval_time", "evaluation", GREEN, "o")]
TIMES: list[Column] = [
    KEPT,
    ("eval_actor_time", "actor", BLUE, "o"),
    ("eval_average_time", "averaged actor", GREEN, "o"),
]
CRITIC: list[Column] = [("critic_loss", "critic loss", BLUE, None)]
ACTOR: list[Column] = [("actor_loss", "actor loss", ORANGE, None)]


def figure(width: float, height: float) -> Figure:
    """An empty white figure of so many inches, drawn by Agg."""
    made = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(made)
    return made


def save(made: Figure, path: str | os.PathLike[str]) -> None:
    """Write the PNG through a temporary file: a run folder never holds half a picture."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        made.savefig(part, format="png", dpi=DPI)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def flight_title(
    scene: Scene, trajectory: Trajectory, order: Sequence[int] | None, segment: int | None
) -> str:
    """Scene name, what was flown, time and path length in one line."""
    what = ended = ""
    if order is not None:
        done = progress(scene, trajectory, order, segment)
        items = len(scene.items)
        what = f", mission of {items} item{'s' if items > 1 else ''}"
        if segment is not None:
            leg = f"{node_name(done.start)} → {node_name(done.targets[0])}"
            what = f", segment {segment}: {leg}"
        ended = "" if len(done.rows) == len(done.targets) else ", not completed"
    name = scene.name if len(scene.name) <= 40 else scene.name[:39] + "…"
    return f"{name}{what}: {trajectory.duration:.2f} s, {trajectory.length:.0f} m{ended}"


def plot_speed(
    path: str | os.PathLike[str],
    scene: Scene,
    trajectory: Trajectory,
    order: Sequence[int] | None = None,
    segment: int | None = None,
) -> Figure:
    """Speed and acceleration over time against their limits; stops marked if `order` is given.

    Args:
        path: PNG to write, 1440 by 840 pixels.
        scene, trajectory: what was flown.
        order, segment: as in `mjcollect.plots.plot_path_3d`.

    Returns:
        The figure, also written to `path`.
    """
    made = figure(12, 7)
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
        _plain(axes)
    if trajectory.duration > 0:
        lower.set_xlim(trajectory.t[0], trajectory.t[-1])
    if order is not None:
        done = progress(scene, trajectory, order, segment)
        for index, (node, row) in enumerate(zip(done.targets, done.rows, strict=False)):
            for axes in (upper, lower):
                axes.axvline(trajectory.t[row], color="#777777", linestyle=":", linewidth=1.1)
            if len(done.targets) <= 12 or node < 0:
                upper.annotate(
                    node_name(node), (trajectory.t[row], 1.0), size=9.5, color=BLACK,
                    xycoords=("data", "axes fraction"), xytext=(0, 4 + 12 * (index % 2)),
                    textcoords="offset points", ha="right",
                )  # fmt: skip
    lower.set_xlabel("time (s)", **LABEL)
    made.suptitle(flight_title(scene, trajectory, order, segment), size=13.5, y=0.975)
    made.subplots_adjust(left=0.07, right=0.925, top=0.88, bottom=0.09, hspace=0.14)
    save(made, path)
    return made


def plot_learning(
    path: str | os.PathLike[str],
    metrics: Mapping[str, Sequence[Any]],
    *,
    bound: float | None = None,
    detour: float | None = None,
    law_time: float | None = None,
    mpc_time: float | None = None,
) -> Figure:
    """Return, success, time and losses against environment steps (or updates, if not logged).

    Args:
        path: PNG to write, 1440 by 1080 pixels.
        metrics: columns of metrics.csv. Those known are drawn: episode_return, success_rate,
            eval_success_rate, crash_rate, shield_share, eval_actor_time and eval_average_time, or
            else eval_time (s), best_time (s), critic_loss, actor_loss. Cells may be empty, None or
            NaN. With a column `segment`, every segment gets its own line.
        bound, detour, law_time, mpc_time: seconds of lower bound, detour time, and flights of the
            guidance law and the MPC, drawn as levels beside the evaluated times.

    Returns:
        The figure, also written to `path`.

    Raises:
        ValueError: there is neither env_steps nor update, or columns differ in length.
    """
    columns = {name: _numbers(values) for name, values in metrics.items()}
    x_name = next((name for name in ("env_steps", "update") if name in columns), None)
    if x_name is None:
        raise ValueError(f"metrics: {sorted(columns)}: needs the column env_steps or update")
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"metrics: {lengths}: columns must have equal lengths")
    made = figure(12, 9)
    grid: Any = made.subplots(2, 2, sharex=True)
    labels = ("episode return", "share", "time (s)", "critic loss")
    for axes, label in zip(grid.flat, labels, strict=True):
        axes.set_ylabel(label, **LABEL)
        _plain(axes)
    both = "eval_actor_time" in columns and "segment" not in columns
    panels = (RETURN, RATES, TIMES if both else TIME, CRITIC)
    for axes, shown in zip(grid.flat, panels, strict=True):
        _curves(axes, columns, x_name, shown)
    grid[0, 1].set_ylim(-0.03, 1.03)
    levels = (
        (bound, "lower bound", RED, ":"),
        (detour, "detour time", ORANGE, ":"),
        (mpc_time, "MPC", SKY, (0.0, (3.0, 3.0))),
        (law_time, "law", PURPLE, (3.0, (3.0, 3.0))),  # in the gaps of the MPC's, if they are equal
    )
    there = [level for level in levels if level[0] is not None]
    if there:
        _levels(grid[1, 0], there)
    critic = columns.get("critic_loss", np.empty(0))
    if np.any(critic > 0) and not np.any(critic < 0):
        grid[1, 1].set_yscale("log")
    twin = grid[1, 1].twinx()
    twin.spines[["top", "left"]].set_visible(False)
    twin.set_ylabel("actor loss", **LABEL)
    if "segment" not in columns:
        _curves(twin, columns, x_name, ACTOR)
    if not twin.lines:
        twin.set_visible(False)
    for axes in grid[1]:
        axes.set_xlabel("environment steps" if x_name == "env_steps" else "updates", **LABEL)
        axes.ticklabel_format(axis="x", style="plain")
        axes.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))
    _legends(made, grid, twin, columns)
    save(made, path)
    return made


def _numbers(values: Sequence[Any]) -> Array:
    """Floats, with NaN for what is empty."""
    return np.array([np.nan if cell is None or cell == "" else float(cell) for cell in values])


def _curves(axes: Any, columns: Mapping[str, Array], x_name: str, shown: list[Column]) -> None:
    """Draw the columns that are there, their gaps bridged."""
    segments = columns.get("segment")
    groups = [None] if segments is None else list(np.unique(segments[np.isfinite(segments)]))
    there_are = [column for column in shown if column[0] in columns]
    if segments is not None:  # colours tell segments apart, so one column has to do
        there_are = sorted(there_are, key=lambda column: not column[0].startswith("eval_"))[:1]
    for name, label, line_colour, marker in there_are:
        colour: Any = line_colour
        for index, group in enumerate(groups):
            there = np.isfinite(columns[name]) & np.isfinite(columns[x_name])
            if group is not None:
                there &= segments == group
                label = f"segment {group:g}"
                colour = matplotlib.colormaps["viridis"](index / max(1, len(groups) - 1) * 0.92)
            if there.any():
                x, y = columns[x_name][there], columns[name][there]
                axes.plot(
                    x,
                    y,
                    color=colour,
                    marker=marker,
                    markersize=4,
                    linewidth=5.0 if name == KEPT[0] else 1.5,
                    label=label,
                )


def _levels(axes: Any, levels: Sequence[tuple[float | None, str, str, Any]]) -> None:
    """Horizontal lines at values, with names and colours, labelled at the right edge."""
    drawn = [line.get_ydata() for line in axes.lines]
    values = np.array([level[0] for level in levels], dtype=float)
    data = np.concatenate([values, *drawn])
    # What is far later than the levels runs out of the picture: they are what there is to beat.
    low, high = float(np.nanmin(data)), min(float(np.nanmax(data)), 1.5 * float(values.max()))
    room = 0.06 * max(high - low, 0.02 * high, 0.1)
    axes.set_ylim(low - room, high + room)
    places = (values - low + room) / (high - low + 2 * room)
    order = np.argsort(places, kind="stable")
    for lower, upper in pairwise(order):  # apart, and not above the panel
        places[upper] = max(places[upper], places[lower] + APART)
    top = 1.0
    for index in order[::-1]:
        places[index] = top = min(places[index], top)
        top -= APART
    for (value, name, colour, dashes), place in zip(levels, places, strict=True):
        short = name.removeprefix("lower ").removesuffix(" time")
        style = {"color": colour, "linestyle": dashes, "linewidth": 1.8}
        axes.axhline(value, label=f"{name} {value:.2f} s", gid="level", **style)
        axes.annotate(
            f"{short} {value:.2f}", (1.0, value), (1.045, place),
            xycoords=("axes fraction", "data"), textcoords="axes fraction",
            va="center", size=9.5, color=BLACK, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 1.2, "shrinkA": 1,
                        "shrinkB": 0, "relpos": (0.0, 0.5)},
        )  # fmt: skip


def _legends(made: Figure, grid: Any, twin: Any, columns: Mapping[str, Array]) -> None:
    """One legend a panel, above its data, or one for all segments under the figure."""
    made.subplots_adjust(left=0.07, right=0.93, top=0.93, bottom=0.07, hspace=0.2, wspace=0.24)
    labelled = any(line.get_gid() == "level" for line in grid[1, 0].lines)
    if labelled:
        made.subplots_adjust(wspace=0.42)
    if "segment" in columns:
        handles, labels = grid[0, 0].get_legend_handles_labels()
        if handles:
            made.legend(
                handles,
                labels,
                loc="lower center",
                ncol=min(9, len(labels)),
                frameon=False,
                fontsize=9.5,
            )
            made.subplots_adjust(bottom=0.12 if len(labels) > 9 else 0.10)
    for axes in grid.flat:
        handles, labels = axes.get_legend_handles_labels()
        if axes is grid[1, 1]:
            extra = twin.get_legend_handles_labels()
            handles, labels = handles + extra[0], labels + extra[1]
        keep = [
            k
            for k, label in enumerate(labels)
            if not label.startswith("segment") and handles[k].get_gid() != "level"
        ]
        if keep:
            axes.legend(
                [handles[k] for k in keep], [labels[k] for k in keep], loc="lower left",
                bbox_to_anchor=(0.0, 1.0), ncol=len(keep) if len(keep) < 4 else 2,
                frameon=False, fontsize=9.5, borderaxespad=0.1, columnspacing=1.1, handlelength=1.6,
            )  # fmt: skip


def _plain(axes: Any) -> None:
    axes.grid(color="#E3E3E3", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9.5)
