"""Draws the paper's figures of flights: its three schemes in 3D and from above."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.render.path_figures import draw_boxes_3d, draw_boxes_top
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, RED, figure, save
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory
from train.reproduction.paper import SCHEMES, scheme_name
from train.reproduction.plan import Order, Plan
from train.reproduction.running import cell_folder

STYLES: tuple[tuple[str, Any], ...] = (
    (GREEN, "-"),
    (BLUE, (0, (5, 2))),
    (RED, (0, (1.5, 1.5))),
)
MOST_POINTS = 1500


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
    space: Any = made.add_axes((0.0, 0.09, 0.50, 0.85), projection="3d", computed_zorder=False)
    top: Any = made.add_axes((0.555, 0.14, 0.425, 0.78))
    low, high = scene.bounds
    draw_boxes_3d(space, scene.obstacles)
    draw_boxes_top(top, scene)
    handles = []
    for number, (name, (order, flight)) in enumerate(flights.items()):
        x = np.concatenate([flight.x[:: max(1, len(flight.x) // MOST_POINTS)], flight.x[-1:]])
        colour, dashes = STYLES[number]
        style: Mapping[str, Any] = {
            "color": colour, "linestyle": dashes, "linewidth": 2.6 - 0.3 * number,
            "zorder": 4 + number,
        }  # fmt: skip
        label = f"{name}: {flight.duration:.1f} s (order {', '.join(map(str, order))})"
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
