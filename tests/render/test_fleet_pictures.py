"""What pictures of fleets are made of, and figures: who is where when, in which colour."""

from __future__ import annotations

import json
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from fleet_runs import BOUND, SHIELDED, TOURS, write_run
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from mjcollect.render import overlay
from mjcollect.render.fleet import UAV_COLOURS, FleetProgress, load_fleet
from mjcollect.render.fleet_figures import plot_fleet_path_3d, plot_fleet_path_top, plot_schedule
from mjcollect.render.overlay import node_look
from mjcollect.render.runs import UnreadableRun
from mjcollect.render.video import render_run
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.order import DEPOT

# What was flown


def test_a_fleet_s_nodes_have_the_numbers_of_the_whole_scene(fleet: FleetProgress) -> None:
    assert [flown.order for flown in fleet.flights] == list(TOURS)
    assert fleet.lead == 1
    assert fleet.idle == (3,)
    assert fleet.complete
    assert fleet.title == "3 of 4 UAVs, 5 items"
    assert fleet.makespan == fleet.duration
    start, under_way = (0, 0, 0), (1, 2, 0)
    assert fleet.collected(start) == 0
    assert fleet.collected(under_way) == 3
    assert fleet.collected(fleet.arrivals) == 5
    assert [fleet.state(node, under_way) for node in range(-1, 5)] == [
        ("depot", 1), ("target", 1), ("collected", 0), ("collected", 1), ("collected", 1),
        ("target", 2),
    ]  # fmt: skip
    assert (fleet.target(start), fleet.target((0, 3, 0)), fleet.target((0, 4, 0))) == (3, -1, None)
    for flown in fleet.flights:
        for node, row in zip(flown.targets, flown.rows, strict=True):
            away = np.linalg.norm(flown.trajectory.x[row] - flown.scene.point(node))
            assert away <= flown.scene.tolerance(node)
    assert len({tuple(flown.scene.depot) for flown in fleet.flights}) == 3


def test_gaps_are_the_least_distances_at_every_instant(fleet: FleetProgress) -> None:
    rows = np.arange(len(fleet.gaps))
    assert len(rows) == len(fleet.flights[fleet.lead].trajectory)
    fine = np.minimum(rows[:-1, None] + np.linspace(0, 1, 101), rows[-1])
    places = [
        np.stack([np.interp(fine, np.arange(len(x)), x[:, k]) for k in range(3)], axis=-1)
        for x in (flown.trajectory.x for flown in fleet.flights)
    ]
    pairs = [np.linalg.norm(a - b, axis=-1).min(axis=1) for a, b in combinations(places, 2)]
    np.testing.assert_allclose(fleet.gaps[:-1], np.min(pairs, axis=0), atol=2e-3)
    assert np.all(fleet.gaps[:-1] <= np.min(pairs, axis=0) + 1e-9)


def test_folders_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    document = json.loads((folder / "fleet.json").read_text())
    document["missions"][0]["items"] = [9]
    (folder / "fleet.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"must lie in 0\.\.4"):
        load_fleet(folder)
    with pytest.raises(UnreadableRun, match="not a readable run"):
        render_run(folder)
    document["missions"] = []
    (folder / "fleet.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="no UAV flew"):
        load_fleet(folder)


# Colours


SEEN = {  # linear RGB as the colour-blind see it (Machado, Oliveira and Fernandes 2009)
    "all": np.eye(3),
    "no red": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "no green": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "no blue": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


# From linear RGB to X, Y, Z, in shares of those of white.
TO_XYZ = np.array([[0.434, 0.376, 0.190], [0.213, 0.715, 0.072], [0.018, 0.109, 0.873]])


@pytest.mark.parametrize("eyes", SEEN)
def test_the_colour_blind_can_tell_eight_uavs_apart(eyes: str) -> None:
    found = []
    for colour in UAV_COLOURS:
        rgb = np.array(to_rgb(colour))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        linear = np.clip(np.array(SEEN[eyes]) @ linear, 0, 1)
        x, y, z = np.cbrt(TO_XYZ @ linear)
        found.append([116 * y, 500 * (x - y), 200 * (y - z)])
    assert len(found) == 8
    # In CIELAB, where 2.3 is just noticeable.
    assert min(np.linalg.norm(np.subtract(a, b)) for a, b in combinations(found, 2)) > 14


def test_items_take_the_colour_of_the_uav_that_collects_them(fleet: FleetProgress) -> None:
    colours = [tuple(round(255 * part) for part in to_rgb(c)) for c in UAV_COLOURS[:3]]
    reached = (1, 2, 0)
    looks = {node: node_look(fleet, node, reached) for node in range(-1, 5)}
    assert [looks[node].fill for node in (1, 3, 2)] == [colours[0], colours[1], colours[1]]
    assert [looks[node].fill for node in (0, 4)] == [overlay.UNCOLLECTED] * 2
    assert [looks[node].rim for node in (0, 4)] == colours[1:]
    assert looks[DEPOT].fill == overlay.FLEET_DEPOT


# Figures


FIGURES = {"3d": plot_fleet_path_3d, "top": plot_fleet_path_top, "schedule": plot_schedule}


def boxes_of(figure: Figure) -> list:
    """Where the visible texts in a figure's axes are, and its title."""
    renderer = figure.canvas.get_renderer()
    texts = [text for axes in figure.axes for text in axes.texts] + [figure._suptitle]
    shown = [text for text in texts if text is not None and text.get_text()]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in shown]


@pytest.mark.parametrize("kind", FIGURES)
@pytest.mark.parametrize("which", ["fleet", "failed"])
def test_texts_are_on_the_page_and_names_do_not_overlap(
    kind: str, which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path, flown = tmp_path / "a.png", request.getfixturevalue(which)
    figure = FIGURES[kind](path, flown)
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape[1] == 1440
    assert kind == "schedule" or pixels.shape[0] == 1200
    for edge in (pixels[:4], pixels[-4:], pixels[:, :4], pixels[:, -4:]):
        assert np.all(edge == 255)  # nothing runs off the page
    found = boxes_of(figure)
    for text, box in found:
        assert box.x0 >= 0, text
        assert box.x1 <= figure.bbox.width, text
        assert box.y0 >= 0, text
        assert box.y1 <= figure.bbox.height, text
    for (one, a), (two, b) in combinations(found, 2):
        assert not (a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1), (one, two)
    said = "not completed" if which == "failed" else f"makespan {flown.makespan:.2f} s"
    assert said in figure.get_suptitle()


@pytest.mark.parametrize("kind", ["3d", "top"])
def test_paths_have_the_uavs_colours_and_a_legend(
    fleet: FleetProgress, kind: str, tmp_path: Path
) -> None:
    figure = FIGURES[kind](tmp_path / "a.png", fleet)
    axes, drawn = figure.axes[0], {}
    for line in axes.lines:
        if line.get_path_effects():
            x = line.get_data_3d() if kind == "3d" else line.get_data()
            drawn[line.get_color()] = np.array(x).T
    assert list(drawn) == list(UAV_COLOURS[:3])
    for m, x in enumerate(drawn.values()):
        flown = fleet.flights[m].trajectory
        np.testing.assert_allclose(x[[0, -1]], flown.x[[0, -1], : x.shape[1]])
        assert np.linalg.norm(np.diff(x, axis=0), axis=1).sum() == pytest.approx(
            np.linalg.norm(np.diff(flown.x[:, : x.shape[1]], axis=0), axis=1).sum(), rel=1e-3
        )
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    times = [flown.trajectory.duration for flown in fleet.flights]
    assert names[:3] == [f"UAV {m}, {time:.1f} s" for m, time in enumerate(times)]
    assert figure.legends[0].get_window_extent().x0 > axes.get_position().x0
    said = " | ".join(text.get_text() for text in axes.texts)
    for name in ("item 1 · stop 1", "item 0 · stop 3", "item 2 · stop 2", "depot"):
        assert name in said


def test_moving_boxes_and_items_nobody_collected_are_drawn(
    failed: FleetProgress, tmp_path: Path
) -> None:
    path = [[140.0, 130.0, 60.0], [140.0, 180.0, 60.0]]
    box = MovingBox.from_dict({"size": [10, 10, 10], "path": path, "speed": 8.0})
    for plot in (plot_fleet_path_3d, plot_fleet_path_top):
        figure = plot(tmp_path / "a.png", failed, [box])
        names = [text.get_text() for text in figure.legends[0].get_texts()]
        assert {"moving box", "not collected", "end of flight"} <= set(names)


def bars(axes, colour: str, alpha: float | None = None) -> list[tuple[float, float, float]]:
    """Row, begin and end of the bars of a colour."""
    found = [
        bar
        for bar in axes.patches
        if bar.get_facecolor()[:3] == to_rgb(colour) and bar.get_alpha() == alpha
    ]
    return [
        (bar.get_y() + bar.get_height() / 2, bar.get_x(), bar.get_x() + bar.get_width())
        for bar in found
    ]


def test_the_schedule_shows_segments_waits_shield_and_limits(
    fleet: FleetProgress, tmp_path: Path
) -> None:
    figure = plot_schedule(tmp_path / "a.png", fleet)
    upper, lower = figure.axes
    assert [text.get_text() for text in upper.get_yticklabels()] == [f"UAV {m}" for m in range(4)]
    for m, flown in enumerate(fleet.flights):
        times = [0.0, *flown.trajectory.t[list(flown.rows)]]
        expected = [(m, *pair) for pair in pairwise(times)]
        np.testing.assert_allclose(bars(upper, fleet.colour(m)), expected, atol=1e-9)
        waits = bars(upper, fleet.colour(m), alpha=0.22)
        expected = [] if m == fleet.lead else [(m, times[-1], fleet.duration)]
        np.testing.assert_allclose(np.reshape(waits, (-1, 3)), np.reshape(expected, (-1, 3)))
    (mark,) = bars(upper, "#222222")
    assert 0.3 < mark[0] < 0.5  # under the bar of UAV 0
    np.testing.assert_allclose(mark[1:], SHIELDED[0])
    said = [text.get_text() for text in upper.texts]
    assert [said.count(name) for name in ("item 3", "item 2", "item 0", "item 1")] == [1] * 4
    assert {"no items", f"lower bound {BOUND:.2f} s"} <= {text.strip() for text in said}
    assert f"makespan {fleet.makespan:.2f} s" in said
    for axes in (upper, lower):
        times = {line.get_xdata()[0] for line in axes.lines if len(set(line.get_xdata())) == 1}
        assert times == {BOUND, fleet.makespan}
    curve = lower.lines[0] if len(lower.lines[0].get_xdata()) > 2 else lower.lines[2]
    np.testing.assert_allclose(curve.get_ydata(), fleet.gaps)
    levels = [line.get_ydata()[0] for line in lower.lines if len(set(line.get_ydata())) == 1]
    assert fleet.separation_limit in levels
    assert lower.get_yscale() == "log"
    assert any(f"{fleet.gaps.min():.2f} m apart" in text.get_text() for text in lower.texts)


def test_the_schedule_of_a_single_uav_has_no_distances(tmp_path: Path) -> None:
    one = load_fleet(write_run(tmp_path / "run", ((1, 0, 2, 3, 4),), uavs=2))
    assert not np.isfinite(one.gaps).any()
    figure = plot_schedule(tmp_path / "a.png", one)
    assert len(figure.axes) == 1
    plot_fleet_path_top(tmp_path / "b.png", one)


def test_a_flight_that_ended_is_marked_where_it_did(failed: FleetProgress, tmp_path: Path) -> None:
    figure = plot_schedule(tmp_path / "a.png", failed)
    upper = figure.axes[0]
    hatched = [bar for bar in upper.patches if bar.get_hatch()]
    flown = failed.flights[1]
    (bar,) = hatched
    begin = flown.trajectory.t[flown.rows[-1]]
    assert (bar.get_x(), bar.get_x() + bar.get_width()) == pytest.approx(
        (begin, flown.trajectory.duration)
    )
    assert not any("makespan" in text.get_text() for text in upper.texts)
