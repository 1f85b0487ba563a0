"""Figures of a flight and of learning, as PNG files; no global matplotlib state is touched."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from mjcollect.geometry.compiled import Array
from mjcollect.render.arrivals import Progress, progress
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, ORANGE, RED, flight_title, save
from mjcollect.render.time_figures import figure as new_figure
from mjcollect.scene.scene import Scene
from mjcollect.trajectory import Trajectory

SPEED_MAP = "viridis"
GUIDANCE: dict[str, Any] = {"color": BLACK, "linestyle": (0, (4, 3)), "linewidth": 1.2}
END: dict[str, Any] = {"color": RED, "marker": "X", "s": 45, "edgecolor": "white", "zorder": 7}
TEXT: dict[str, Any] = {
    "size": 10,
    "weight": "bold",
    "color": BLACK,
    "bbox": {"boxstyle": "round,pad=0.18", "facecolor": "white", "alpha": 0.8, "edgecolor": "none"},
}
MARGIN = 0.12  # of a segment's extent, left free around it
BOX_FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)


def plot_path_3d(
    path: str | os.PathLike[str],
    scene: Scene,
    trajectory: Trajectory,
    order: Sequence[int],
    segment: int | None = None,
    guidance_path: Array | None = None,
) -> Figure:
    """Flown path among the boxes in three dimensions, coloured by speed.

    Args:
        path: PNG to write, 1440 by 1200 pixels.
        scene, trajectory, order: what was flown.
        segment: 0..K to show one segment from near; None for the mission.
        guidance_path: (N, 3) shortest path, drawn dashed.

    Returns:
        The figure, also written to `path`.
    """
    done = progress(scene, trajectory, order, segment)
    figure = new_figure(12, 10)
    axes: Any = figure.add_axes((0.0, 0.02, 0.86, 0.93), projection="3d", computed_zorder=False)
    low, high = _window(scene, trajectory, done, segment, guidance_path)
    draw_boxes_3d(axes, _clipped(scene.obstacles, low, high))
    pieces, speed = _pieces(trajectory)
    shadow = pieces * [1, 1, 0] + low * [0, 0, 1]
    axes.add_collection3d(
        Line3DCollection(shadow, colors="black", alpha=0.18, linewidth=1.5, zorder=2)
    )
    lines = Line3DCollection(pieces, linewidth=3, zorder=4, **_by_speed(scene))
    lines.set_array(speed)
    axes.add_collection3d(lines)
    if guidance_path is not None:
        axes.plot(*guidance_path.T, zorder=3, **GUIDANCE)
    for node, colour, marker, size in _nodes(scene, done, segment):
        point = scene.point(node)
        if np.any(point < low) or np.any(point > high):
            continue
        foot = np.array([*point[:2], low[2]])
        axes.plot(*np.stack([point, foot]).T, color=colour, alpha=0.5, linewidth=0.8, zorder=3)
        axes.scatter(
            *point,
            color=colour,
            marker=marker,
            s=size,
            edgecolor="white",
            depthshade=False,
            zorder=6,
        )
        above = point + (high - low) * [0, 0, 0.025]
        axes.text(*above, _label(node, order), ha="center", va="bottom", zorder=8, **TEXT)
    axes.scatter(*trajectory.x[-1], depthshade=False, **END)
    for name, least, most in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{name}lim")(least, most)
        getattr(axes, f"set_{name}label")(f"{name} (m)", labelpad=9, **LABEL)
        axes.tick_params(axis=name, labelsize=9.5)
    axes.set_box_aspect(high - low)
    axes.view_init(elev=24, azim=-58)
    _finish(figure, path, scene, trajectory, order, segment, lines, guidance_path is not None)
    return figure


def plot_path_top(
    path: str | os.PathLike[str],
    scene: Scene,
    trajectory: Trajectory,
    order: Sequence[int],
    segment: int | None = None,
    guidance_path: Array | None = None,
) -> Figure:
    """The same from above: boxes shaded by the height of their tops, arrows along the path.

    See `plot_path_3d` for the arguments.
    """
    done = progress(scene, trajectory, order, segment)
    figure = new_figure(12, 10)
    axes = figure.add_axes((0.075, 0.085, 0.76, 0.83))
    low, high = _window(scene, trajectory, done, segment, guidance_path)
    draw_boxes_top(axes, scene)
    _box_heights(axes, scene, trajectory, low, high)
    pieces, speed = _pieces(trajectory)
    flat = list(pieces[..., :2])
    lines = LineCollection(flat, linewidth=3.2, capstyle="round", zorder=4, **_by_speed(scene))
    lines.set_array(speed)
    axes.add_collection(LineCollection(flat, colors="white", linewidth=5.2, zorder=3))
    axes.add_collection(lines)
    _arrows(axes, trajectory, done)
    if guidance_path is not None:
        axes.plot(*guidance_path.T[:2], zorder=4.5, **GUIDANCE)
    side = (high - low)[0]
    for node, colour, marker, size in _nodes(scene, done, segment):
        point = scene.point(node)
        x, y = point[:2]
        if np.any(point[:2] < low[:2]) or np.any(point[:2] > high[:2]):
            continue
        axes.scatter(
            x, y, color=colour, marker=marker, s=1.3 * size, edgecolor="white", zorder=6,
            clip_on=False,
        )  # fmt: skip
        above = y < high[1] - 0.08 * side
        across = "center"
        if min(x - low[0], high[0] - x) < 0.1 * side:
            across = "left" if x - low[0] < high[0] - x else "right"
        axes.annotate(
            f"{_label(node, order)} · z {point[2]:.0f} m", (x, y), xytext=(0, 12 if above else -12),
            textcoords="offset points", ha=across, va="bottom" if above else "top", zorder=8,
            **TEXT,
        )  # fmt: skip
    axes.scatter(*trajectory.x[-1, :2], clip_on=False, **END)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel("x (m)", **LABEL)
    axes.set_ylabel("y (m)", **LABEL)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    _finish(figure, path, scene, trajectory, order, segment, lines, guidance_path is not None)
    return figure


# Shared parts


def _by_speed(scene: Scene) -> dict[str, Any]:
    return {"cmap": SPEED_MAP, "norm": Normalize(0, scene.v_max)}


def _label(node: int, order: Sequence[int]) -> str:
    """'item 3 · stop 2': index and place in the visiting order."""
    return "depot" if node < 0 else f"item {node} · stop {list(order).index(node) + 1}"


def draw_boxes_3d(axes: Any, boxes: Array) -> None:
    """Draw boxes (M, 2, 3) in three dimensions."""
    for box in boxes:
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(8, 3)
        axes.add_collection3d(
            Poly3DCollection(
                corners[BOX_FACES], facecolor="#8899AA", edgecolor="#5A6672", alpha=0.16,
                linewidth=0.5, zorder=1,
            )
        )  # fmt: skip


def draw_boxes_top(axes: Any, scene: Scene) -> None:
    """Draw a scene's boxes from above, darker the higher their tops."""
    floor, ceiling = scene.bounds[:, 2]
    for box in sorted(scene.obstacles, key=lambda box: float(box[1, 2])):
        shade = 0.90 - 0.42 * (box[1, 2] - floor) / (ceiling - floor)
        width, depth = (box[1] - box[0])[:2]
        axes.add_patch(
            Rectangle(
                (box[0, 0], box[0, 1]), width, depth, facecolor=str(shade), edgecolor="#5A6672",
                alpha=0.75, linewidth=0.8, zorder=1,
            )
        )  # fmt: skip


def _pieces(trajectory: Trajectory, most: int = 1500) -> tuple[Array, Array]:
    """Line pieces (P, 2, 3) of the path and the speed (P,) on each."""
    rows = np.unique(
        np.linspace(0, len(trajectory) - 1, min(len(trajectory), most)).round().astype(int)
    )
    points = trajectory.x[rows]
    if len(points) == 1:
        points = np.repeat(points, 2, axis=0)
    speed = np.linalg.norm(trajectory.v[rows], axis=1)
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    return pieces, speed[: len(pieces)] if len(speed) <= len(pieces) else (
        speed[:-1] + speed[1:]
    ) / 2


def _window(
    scene: Scene,
    trajectory: Trajectory,
    done: Progress,
    segment: int | None,
    guidance: Array | None,
) -> tuple[Array, Array]:
    """Limits of the picture: the bounds, or a cube that the segment fills."""
    low, high = scene.bounds[0].copy(), scene.bounds[1].copy()
    if segment is None:
        return low, high
    ends = [scene.point(done.start), scene.point(done.targets[0])]
    shown = np.concatenate([trajectory.x, ends, *([] if guidance is None else [guidance])])
    least, most = shown.min(axis=0), shown.max(axis=0)
    side = max(float(np.max(most - least)), 20 * scene.epsilon) * (1 + 2 * MARGIN)
    side = np.minimum(side, high - low)
    # A cube around the segment, moved back inside the bounds.
    start = np.clip((least + most) / 2 - side / 2, low, high - side)
    return start, start + side


def _clipped(boxes: Array, low: Array, high: Array) -> Array:
    """The parts of boxes (M, 2, 3) inside the window."""
    cut = np.clip(boxes, low, high)
    return np.asarray(cut[np.all(cut[:, 1] > cut[:, 0], axis=-1)])


def _nodes(scene: Scene, done: Progress, segment: int | None) -> list[tuple[int, str, str, float]]:
    """Node, colour, marker and size, the ends of a segment emphasised."""
    ends = (done.start, *done.targets)
    reached = done.collected(len(done.rows))
    drawn = []
    for node in range(-1, len(scene.items)):
        colour = BLUE if node < 0 else GREEN if node in reached else ORANGE
        big = segment is not None and node in ends
        drawn.append(
            (node, colour, "s" if node < 0 else "o", 170.0 if big else 110.0 if node < 0 else 80.0)
        )
    return drawn


def _box_heights(axes: Any, scene: Scene, trajectory: Trajectory, low: Array, high: Array) -> None:
    """Write each box's bottom and top where neither path nor items nor other texts are near."""
    nodes = np.concatenate([scene.items, scene.depot[None]])
    # Texts are wide: distances count along x a third.
    wide = np.array([1 / 3, 1.0]) / (high - low)[:2]
    labels = nodes + np.array([0.0, 0.03, 0.0]) * (high - low)
    taken = np.concatenate([trajectory.x[::10], nodes, labels])
    taken = taken[:, :2] * wide
    shares = np.array([[0.5, 0.5], [0.5, 0.2], [0.5, 0.8], [0.3, 0.5], [0.7, 0.5]])
    for box in scene.obstacles:
        seen = np.clip(box, low, high)[:, :2]
        places = seen[0] + shares * (seen[1] - seen[0])
        room = np.linalg.norm(places[:, None] * wide - taken, axis=-1).min(axis=1)
        edge = np.minimum(places - low[:2], high[:2] - places).min(axis=1) / (high - low)[0]
        room = np.where(edge > 0.04, room, 0.0)
        best = int(np.argmax(room + 0.02 * (np.arange(5) == 0)))
        if room[best] > 0.018:
            axes.text(
                *places[best], f"{box[0, 2]:.0f}–{box[1, 2]:.0f}", size=8, color="#39424C",
                ha="center", va="center", zorder=2,
            )  # fmt: skip
            taken = np.concatenate([taken, places[best : best + 1] * wide])


def _arrows(axes: Any, trajectory: Trajectory, done: Progress) -> None:
    """An arrow head at the middle of each segment."""
    rows = [0, *done.rows]
    if len(done.rows) < len(done.targets):
        rows.append(len(trajectory) - 1)
    for first, last in pairwise(rows):
        x = trajectory.x[first : last + 1, :2]
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))])
        if travelled[-1] < 1.0:
            continue
        tail, head = (
            [np.interp(share * travelled[-1], travelled, column) for column in x.T]
            for share in (0.47, 0.53)
        )
        axes.annotate("", head, tail, zorder=5, annotation_clip=True, arrowprops={
            "arrowstyle": "-|>,head_length=0.75,head_width=0.42", "color": BLACK, "linewidth": 0,
            "shrinkA": 0, "shrinkB": 0,
        })  # fmt: skip


def _finish(
    figure: Figure, path: str | os.PathLike[str], scene: Scene, trajectory: Trajectory,
    order: Sequence[int], segment: int | None, lines: Any, guidance: bool,
) -> None:  # fmt: skip
    """Title, colour bar and legend outside of the data; then write."""
    figure.suptitle(flight_title(scene, trajectory, order, segment), fontsize=15, x=0.5, y=0.972)
    bar = figure.colorbar(
        ScalarMappable(lines.norm, lines.cmap), cax=figure.add_axes((0.875, 0.36, 0.02, 0.50))
    )
    bar.set_label("speed (m/s)", **LABEL)
    bar.ax.tick_params(labelsize=9.5)

    def dot(colour: str, marker: str) -> Line2D:
        style = {"color": colour, "marker": marker, "markersize": 9, "markeredgecolor": "white"}
        return Line2D([], [], linestyle="", **style)  # type: ignore[arg-type]

    handles: dict[str, Any] = {
        "collected": dot(GREEN, "o"),
        "not collected": dot(ORANGE, "o"),
        "depot": dot(BLUE, "s"),
        "end of flight": dot(RED, "X"),
    }
    if guidance:
        handles["shortest path"] = Line2D([], [], **GUIDANCE)
    if lines.axes.name != "3d":
        handles["box, z from–to (m)"] = Rectangle((0, 0), 1, 1, color="#AAAAAA")
    figure.legend(
        list(handles.values()), list(handles), loc="lower left", bbox_to_anchor=(0.845, 0.09),
        frameon=False, fontsize=10.5, handletextpad=0.4,
    )  # fmt: skip
    save(figure, path)
