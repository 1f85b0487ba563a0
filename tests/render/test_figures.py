"""Figures: their artists against the flight and the metrics, and what reaches the PNG."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection, Text3D
from mpl_toolkits.mplot3d.proj3d import proj_transform
from PIL import Image

from mjcollect.render.arrivals import progress
from mjcollect.render.path_figures import plot_path_3d, plot_path_top
from mjcollect.render.time_figures import plot_learning, plot_speed
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory

BOXES = [
    [[100, 200, 0], [180, 260, 90]],
    [[300, 100, 50], [360, 220, 300]],
    [[700, 700, 600], [900, 800, 900]],
]
ITEMS = [[250, 260, 100], [500, 400, 200], [950, 960, 900]]
ORDER = [1, 0, 2]


@pytest.fixture(scope="module")
def scene() -> Scene:
    bounds = [[0, 0, 0], [1000, 1000, 1000]]
    return Scene("plots", 0, bounds, [0, 0, 0], ITEMS, BOXES)  # type: ignore[arg-type]


def mission(scene: Scene, nodes: list[int]) -> Trajectory:
    """Smooth from node to node, 8 s each, at rest at each."""
    parts = [np.tile(scene.point(nodes[0]), (1, 1))]
    share = (1 - np.cos(np.linspace(0, np.pi, 401)[1:, None])) / 2
    for start, end in pairwise(nodes):
        segment = scene.point(start) + share * (scene.point(end) - scene.point(start))
        parts.append(np.concatenate([segment, segment[-1:]]))
    x = np.concatenate(parts)
    v = np.diff(x, axis=0, prepend=x[:1]) / 0.02
    a = np.diff(v, axis=0, append=np.zeros((1, 3))) / 0.02
    return Trajectory(np.arange(len(x)) * 0.02, x, v, a)


@pytest.fixture(scope="module")
def flown(scene: Scene) -> Trajectory:
    return mission(scene, [-1, *ORDER, -1])


def check_png(path: Path, width: int, height: int) -> None:
    with Image.open(path) as image:
        assert image.size == (width, height)
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.std() > 10
    for edge in (pixels[:4], pixels[-4:], pixels[:, :4], pixels[:, -4:]):
        assert np.all(edge == 255)  # nothing runs off the page


def check_texts_are_on_the_page(figure: Figure) -> None:
    """Every visible text lies inside the figure, and no two titles or labels are empty."""
    renderer = figure.canvas.get_renderer()
    width, height = figure.bbox.size
    texts = [figure._suptitle, *(text for axes in figure.axes for text in axes.texts)]
    texts += [label for axes in figure.axes for label in (axes.xaxis.label, axes.yaxis.label)]
    for text in texts:
        if text is None or not text.get_text() or not text.get_visible():
            continue
        box = text.get_window_extent(renderer)
        if isinstance(text, Text3D):  # its extent is that of the untransformed position
            at = proj_transform(*text.get_position_3d(), text.axes.get_proj())[:2]
            shift = text.axes.transData.transform(at) - (box.x0 + box.width / 2, box.y0)
            box = box.translated(*shift)
        assert box.x0 >= -1, text
        assert box.y0 >= -1, text
        assert box.x1 <= width + 1, text
        assert box.y1 <= height + 1, text


def texts_of(figure: Figure, panel: int = 0) -> str:
    return " | ".join(text.get_text() for text in figure.axes[panel].texts)


def test_path_3d_shows_boxes_items_and_the_path_by_speed(
    scene: Scene, flown: Trajectory, tmp_path: Path
) -> None:
    figure = plot_path_3d(tmp_path / "a.png", progress(scene, flown, ORDER))
    check_png(tmp_path / "a.png", 1440, 1200)
    check_texts_are_on_the_page(figure)
    axes = figure.axes[0]
    boxes = [artist for artist in axes.collections if isinstance(artist, Poly3DCollection)]
    corners = [np.array(box._faces).reshape(-1, 3) for box in boxes]
    for drawn, (low, high) in zip(corners, BOXES, strict=True):
        np.testing.assert_allclose(drawn.min(axis=0), low)
        np.testing.assert_allclose(drawn.max(axis=0), high)
    (path,) = (
        artist
        for artist in axes.collections
        if isinstance(artist, Line3DCollection) and artist.get_array() is not None
    )
    pieces = np.array(path._segments3d)
    np.testing.assert_allclose(pieces[0, 0], flown.x[0])
    np.testing.assert_allclose(pieces[-1, 1], flown.x[-1])
    np.testing.assert_allclose(pieces[1:, 0], pieces[:-1, 1])
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1).sum()
    assert length == pytest.approx(flown.length, rel=1e-3)
    assert path.norm.vmin == 0
    assert path.norm.vmax == scene.v_max
    peak = np.linalg.norm(flown.v, axis=1).max()
    assert path.get_array().max() == pytest.approx(peak, rel=0.01)
    for text in ("item 1 · stop 1", "item 0 · stop 2", "item 2 · stop 3", "depot"):
        assert text in texts_of(figure)
    np.testing.assert_allclose(axes.get_zlim(), (0, 1000))
    title = figure.get_suptitle()
    assert f"{flown.duration:.2f} s" in title
    assert f"{flown.length:.0f} m" in title
    assert "not completed" not in title


def test_a_segment_fills_a_cube_that_holds_both_ends(scene: Scene, tmp_path: Path) -> None:
    flown = mission(scene, [1, 0])
    guidance = np.array([ITEMS[1], [400, 350, 260], ITEMS[0]], dtype=float)
    figure = plot_path_3d(tmp_path / "a.png", progress(scene, flown, ORDER, 1), guidance)
    check_texts_are_on_the_page(figure)
    axes = figure.axes[0]
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    sides = limits[:, 1] - limits[:, 0]
    np.testing.assert_allclose(sides, sides[0])
    assert 250 < sides[0] < 400  # the segment is 250 m wide
    for point in (*guidance, *flown.x):
        assert np.all((point >= limits[:, 0]) & (point <= limits[:, 1]))
    boxes = [artist for artist in axes.collections if isinstance(artist, Poly3DCollection)]
    assert len(boxes) == 1  # of three; cut at the window
    drawn = np.array(boxes[0]._faces).reshape(-1, 3)
    assert np.all(drawn >= limits[:, 0] - 1e-9)
    assert np.all(drawn <= limits[:, 1] + 1e-9)
    assert "item 2" not in texts_of(figure)
    dashed = [line for line in axes.lines if len(line.get_data_3d()[0]) == 3]
    np.testing.assert_allclose(np.array(dashed[0].get_data_3d()).T, guidance)


def test_path_top_is_to_scale_with_an_arrow_a_segment(
    scene: Scene, flown: Trajectory, tmp_path: Path
) -> None:
    figure = plot_path_top(tmp_path / "a.png", progress(scene, flown, ORDER))
    check_png(tmp_path / "a.png", 1440, 1200)
    check_texts_are_on_the_page(figure)
    axes = figure.axes[0]
    across, up = (axes.transData.transform(p) - axes.transData.transform((0, 0)) for p in
                  ((1000, 0), (0, 1000)))  # fmt: skip
    assert across[0] == pytest.approx(up[1], rel=1e-3)
    outlines = [p for p in axes.patches if isinstance(p, Polygon)]
    drawn = sorted([*p.get_xy().min(axis=0), *p.get_xy().max(axis=0)] for p in outlines)
    assert drawn == sorted([*box[0][:2], *box[1][:2]] for box in BOXES)
    shades = {p.get_xy()[:, 0].min(): p.get_facecolor()[0] for p in outlines}
    assert shades[100] > shades[300] > shades[700]  # the higher, the darker
    arrows = [t for t in axes.texts if getattr(t, "arrow_patch", None) is not None]
    assert len(arrows) == 4
    nodes = [scene.point(n)[:2] for n in (-1, *ORDER, -1)]
    for arrow, start, end in zip(arrows, nodes[:-1], nodes[1:], strict=True):
        direction = np.subtract(arrow.xy, arrow.xyann)
        assert direction @ (end - start) > 0.99 * np.linalg.norm(direction) * np.linalg.norm(
            end - start
        )
    paths = [artist for artist in axes.collections if isinstance(artist, LineCollection)]
    np.testing.assert_allclose(paths[-1].get_segments()[0][0], flown.x[0, :2])
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 > axes.get_window_extent().x1  # outside of the data


def test_a_flight_that_ended_early_says_so(scene: Scene, tmp_path: Path) -> None:
    whole = mission(scene, [-1, 1])
    part = Trajectory(*(column[:150] for column in (whole.t, whole.x, whole.v, whole.a)))
    one = Trajectory(*(column[:1] for column in (whole.t, whole.x, whole.v, whole.a)))
    for plot in (plot_path_3d, plot_path_top, plot_speed):
        for flown in (part, one):
            figure = plot(tmp_path / "a.png", progress(scene, flown, ORDER))
            assert "not completed" in figure.get_suptitle()
            check_texts_are_on_the_page(figure)


def test_speed_and_acceleration_against_their_limits(
    scene: Scene, flown: Trajectory, tmp_path: Path
) -> None:
    figure = plot_speed(tmp_path / "a.png", progress(scene, flown, ORDER))
    check_png(tmp_path / "a.png", 1440, 840)
    check_texts_are_on_the_page(figure)
    parts = ((flown.v, scene.v_max), (flown.a, scene.a_max))
    for axes, (values, limit) in zip(figure.axes, parts, strict=True):
        np.testing.assert_allclose(axes.lines[0].get_ydata(), np.linalg.norm(values, axis=1))
        assert set(axes.lines[1].get_ydata()) == {limit}
        stops = sorted(line.get_xdata()[0] for line in axes.lines[2:])
        assert len(stops) == 4
        np.testing.assert_allclose(stops, np.arange(1, 5) * 8.02, atol=0.021)


def metrics() -> dict:
    return {
        "update": [0, 100, 200, 300],
        "env_steps": [0, 1000, 2000, 3000],
        "episode_return": [-14.0, -8.0, float("nan"), -2.0],
        "success_rate": [0.0, 0.2, 0.6, 0.9],
        "eval_success_rate": [0.0, 0.3, 0.5, 1.0],
        "crash_rate": [0.9, 0.4, float("nan"), 0.1],
        "eval_actor_time": [None, None, 13.0, 12.5],
        "critic_loss": [1.0, 0.3, 0.1, 0.05],
        "actor_loss": [-1.0, 2.0, 3.0, 4.0],
        "wall_seconds": [0, 1, 2, 3],
    }


def rows_of(columns: dict) -> list[dict]:
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def test_learning_draws_what_is_there_and_bridges_gaps(tmp_path: Path) -> None:
    figure = plot_learning(tmp_path / "a.png", rows_of(metrics()), bound=12.2, detour=12.4)
    check_png(tmp_path / "a.png", 1440, 1080)
    check_texts_are_on_the_page(figure)
    curves = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    expected = {
        "episode return": ([0, 1000, 3000], [-14, -8, -2]),
        "success, training": ([0, 1000, 2000, 3000], [0, 0.2, 0.6, 0.9]),
        "success, evaluation": ([0, 1000, 2000, 3000], [0, 0.3, 0.5, 1.0]),
        "crashes, training": ([0, 1000, 3000], [0.9, 0.4, 0.1]),
        "actor": ([2000, 3000], [13.0, 12.5]),
        "critic loss": ([0, 1000, 2000, 3000], [1, 0.3, 0.1, 0.05]),
        "actor loss": ([0, 1000, 2000, 3000], [-1, 2, 3, 4]),
    }
    for label, (x, y) in expected.items():
        np.testing.assert_allclose(curves[label].get_xdata(), x)
        np.testing.assert_allclose(curves[label].get_ydata(), y)
    levels = {"bound 12.20": 12.2, "detour 12.40": 12.4}
    assert {label for label in curves if not label.startswith("_")} == {*expected, *levels}
    assert all(set(curves[label].get_ydata()) == {level} for label, level in levels.items())
    for axes in figure.axes:  # legends above the data, within the page
        if axes.get_legend() is not None:
            box = axes.get_legend().get_window_extent()
            assert box.y0 >= axes.get_window_extent().y1 - 1
            assert box.x1 <= figure.bbox.width


def test_learning_of_a_mission_has_a_line_a_segment(tmp_path: Path) -> None:
    one = metrics()
    both = {name: [*values, *values] for name, values in one.items()}
    both["segment"] = [0] * 4 + [1] * 4
    both["eval_success_rate"][4:] = [0.5, 0.6, 0.7, 0.8]
    figure = plot_learning(tmp_path / "a.png", rows_of(both))
    lines = figure.axes[1].lines
    assert [line.get_label() for line in lines] == ["segment 0", "segment 1"]
    np.testing.assert_allclose(lines[1].get_ydata(), [0.5, 0.6, 0.7, 0.8])
    assert not np.array_equal(lines[0].get_color(), lines[1].get_color())


def test_learning_with_next_to_nothing(tmp_path: Path) -> None:
    columns = {"env_steps": [0, 10], "eval_actor_time": [float("nan")] * 2}
    figure = plot_learning(tmp_path / "a.png", rows_of(columns), bound=3.0)
    assert [len(axes.lines) for axes in figure.axes] == [0, 0, 1, 0, 0]
    figure = plot_learning(tmp_path / "a.png", [{"env_steps": 0, "segment": 0}] * 2)
    assert not any(axes.lines for axes in figure.axes)


def test_pyplot_is_not_touched() -> None:
    code = (
        "import sys, mjcollect.render.path_figures; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_moving_boxes_are_drawn_where_they_were_at_first(
    scene: Scene, flown: Trajectory, tmp_path: Path
) -> None:
    path = [[400.0, 300.0, 60.0], [400.0, 600.0, 60.0]]
    box = MovingBox.from_dict({"size": [40, 60, 40], "path": path, "speed": 8.0})
    done = progress(scene, flown, ORDER)
    solid = plot_path_3d(tmp_path / "a.png", done, moving=[box])
    above = plot_path_top(tmp_path / "b.png", done, moving=[box])
    drawn = [part for part in solid.axes[0].collections if isinstance(part, Poly3DCollection)]
    corners = np.array(drawn[len(BOXES)]._faces).reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0), [380, 270, 40])
    np.testing.assert_allclose(corners.max(axis=0), [420, 330, 80])
    flat = [part for part in above.axes[0].patches if part.get_facecolor()[3] < 0.5]
    assert [(*part.get_xy(), part.get_width(), part.get_height()) for part in flat] == [
        (380, 270, 40, 60)
    ]
    for figure, name in ((solid, "a.png"), (above, "b.png")):
        check_png(tmp_path / name, 1440, 1200)
        assert "moving box" in [text.get_text() for text in figure.legends[0].get_texts()]
