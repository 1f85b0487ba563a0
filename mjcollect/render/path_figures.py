"""Draws a flown path in three dimensions and from above, as PNG files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from mjcollect.geometry.compiled import Array
from mjcollect.geometry.polyline import interpolate, marks
from mjcollect.geometry.turns import FLOOR, around, corners
from mjcollect.render.arrivals import Progress
from mjcollect.render.overlay import SPEED_MAP
from mjcollect.render.time_figures import (
    BLACK,
    BLUE,
    GREEN,
    LABEL,
    ORANGE,
    PURPLE,
    RED,
    flight_title,
    save,
)
from mjcollect.render.time_figures import figure as new_figure
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.order import DEPOT, node_name
from mjcollect.scene.scene import Scene

Place = tuple[float, float, float, float]  # left, bottom, width, height as shares of the figure
MOST_PIECES = 1500  # More pieces of a path cannot be told apart, and take long to draw.
GUIDANCE: dict[str, Any] = {"color": BLACK, "linestyle": (0, (4, 3)), "linewidth": 1.2}
END: dict[str, Any] = {"color": RED, "marker": "X", "s": 45, "edgecolor": "white", "zorder": 7}
TEXT: dict[str, Any] = {
    "size": 10,
    "weight": "bold",
    "color": BLACK,
    "bbox": {"boxstyle": "round,pad=0.18", "facecolor": "white", "alpha": 0.8, "edgecolor": "none"},
}
EDGE = "#5A6672"  # Boxes have edges of this colour.
WAY: dict[str, Any] = {"color": PURPLE, "linestyle": (0, (4, 2)), "linewidth": 1.4, "zorder": 3}
MOVING: dict[str, Any] = {"facecolor": "#CC79A755", "edgecolor": PURPLE, "linewidth": 1.4}
MARGIN = 0.12  # This share of a segment's extent is left free around it.
NO_FLY: dict[str, Any] = {
    "facecolor": "#D5402E",
    "edgecolor": "#8C2114",
    "alpha": 0.22,
    "hatch": "//",
}
BOX_FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)


def plot_path_3d(
    path: Path,
    done: Progress,
    guidance_path: Array | None = None,
    moving: Sequence[MovingBox] = (),
) -> Figure:
    """Draws the flown path among the boxes in three dimensions, coloured by speed.

    Args:
        path: PNG to write, 1440 by 1200 pixels.
        done: what was flown; a segment is shown from near.
        guidance_path: (N, 3) shortest path, drawn dashed.
        moving: boxes that moved, drawn where they were at first, their ways dashed.

    Returns:
        The figure, also written to `path`.
    """
    figure = new_figure(12, 10)
    low, high = _window(done, guidance_path)
    axes = axes_3d(figure, (0.0, 0.02, 0.86, 0.93), low, high)
    draw_scene_3d(axes, done.scene, low, high, moving)
    pieces, by_speed = _pieces(done)
    shadow = pieces * [1, 1, 0] + low * [0, 0, 1]
    axes.add_collection3d(
        Line3DCollection(shadow, colors="black", alpha=0.18, linewidth=1.5, zorder=2)
    )
    axes.add_collection3d(Line3DCollection(pieces, linewidth=3, zorder=4, **by_speed))
    if guidance_path is not None:
        axes.plot(*guidance_path.T, zorder=3, **GUIDANCE)
    for point, label, style in _nodes(done, low, high):
        foot = np.array([*point[:2], low[2]])
        line = {"color": style["color"], "alpha": 0.5, "linewidth": 0.8}
        axes.plot(*np.stack([point, foot]).T, zorder=3, **line)
        axes.scatter(*point, depthshade=False, **style)
        above = point + (high - low) * [0, 0, 0.025]
        axes.text(*above, label, ha="center", va="bottom", zorder=5.5, **TEXT)
    axes.scatter(*done.trajectory.x[-1], depthshade=False, **END)
    return _finish(figure, path, done, by_speed, guidance_path is not None, bool(moving))


def plot_path_top(
    path: Path,
    done: Progress,
    guidance_path: Array | None = None,
    moving: Sequence[MovingBox] = (),
) -> Figure:
    """Draws the same from above: boxes shaded by the height of their tops, arrows along the path.

    See `plot_path_3d` for the arguments.
    """
    figure = new_figure(12, 10)
    low, high = (corner[:2] for corner in _window(done, guidance_path))
    axes = axes_top(figure, (0.075, 0.085, 0.76, 0.83), low, high)
    draw_boxes_top(axes, done.scene)
    draw_moving(axes, moving, 0, 1)
    box_heights(axes, done.scene, done.trajectory.x[::10, :2], low, high)
    pieces, by_speed = _pieces(done)
    flat = list(pieces[..., :2])
    axes.add_collection(LineCollection(flat, colors="white", linewidth=5.2, zorder=3))
    axes.add_collection(LineCollection(flat, linewidth=3.2, capstyle="round", zorder=4, **by_speed))
    arrows(axes, done)
    if guidance_path is not None:
        axes.plot(*guidance_path.T[:2], zorder=4.5, **GUIDANCE)
    side = (high - low)[0]
    for (x, y, z), label, style in _nodes(done, low, high):
        axes.scatter(x, y, clip_on=False, **style | {"s": 1.3 * style["s"]})
        above = y < high[1] - 0.08 * side
        across = "center"
        if min(x - low[0], high[0] - x) < 0.1 * side:
            across = "left" if x - low[0] < high[0] - x else "right"
        axes.annotate(
            f"{label} · z {z:.0f} m", (x, y), xytext=(0, 12 if above else -12),
            textcoords="offset points", ha=across, va="bottom" if above else "top", zorder=5.5,
            **TEXT,
        )  # fmt: skip
    axes.scatter(*done.trajectory.x[-1, :2], clip_on=False, **END)
    return _finish(figure, path, done, by_speed, guidance_path is not None, bool(moving))


# Shared parts


def axes_3d(figure: Figure, place: Place, low: Array, high: Array) -> Any:
    """Returns axes at a place in the figure that show the box from low (3,) to high (3,), in m."""
    axes: Any = figure.add_axes(place, projection="3d", computed_zorder=False)
    for name, least, most in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{name}lim")(least, most)
        getattr(axes, f"set_{name}label")(f"{name} (m)", labelpad=9, **LABEL)
    axes.tick_params(labelsize=9.5)
    axes.set_box_aspect(high - low)
    axes.view_init(elev=24, azim=-58)
    return axes


def axes_top(figure: Figure, place: Place, low: Array, high: Array) -> Any:
    """Returns such axes for the view from above; of `low` and `high` the height does not count."""
    axes = figure.add_axes(place)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel("x (m)", **LABEL)
    axes.set_ylabel("y (m)", **LABEL)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def draw_scene_3d(
    axes: Any, scene: Scene, low: Array, high: Array, moving: Sequence[MovingBox]
) -> None:
    """Draws boxes and no-fly zones in three dimensions as far as they lie in a window."""
    draw_boxes_3d(axes, _within(scene, low, high, no_fly=False))
    draw_boxes_3d(axes, _within(scene, low, high, no_fly=True), **NO_FLY)
    for box in moving:
        axes.plot(*np.array(box.path).T, **WAY)
        draw_boxes_3d(axes, box.box_at(0.0)[None], **MOVING)


def _within(scene: Scene, low: Array, high: Array, no_fly: bool) -> Array:
    """Returns the bodies or no-fly zones (M, 2 or 3, 3) in a window, cut to it if not turned."""
    boxes, hull = scene.boxes.copy(), np.clip(around(scene.boxes), low, high)
    if len(boxes) == 0:
        return boxes
    still = scene.yaw == 0.0
    boxes[still, :2] = hull[still]
    boxes[:, :2, 2] = hull[:, :, 2]
    kind = np.isin(np.arange(len(boxes)), scene.no_fly) == no_fly
    return boxes[kind & np.all(hull[:, 1] > hull[:, 0], axis=-1)]


def draw_boxes_3d(axes: Any, boxes: Array, **style: Any) -> None:
    """Draws boxes (M, 2 or 3, 3) in three dimensions, in any other style if one is given."""
    style = {"facecolor": "#8899AA", "edgecolor": EDGE, "alpha": 0.16, "linewidth": 0.5} | style
    for at in corners(boxes):
        axes.add_collection3d(Poly3DCollection(at[BOX_FACES], zorder=1, **style))


def draw_boxes_top(axes: Any, scene: Scene) -> None:
    """Draws a scene's boxes from above, darker the higher their tops."""
    floor, ceiling = scene.bounds[:, 2]
    for index in np.argsort(scene.boxes[:, 1, 2], kind="stable"):
        box = scene.boxes[index]
        shade = 0.90 - 0.42 * (box[1, 2] - floor) / (ceiling - floor)
        style: dict[str, Any] = {
            "facecolor": str(shade),
            "edgecolor": EDGE,
            "alpha": 0.75,
            "linewidth": 0.8,
        }
        style = NO_FLY if index in scene.no_fly else style
        axes.add_patch(Polygon(corners(box)[FLOOR, :2], zorder=1, **style))


def draw_moving(axes: Any, moving: Sequence[MovingBox], across: int, up: int) -> None:
    """Draws moving boxes where they are at first, and their ways dashed, over two of the axes."""
    for box in moving:
        axes.plot(*np.array(box.path)[:, [across, up]].T, **WAY)
        corners = box.box_at(0.0)[:, [across, up]]
        axes.add_patch(Rectangle(tuple(corners[0]), *(corners[1] - corners[0]), zorder=3, **MOVING))


def _pieces(done: Progress) -> tuple[Array, dict[str, Any]]:
    """Returns line pieces (P, 2, 3) of the path, and the style that colours them by speed."""
    trajectory = done.trajectory
    count = max(2, min(len(trajectory), MOST_PIECES))
    rows = np.linspace(0, len(trajectory) - 1, count).round().astype(int)
    points, speed = trajectory.x[rows], np.linalg.norm(trajectory.v[rows], axis=1)
    style = {"cmap": SPEED_MAP, "norm": Normalize(0, done.scene.v_max)}
    style["array"] = (speed[:-1] + speed[1:]) / 2
    return np.stack([points[:-1], points[1:]], axis=1), style


def _window(done: Progress, guidance: Array | None) -> tuple[Array, Array]:
    """Returns the limits of the picture: the bounds, or a cube that the segment fills."""
    scene, flown = done.scene, done.trajectory.x
    low, high = scene.bounds
    if done.segment is None:
        return low, high
    ends = [scene.point(node) for node in done.nodes]
    shown = np.concatenate([flown, ends, *([] if guidance is None else [guidance])])
    least, most = shown.min(axis=0), shown.max(axis=0)
    side = max(float(np.max(most - least)), 20 * scene.epsilon) * (1 + 2 * MARGIN)
    side = np.minimum(side, high - low)
    # A cube around the segment, moved back inside the bounds.
    start = np.clip((least + most) / 2 - side / 2, low, high - side)
    return start, start + side


def _nodes(done: Progress, low: Array, high: Array) -> Iterator[tuple[Array, str, dict[str, Any]]]:
    """Yields position, label and marker of each node in the window, a segment's ends bigger.

    Labels are 'depot' or 'item 3 · stop 2', with the item's index and place in the order. The
    window has two or three coordinates.
    """
    scene, reached = done.scene, done.collected(len(done.rows))
    ends = () if done.segment is None else done.nodes
    for node in scene.nodes:
        point, label, colour, marker, size = scene.point(node), node_name(node), BLUE, "s", 110.0
        if node > DEPOT:
            label = f"item {node} · stop {done.order.index(node) + 1}"
            colour, marker, size = GREEN if node in reached else ORANGE, "o", 80.0
        style = {"color": colour, "marker": marker, "s": 170.0 if node in ends else size}
        if np.all((point[: len(low)] >= low) & (point[: len(low)] <= high)):
            yield point, label, {**style, "edgecolor": "white", "zorder": 6}


def box_heights(axes: Any, scene: Scene, flown: Array, low: Array, high: Array) -> None:
    """Writes each box's bottom and top where neither path nor items nor other texts are near.

    Of the path there are points (N, 2); `low` and `high` (2,) are the window's corners.
    """
    nodes = np.concatenate([scene.items, scene.depots])[:, :2]
    labels = nodes + np.array([0.0, 0.03]) * (high - low)
    wide = np.array([1 / 3, 1.0]) / (high - low)  # texts are wide: distances count along x a third
    taken = np.concatenate([flown, nodes, labels]) * wide
    shares = np.array([[0.5, 0.5], [0.5, 0.2], [0.5, 0.8], [0.3, 0.5], [0.7, 0.5]])
    for box in around(scene.boxes):
        seen = np.clip(box[:, :2], low, high)
        places = seen[0] + shares * (seen[1] - seen[0])
        room = np.linalg.norm(places[:, None] * wide - taken, axis=-1).min(axis=1)
        edge = np.minimum(places - low, high - places).min(axis=1) / (high - low)[0]
        room = np.where(edge > 0.04, room, 0.0)
        best = int(np.argmax(room + 0.02 * (np.arange(5) == 0)))
        if room[best] > 0.018:
            axes.text(
                *places[best], f"{box[0, 2]:.0f}–{box[1, 2]:.0f}", size=8, color="#39424C",
                ha="center", va="center", zorder=2,
            )  # fmt: skip
            taken = np.concatenate([taken, places[best : best + 1] * wide])


def arrows(axes: Any, done: Progress, edge: float = 0.0) -> None:
    """Draws an arrow head at the middle of each segment, with a white edge of so many points."""
    about = np.array([0.505, 0.495] if edge else [0.53, 0.47])  # An edge follows the shaft, too.
    rows = [0, *done.rows]
    if not done.complete:
        rows.append(len(done.trajectory) - 1)
    for first, last in pairwise(rows):
        flown = done.trajectory.x[first : last + 1]
        travelled = marks(flown[:, :2])
        if travelled[-1] < 1.0:
            continue
        ends = interpolate(flown, travelled, about * travelled[-1])[:, :2]
        axes.annotate("", *ends, zorder=5, annotation_clip=True, arrowprops={
            "arrowstyle": "-|>,head_length=0.75,head_width=0.42", "facecolor": BLACK,
            "edgecolor": "white" if edge else BLACK, "linewidth": edge, "shrinkA": 0, "shrinkB": 0,
        })  # fmt: skip


def _finish(
    figure: Figure, path: Path, done: Progress, by_speed: dict[str, Any], guidance: bool,
    moving: bool,
) -> Figure:  # fmt: skip
    """Adds title, colour bar and legend outside of the data; then writes the file."""
    figure.suptitle(flight_title(done), fontsize=15, x=0.5, y=0.972)
    scale = ScalarMappable(by_speed["norm"], by_speed["cmap"])
    bar = figure.colorbar(scale, cax=figure.add_axes((0.875, 0.36, 0.02, 0.50)))
    bar.set_label("speed (m/s)", **LABEL)
    bar.ax.tick_params(labelsize=9.5)
    style: dict[str, Any] = {"linestyle": "", "markersize": 9, "markeredgecolor": "white"}
    handles: dict[str, Any] = {
        "collected": Line2D([], [], color=GREEN, marker="o", **style),
        "not collected": Line2D([], [], color=ORANGE, marker="o", **style),
        "depot": Line2D([], [], color=BLUE, marker="s", **style),
        "end of flight": Line2D([], [], color=RED, marker="X", **style),
    }
    if guidance:
        handles["shortest path"] = Line2D([], [], **GUIDANCE)
    if moving:
        handles["moving box"] = Rectangle((0, 0), 1, 1, **MOVING)
    if figure.axes[0].name != "3d":
        handles["box, z range (m)"] = Rectangle((0, 0), 1, 1, color="#AAAAAA")
    if done.scene.no_fly:
        handles["no-fly zone"] = Rectangle((0, 0), 1, 1, **NO_FLY)
    figure.legend(
        list(handles.values()), list(handles), loc="lower left", bbox_to_anchor=(0.845, 0.09),
        frameon=False, fontsize=10.5, handletextpad=0.4,
    )  # fmt: skip
    save(figure, path)
    return figure
