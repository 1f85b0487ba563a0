"""The paper's figures of flights: its three schemes in one plot, in 3D and from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjcollect.render.path_figures import draw_boxes_3d, draw_boxes_top
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, RED, figure, save
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

COLOURS = (GREEN, BLUE, RED)
STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)))
MOST_POINTS = 1500


@dataclass(frozen=True)
class Flown:
    """One scheme's flight: its name, the order as flown, and the record."""

    name: str
    order: Sequence[int]
    trajectory: Trajectory


def plot_schemes(path: Path, scene: Scene, title: str, flights: Sequence[Flown]) -> Figure:
    """Draw flights of one scene over each other, 3D on the left, from above on the right.

    Args:
        path: PNG to write, 1800 by 960 pixels.
    """
    made = figure(15, 8)
    space: Any = made.add_axes((0.0, 0.09, 0.50, 0.85), projection="3d", computed_zorder=False)
    top: Any = made.add_axes((0.555, 0.14, 0.425, 0.78))
    low, high = scene.bounds
    draw_boxes_3d(space, scene.obstacles)
    draw_boxes_top(top, scene)
    handles = []
    for number, flight in enumerate(flights):
        x = _thinned(flight.trajectory.x)
        style: Mapping[str, Any] = {
            "color": COLOURS[number % 3], "linestyle": STYLES[number % 3],
            "linewidth": 2.6 - 0.3 * number, "zorder": 4 + number,
        }  # fmt: skip
        stops = ", ".join(map(str, flight.order))
        label = f"{flight.name}: {flight.trajectory.duration:.1f} s (order {stops})"
        handles += space.plot(*x.T, label=label, **style)
        top.plot(*x.T[:2], **style)
    for node in range(-1, len(scene.items)):
        point = scene.point(node)
        marker: Mapping[str, Any] = {
            "color": BLACK, "marker": "s" if node < 0 else "o", "s": 55, "edgecolor": "white",
            "zorder": 9,
        }  # fmt: skip
        space.scatter(*point, depthshade=False, **marker)
        top.scatter(*point[:2], clip_on=False, **marker)
        name = "depot" if node < 0 else str(node)
        space.text(
            *point[:2], point[2] + 0.03 * (high - low)[2], name, ha="center", zorder=10, size=10
        )
        top.annotate(name, point[:2], xytext=(6, 6), textcoords="offset points", zorder=10, size=10)
    for letter, least, most in zip("xyz", low, high, strict=True):
        for axes in (space, top) if letter != "z" else (space,):
            getattr(axes, f"set_{letter}lim")(least, most)
            getattr(axes, f"set_{letter}label")(f"{letter} (m)", **LABEL)
            axes.tick_params(labelsize=9)
    space.set_box_aspect(high - low)
    space.view_init(elev=24, azim=-58)
    top.set_aspect("equal")
    made.suptitle(title, fontsize=14, y=0.975)
    made.legend(handles=handles, loc="lower center", ncol=3, frameon=False, fontsize=10)
    save(made, path)
    return made


def _thinned(points: np.ndarray) -> np.ndarray:
    step = max(1, len(points) // MOST_POINTS)
    return np.concatenate([points[::step], points[-1:]])
