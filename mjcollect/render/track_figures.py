"""Draws the tracks of many flights of one mission from above and from the side, as a PNG file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle

from mjcollect.envs.disturbed import HOME, DisturbedFlight, DisturbedFlights
from mjcollect.geometry.compiled import Array
from mjcollect.geometry.turns import FLOOR, around, corners
from mjcollect.render.path_figures import EDGE, MOVING, TEXT, draw_moving
from mjcollect.render.time_figures import BLACK, BLUE, LABEL, ORANGE, RED, save
from mjcollect.render.time_figures import figure as new_figure
from mjcollect.scene.air import Air
from mjcollect.scene.order import DEPOT
from mjcollect.scene.scene import Scene

SIZE = (16.0, 8.0)  # inches
ROOM = (0.045, 0.075, 0.80, 0.83)  # left, bottom, width, height of both views together
GAP = 0.055  # Between the views so much of the figure is free.
SIDE = [0, 4, 5, 1]  # corners of the side of a box that is nearest to the eye
THIN: dict[str, Any] = {"color": BLUE, "linewidth": 0.8, "alpha": 0.45, "zorder": 4}
FAILED: dict[str, Any] = {"color": RED, "linewidth": 0.8, "alpha": 0.4, "zorder": 4.5}
ENDED: dict[str, Any] = {"color": RED, "marker": "X", "s": 42, "edgecolor": "white", "zorder": 7}
VIEWS = ((0, 1, "x (m)", "y (m)", "from above"), (0, 2, "x (m)", "z (m)", "from the side"))


def plot_tracks(path: Path, scene: Scene, order: Sequence[int], flown: DisturbedFlights) -> Figure:
    """Draws all flights among the boxes, those that failed in red with a mark where they ended.

    Boxes that move and the wind of most colour are those of the flight that is shown elsewhere.

    Args:
        path: PNG to write, 1920 by 960 pixels.
        scene: where it was flown. order: item indices in order of visit.
        flown: the flights.

    Returns:
        The figure, also written to `path`.
    """
    figure = new_figure(*SIZE)
    shown, (low, high) = flown.flights[flown.shown], scene.bounds
    for (across, up, right, above, title), place in zip(VIEWS, _places(high - low), strict=True):
        axes: Any = figure.add_axes(place)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect="equal")
        axes.set_xlabel(right, **LABEL)
        axes.set_ylabel(above, **LABEL)
        axes.set_title(title, size=12, color=BLACK)
        axes.grid(color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=9.5)
        _boxes(axes, scene, across, up)
        if shown.air is not None:
            draw_moving(axes, shown.air.moving, across, up)
        _tracks(axes, scene, flown.flights, across, up)
        _nodes(axes, scene, order, across, up)
    _winds(figure, flown)
    _legend(figure, shown.air)
    figure.suptitle(_title(scene, flown), fontsize=14.5, x=0.5, y=0.975)
    save(figure, path)
    return figure


def _places(extent: Array) -> list[tuple[float, float, float, float]]:
    """Returns the places of both views in the figure, to one scale."""
    left, bottom, width, height = ROOM
    free = (width - GAP) * SIZE[0]
    scale = min(free / (2 * extent[0]), height * SIZE[1] / max(extent[1], extent[2]))
    wide = scale * extent[0] / SIZE[0]
    spare = (width - GAP - 2 * wide) / 2
    tall = [scale * extent[k] / SIZE[1] for k in (1, 2)]
    lefts = (left + spare / 2, left + spare * 1.5 + wide + GAP)
    return [
        (x, bottom + (height - high) / 2, wide, high) for x, high in zip(lefts, tall, strict=True)
    ]


def _boxes(axes: Any, scene: Scene, across: int, up: int) -> None:
    """Draws the boxes, the nearest to the eye last."""
    away = 3 - across - up  # the axis that is looked along
    hulls = around(scene.boxes)
    order = np.argsort(hulls[:, 1, away] if away == 2 else -hulls[:, 0, away])
    floor, ceiling = scene.bounds[:, away]
    for box, hull in zip(scene.boxes[order], hulls[order], strict=True):
        near = (hull[1, away] - floor) if away == 2 else (ceiling - hull[0, away])
        shade = 0.92 - 0.30 * near / (ceiling - floor)
        # From above a box shows how it is turned; from the side, how wide it is.
        outline = corners(box if away == 2 else hull)[FLOOR if away == 2 else SIDE]
        axes.add_patch(
            Polygon(
                outline[:, [across, up]], facecolor=str(shade), edgecolor=EDGE, alpha=0.7,
                linewidth=0.7, zorder=1,
            )
        )  # fmt: skip


def _tracks(
    axes: Any, scene: Scene, flights: Sequence[DisturbedFlight], across: int, up: int
) -> None:
    """Draws the tracks, a point per slot."""
    lines: dict[bool, list[Array]] = {True: [], False: []}
    ends = []
    for flown in flights:
        x = flown.flight.trajectory.x[:, [across, up]]
        rows = np.unique([*range(0, len(x), scene.substeps), len(x) - 1])
        lines[flown.ended == HOME].append(x[rows])
        if flown.ended != HOME:
            ends.append(x[-1])
    for home, style in ((True, THIN), (False, FAILED)):
        axes.add_collection(LineCollection(lines[home], **style))
    if ends:
        axes.scatter(*np.array(ends).T, clip_on=False, **ENDED)


def _nodes(axes: Any, scene: Scene, order: Sequence[int], across: int, up: int) -> None:
    """Draws depot and items, with their place in the order."""
    centre = scene.bounds[:, up].mean()
    low, high = scene.bounds[:, across]
    for node in (DEPOT, *order):
        x, y = scene.point(node)[[across, up]]
        colour, marker = (BLUE, "s") if node == DEPOT else (ORANGE, "o")
        axes.scatter(
            x, y, color=colour, marker=marker, s=80, edgecolor="white", zorder=6, clip_on=False
        )
        label = "depot" if node == DEPOT else f"{node} · stop {order.index(node) + 1}"
        below = y > centre
        side = "left" if x - low < 0.1 * (high - low) else "center"
        side = "right" if high - x < 0.1 * (high - low) else side
        axes.annotate(
            label, (x, y), xytext=(0, -10 if below else 10), textcoords="offset points", ha=side,
            va="top" if below else "bottom", zorder=5.5, **(TEXT | {"size": 9}),
        )  # fmt: skip


def _winds(figure: Figure, flown: DisturbedFlights) -> None:
    """Draws a rose of the winds: an arrow for each flight, the bold one for the one shown."""
    airs = [(each.air, each.ended == HOME) for each in flown.flights if each.air is not None]
    most = max((float(np.linalg.norm(air.wind)) for air, _ in airs), default=0.0)
    if most == 0.0:
        return
    axes: Any = figure.add_axes((0.862, 0.60, 0.125, 0.225))
    axes.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal")
    axes.set_axis_off()
    ring = np.linspace(0.0, 2 * np.pi, 100)
    axes.plot(np.cos(ring), np.sin(ring), color="#BBBBBB", linewidth=0.8)
    for air, home in airs:
        style = THIN if home else FAILED
        axes.plot([0.0, air.wind[0] / most], [0.0, air.wind[1] / most], **style)
    shown = flown.flights[flown.shown].air
    assert shown is not None
    axes.annotate(
        "", shown.wind[:2] / most, (0.0, 0.0), zorder=9,
        arrowprops={"arrowstyle": "-|>,head_length=0.6,head_width=0.3", "color": BLACK,
                    "linewidth": 2.2, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip
    axes.set_title(f"wind from above, {most:.1f} m/s²", size=11, color=BLACK)


def _legend(figure: Figure, air: Air | None) -> None:
    handles: dict[str, Any] = {
        "came home": Line2D([], [], **{**THIN, "linewidth": 1.6, "alpha": 0.9}),
        "failed": Line2D([], [], **{**FAILED, "linewidth": 1.6, "alpha": 0.9}),
        "where it ended": Line2D(
            [], [], color=RED, marker="X", linestyle="", markersize=8, markeredgecolor="white"
        ),
        "item": Line2D(
            [], [], color=ORANGE, marker="o", linestyle="", markersize=9, markeredgecolor="white"
        ),
        "depot": Line2D(
            [], [], color=BLUE, marker="s", linestyle="", markersize=9, markeredgecolor="white"
        ),
        "box": Rectangle((0, 0), 1, 1, facecolor="#BBBBBB", edgecolor=EDGE),
    }
    if air is not None and air.moving:
        handles["moving box of\nthe flight shown"] = Rectangle((0, 0), 1, 1, **MOVING)
    if air is not None and np.any(air.wind):
        handles["wind of the\nflight shown"] = Line2D([], [], color=BLACK, linewidth=2.2)
    figure.legend(
        list(handles.values()), list(handles), loc="upper left", bbox_to_anchor=(0.862, 0.57),
        frameon=False, fontsize=10.5, handletextpad=0.6, labelspacing=0.7,
    )  # fmt: skip


def _title(scene: Scene, flown: DisturbedFlights) -> str:
    name = scene.name if len(scene.name) <= 40 else scene.name[:39] + "…"
    parts = [f"{count} {end}" for end, count in flown.ended.items() if count]
    many = "flight" if len(flown.flights) == 1 else "flights"
    return f"{name}, {len(flown.flights)} {many}: {', '.join(parts)}"
