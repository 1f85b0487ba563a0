"""Draws a fleet's flights as PNG files: paths in space and from above, and who does what when."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import LogLocator, NullFormatter
from mpl_toolkits.mplot3d.proj3d import proj_transform

from mjcollect.geometry.compiled import Array
from mjcollect.render.fleet import FleetProgress
from mjcollect.render.overlay import font, ink, uav_colour
from mjcollect.render.path_figures import (
    END,
    MOST_PIECES,
    MOVING,
    NO_FLY,
    TEXT,
    arrows,
    axes_3d,
    axes_top,
    box_heights,
    draw_boxes_top,
    draw_moving,
    draw_scene_3d,
)
from mjcollect.render.time_figures import BLACK, DPI, LABEL, RED, plain, save
from mjcollect.render.time_figures import figure as new_figure
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.order import DEPOT, node_name

# Light and dark tracks stand out from boxes and page by a dark edge.
EDGED = [Stroke(linewidth=4.2, foreground=BLACK, alpha=0.75), Normal()]
ENDED = END | {"color": BLACK}
LEFT: dict[str, Any] = {"color": "white", "edgecolor": BLACK}  # items that nobody collected
HOME = "#4A545F"  # The depot has this colour, which no UAV has.
BAR, STRIP = 0.62, 0.13  # Bars and the shield's marks under them are so high, of a row.
ROW, GAPS = 0.42, 2.3  # Inches of a row, and of the panel of distances.
# A name stands at one of these places beside its marker, in halves of its width and height.
PLACES = np.array([[0, 1], [0, -1], [1, 0], [-1, 0], [0.9, 1], [-0.9, 1], [0.9, -1], [-0.9, -1]])
AWAIT = 0.22  # The time at home is drawn with this opacity.


def plot_fleet_path_3d(
    path: Path, fleet: FleetProgress, moving: Sequence[MovingBox] = ()
) -> Figure:
    """Draws the paths of a fleet among the boxes in three dimensions, in the UAVs' colours.

    Args:
        path: PNG to write, 1440 by 1200 pixels.
        fleet: what was flown.
        moving: boxes that moved, drawn where they were at first, their ways dashed.

    Returns:
        The figure, also written to `path`.
    """
    figure = new_figure(12, 10)
    low, high = fleet.scene.bounds
    axes = axes_3d(figure, (0.0, 0.02, 0.86, 0.93), low, high)
    draw_scene_3d(axes, fleet.scene, low, high, moving)
    for m, x in enumerate(_paths(fleet)):
        axes.plot(x[:, 0], x[:, 1], low[2], color="black", alpha=0.18, linewidth=1.5, zorder=2)
        axes.plot(*x.T, color=fleet.colour(m), linewidth=2.6, zorder=4, path_effects=EDGED)
    for point, _, style in _nodes(fleet):
        foot = np.array([*point[:2], low[2]])
        line = {"color": BLACK, "alpha": 0.5, "linewidth": 0.8}
        axes.plot(*np.stack([point, foot]).T, zorder=3, **line)
        axes.scatter(*point, depthshade=False, **style)
    for m in _failed(fleet):
        axes.scatter(*fleet.flights[m].trajectory.x[-1], depthshade=False, **ENDED)
    axes.apply_aspect()  # which places the axes as they will be drawn
    seen = axes.get_proj()

    def pixels(points: Array) -> Array:
        across, up, _ = proj_transform(*points.T, seen)
        return np.asarray(axes.transData.transform(np.stack([across, up], axis=-1)))

    _name_nodes(axes, fleet, pixels, heights=False)
    return _finish(figure, path, fleet, bool(moving))


def plot_fleet_path_top(
    path: Path, fleet: FleetProgress, moving: Sequence[MovingBox] = ()
) -> Figure:
    """Draws the same from above: boxes shaded by the height of their tops, arrows along the paths.

    See `plot_fleet_path_3d` for the arguments.
    """
    figure = new_figure(12, 10)
    low, high = fleet.scene.bounds[:, :2]
    axes = axes_top(figure, (0.075, 0.085, 0.76, 0.83), low, high)
    draw_boxes_top(axes, fleet.scene)
    draw_moving(axes, moving, 0, 1)
    paths = list(_paths(fleet))
    box_heights(axes, fleet.scene, np.concatenate(paths)[:, :2], low, high)
    for m, x in enumerate(paths):
        axes.plot(*x[:, :2].T, color=fleet.colour(m), linewidth=2.8, zorder=4, path_effects=EDGED)
        arrows(axes, fleet.flights[m], edge=0.8)
    for point, _, style in _nodes(fleet):
        axes.scatter(*point[:2], clip_on=False, **style | {"s": 1.3 * style["s"]})
    for m in _failed(fleet):
        axes.scatter(*fleet.flights[m].trajectory.x[-1, :2], clip_on=False, **ENDED)
    axes.apply_aspect()
    _name_nodes(axes, fleet, lambda at: axes.transData.transform(at[:, :2]), heights=True)
    return _finish(figure, path, fleet, bool(moving))


def plot_schedule(path: Path, fleet: FleetProgress) -> Figure:
    """Draws what each UAV does when, and below it the least distance between any two of them.

    A UAV has a row, with a bar for each segment that says what it reaches; marks under the bars
    show when the shield acted. A single UAV has no distances.

    Args:
        path: PNG to write, 1440 pixels wide; its height depends on the number of UAVs.
        fleet: what was flown.

    Returns:
        The figure, also written to `path`.
    """
    rows = sorted([*fleet.uavs, *fleet.idle])
    several = len(fleet.flights) > 1
    heights = [0.35 + ROW * len(rows), *([GAPS] if several else [])]
    top, bottom, between = 1.15, 0.95, 0.4
    tall = sum(heights) + top + bottom + between * several
    made = new_figure(12, tall)
    grid: Any = made.subplots(
        len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )
    made.subplots_adjust(
        left=0.075, right=0.91, top=1 - top / tall, bottom=bottom / tall,
        hspace=between / (sum(heights) / len(heights)),
    )  # fmt: skip
    upper, lower = grid[0, 0], grid[-1, 0]
    last = max(fleet.duration, fleet.lower_bound, 1e-9)
    upper.set(xlim=(0.0, last), ylim=(len(rows) - 0.45, -0.6))
    upper.set_yticks(range(len(rows)), [f"UAV {uav}" for uav in rows])
    for axes in grid[:, 0]:
        plain(axes)
    upper.grid(visible=False, axis="y")
    upper.tick_params(axis="y", length=0)
    upper.spines["left"].set_visible(False)
    scale = upper.get_window_extent().width / last  # pixels per second
    for m, uav in enumerate(fleet.uavs):
        _row(upper, fleet, m, rows.index(uav), scale)
    for uav in fleet.idle:
        upper.text(0.3 / scale, rows.index(uav), "  no items", va="center", color=HOME, size=10)
    _limits(grid[:, 0], fleet)
    if several:
        _gaps(lower, fleet)
    lower.set_xlabel("time (s)", **LABEL)
    _schedule_legend(made, fleet, 0.08 / tall)
    made.suptitle(_title(fleet), fontsize=14, y=1 - 0.2 / tall, va="top")
    save(made, path)
    return made


# Parts of the schedule


def _row(axes: Any, fleet: FleetProgress, m: int, row: int, scale: float) -> None:
    """Draws the bars of flight `m` in a row; `scale` is in pixels per second."""
    flown, colour = fleet.flights[m], fleet.colour(m)
    times = [0.0, *(float(flown.trajectory.t[k]) for k in flown.rows)]
    dark = tuple(part / 255 for part in ink(uav_colour(fleet, m)))
    for node, (begin, end) in zip(flown.targets, pairwise(times), strict=False):
        axes.barh(
            row, end - begin, BAR, begin, color=colour, edgecolor="white", linewidth=1.2, zorder=3
        )
        whole, short = node_name(node), "" if node == DEPOT else str(node)
        fits = [text for text in (whole, short) if _width(text) < (end - begin) * scale]
        if fits:
            axes.text(
                (begin + end) / 2, row, fits[0], ha="center", va="center", color=dark, size=9.5,
                weight="bold", zorder=5,
            )  # fmt: skip
    end = flown.trajectory.duration
    if not flown.complete:
        axes.barh(
            row, end - times[-1], BAR, times[-1], color="white", edgecolor=colour, hatch="//",
            linewidth=1.2, zorder=3,
        )  # fmt: skip
        axes.scatter(end, row, **ENDED)
    elif end < fleet.duration:
        axes.barh(row, fleet.duration - end, BAR, end, color=colour, alpha=AWAIT, zorder=2)
        if _width("home") < (fleet.duration - end) * scale:
            middle = (end + fleet.duration) / 2
            axes.text(middle, row, "home", ha="center", va="center", color=HOME, size=9.5)
    for begin, until in fleet.shielded[m]:
        # The shield may act for a slot only: its mark is at least two pixels wide.
        wide = max(until - begin, 2.0 / scale)
        under = row + BAR / 2 + STRIP / 2 + 0.02
        axes.barh(under, wide, STRIP, begin, color=BLACK, zorder=3)


def _width(text: str) -> float:
    """Returns the pixels that a bar needs for a text; inf if there is none."""
    return font(9.5 * DPI / 72, True).getlength(text) + 8 if text else np.inf


def _limits(panels: Sequence[Any], fleet: FleetProgress) -> None:
    """Draws the lower bound and the makespan over all panels, named above the first."""
    lines = [
        ("lower bound", fleet.lower_bound or None, RED, (0, (4, 2)), 5),
        ("makespan", fleet.makespan, BLACK, "-", 20),
    ]
    last = panels[0].get_xlim()[1]
    for name, time, colour, dashes, lift in lines:
        if time is None:
            continue
        for axes in panels:
            axes.axvline(
                time, color=colour, linestyle=dashes, linewidth=1.5, zorder=4, clip_on=False
            )
        panels[0].annotate(
            f"{name} {time:.2f} s", (time, 1.0), xycoords=("data", "axes fraction"),
            xytext=(0, lift), textcoords="offset points", ha="left" if time < last / 4 else "right",
            color=colour, size=10.5, annotation_clip=False,
        )  # fmt: skip


def _gaps(axes: Any, fleet: FleetProgress) -> None:
    """Draws the least distance of two UAVs over time, and how near they may come."""
    t, gap = fleet.flights[fleet.lead].trajectory.t, np.maximum(fleet.gaps, 1e-3)
    limit, least = fleet.separation_limit, int(np.argmin(gap))
    axes.plot(t, gap, color=BLACK, linewidth=1.3, zorder=4)
    axes.set_yscale("log")
    floor = 0.6 * min(float(gap.min()), limit or np.inf)
    axes.set_ylim(floor, max(1.6 * float(gap.max()), 3 * limit))
    axes.set_ylabel("distance (m)", **LABEL)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    if limit > 0:
        axes.axhspan(floor, limit, color=RED, alpha=0.12, linewidth=0)
        axes.axhline(limit, color=RED, linestyle="--", linewidth=1.2)
        axes.annotate(
            f"limit {limit:g} m", (1.0, limit), xycoords=("axes fraction", "data"), xytext=(6, 0),
            textcoords="offset points", va="center", color=RED, size=10.5, annotation_clip=False,
        )  # fmt: skip
    axes.scatter(t[least], gap[least], color=BLACK, s=28, zorder=5, clip_on=False)
    axes.annotate(
        f"the two UAVs that are closest: at least {fleet.gaps[least]:.2f} m apart, "
        f"at {t[least]:.1f} s", (0.0, 1.0), xycoords="axes fraction", xytext=(0, 5),
        textcoords="offset points", size=10.5, color=BLACK,
    )  # fmt: skip


def _schedule_legend(made: Figure, fleet: FleetProgress, bottom: float) -> None:
    handles: dict[str, Any] = {
        "flight to the node named": Patch(facecolor="#777777"),
        "waits at home": Patch(facecolor="#777777", alpha=AWAIT),
    }
    if _failed(fleet):
        handles["not reached"] = Patch(facecolor="white", edgecolor="#777777", hatch="//")
    handles["the shield acts"] = Line2D([], [], color=BLACK, linewidth=4)
    made.legend(
        list(handles.values()), list(handles), loc="lower center", bbox_to_anchor=(0.49, bottom),
        ncol=len(handles), frameon=False, fontsize=10.5,
    )  # fmt: skip


# Parts of both paths


def _paths(fleet: FleetProgress) -> Iterator[Array]:
    """Yields points (P, 3) of each path, at most MOST_PIECES."""
    for flown in fleet.flights:
        x = flown.trajectory.x
        yield x[np.linspace(0, len(x) - 1, min(len(x), MOST_PIECES)).round().astype(int)]


def _failed(fleet: FleetProgress) -> list[int]:
    """Returns the flights that did not reach all their targets."""
    return [m for m, flown in enumerate(fleet.flights) if not flown.complete]


def _nodes(fleet: FleetProgress) -> Iterator[tuple[Array, str, dict[str, Any]]]:
    """Yields position, label and marker of each node, collected items in their UAV's colour.

    Labels are 'depot' or 'item 3 · stop 2', the place in the order of the UAV that is to collect.
    """
    scene, reached = fleet.scene, fleet.arrivals
    for node in scene.nodes:
        style: dict[str, Any] = {"color": HOME, "marker": "s", "s": 110.0, "edgecolor": "white"}
        label = node_name(node)
        if node > DEPOT:
            state, m = fleet.state(node, reached)
            if m is not None:
                label += f" · stop {fleet.flights[m].order.index(node) + 1}"
            colour = {"color": fleet.colour(m), "edgecolor": "white"} if m is not None else LEFT
            style |= {"marker": "o", "s": 80.0} | (colour if state == "collected" else LEFT)
        yield scene.point(node), label, {**style, "zorder": 6}


def _name_nodes(
    axes: Any, fleet: FleetProgress, pixels: Callable[[Array], Array], heights: bool
) -> None:
    """Names nodes beside their markers, away from other names, markers and paths.

    Args:
        axes: drawn on. fleet: whose nodes.
        pixels: returns where points (N, 3) are drawn, (N, 2). heights: whether to name them too.
    """
    nodes = list(_nodes(fleet))
    markers = pixels(np.array([point for point, _, _ in nodes]))
    paths = np.concatenate([pixels(x) for x in _paths(fleet)])
    room, letters = axes.get_window_extent().extents, font(TEXT["size"] * DPI / 72, True)
    taken: list[Array] = []  # left, bottom, right, top of names
    for (point, label, _), marker in zip(nodes, markers, strict=True):
        text = f"{label} · z {point[2]:.0f} m" if heights else label
        half = np.array([letters.getlength(text) / 2 + 5, 13.0])
        places = marker + PLACES * (half + 9)
        costs = []
        for rank, place in enumerate(places):
            low, high = place - half, place + half
            over = [
                np.clip(np.minimum(high, b[2:]) - np.maximum(low, b[:2]), 0, None) for b in taken
            ]
            hidden = np.all(np.abs(markers - place) < half + 8, axis=1).sum()
            crossed = np.all(np.abs(paths - place) < half, axis=1).mean()
            out = np.maximum(room[:2] - low, 0).sum() + np.maximum(high - room[2:], 0).sum()
            overlap = sum(float(np.prod(part)) for part in over)
            below = 60 * (place[1] < marker[1] and not heights)  # Ticks stand there in 3D.
            costs.append(overlap + 500 * hidden + 2000 * crossed + 30 * out + 4 * rank + below)
        best = places[int(np.argmin(costs))]
        taken.append(np.concatenate([best - half, best + half]))
        axes.annotate(
            text, best, xycoords="figure pixels", ha="center", va="center", zorder=5.5,
            annotation_clip=False, **TEXT,
        )  # fmt: skip


def _title(fleet: FleetProgress) -> str:
    name = fleet.scene.name
    name = name if len(name) <= 40 else name[:39] + "…"
    if fleet.makespan is not None:
        ended = f"makespan {fleet.makespan:.2f} s"
    else:
        done = "" if fleet.complete else ", not completed"
        ended = f"{fleet.duration:.2f} s{done}"
    return f"{name}, {fleet.title}: {ended}"


def _finish(figure: Figure, path: Path, fleet: FleetProgress, moving: bool) -> Figure:
    """Adds title and legend outside of the data; then writes the file."""
    figure.suptitle(_title(fleet), fontsize=15, x=0.5, y=0.972)
    marker: dict[str, Any] = {"linestyle": "", "markersize": 9}
    handles: dict[str, Any] = {
        f"{fleet.name(m)}, {flown.trajectory.duration:.1f} s": Line2D(
            [], [], color=fleet.colour(m), linewidth=3, path_effects=EDGED
        )
        for m, flown in enumerate(fleet.flights)
    }
    handles["item, collected\nby that UAV"] = Line2D(
        [], [], color="#999999", marker="o", markeredgecolor="white", **marker
    )
    if fleet.collected(fleet.arrivals) < len(fleet.scene.items):
        handles["not collected"] = Line2D(
            [], [], color="white", marker="o", markeredgecolor=BLACK, **marker
        )
    handles["depot"] = Line2D([], [], color=HOME, marker="s", markeredgecolor="white", **marker)
    if _failed(fleet):
        handles["end of flight"] = Line2D(
            [], [], color=BLACK, marker="X", markeredgecolor="white", **marker
        )
    if moving:
        handles["moving box"] = Rectangle((0, 0), 1, 1, **MOVING)
    if figure.axes[0].name != "3d":
        handles["box, z range (m)"] = Rectangle((0, 0), 1, 1, color="#AAAAAA")
    if fleet.scene.no_fly:
        handles["no-fly zone"] = Rectangle((0, 0), 1, 1, **NO_FLY)
    figure.legend(
        list(handles.values()), list(handles), loc="upper left", bbox_to_anchor=(0.845, 0.90),
        frameon=False, fontsize=10.5 if len(handles) < 30 else 7.5, handletextpad=0.5,
        labelspacing=0.6,
    )  # fmt: skip
    save(figure, path)
    return figure
