"""Pictures of scenes with several depots show all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleet_runs import ITEMS, scene_of, write_run
from matplotlib.figure import Figure
from PIL import Image
from straight_flights import fly

from mjcollect.render.arrivals import progress
from mjcollect.render.camera import framing
from mjcollect.render.film.overview import Overview
from mjcollect.render.fleet import FleetProgress, load_fleet
from mjcollect.render.fleet_figures import plot_fleet_path_3d, plot_fleet_path_top
from mjcollect.render.overlay import FLEET_DEPOT, node_look
from mjcollect.render.path_figures import plot_path_3d, plot_path_top
from mjcollect.scene.mjcf import compile_model

MORE = [[190, 190, 5], [190, 10, 5]]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> FleetProgress:
    """Three UAVs of three depots; the second one, which flies longest, is followed."""
    return load_fleet(write_run(tmp_path_factory.mktemp("depots"), more_depots=MORE))


def names(figure: Figure) -> set[str]:
    return {text.get_text().split(" · z")[0] for text in figure.axes[0].texts}


def test_the_model_has_a_site_for_every_depot() -> None:
    model = compile_model(scene_of(more_depots=MORE))
    for name, place in zip(("depot", "depot_1", "depot_2"), ([10, 10, 5], *MORE), strict=True):
        np.testing.assert_allclose(model.site(name).pos, place)
    assert compile_model(scene_of()).nsite == model.nsite - 2
    assert model.site("item_4").pos.tolist() == ITEMS[4]


def test_flights_begin_and_end_at_their_own_depots(fleet: FleetProgress) -> None:
    assert [fleet.home(m) for m in range(3)] == [-1, -2, -3]
    assert (fleet.lead, fleet.complete) == (1, True)
    assert fleet.target((0, 3, 0)) == -2
    states = [fleet.state(node, (0, 3, 0)) for node in (-3, -2, -1)]
    assert states == [("depot", None), ("target", 1), ("depot", None)]
    assert {node_look(fleet, node, (0, 3, 0)).fill for node in (-3, -2, -1)} == {FLEET_DEPOT}


def test_pictures_of_a_fleet_name_every_depot(fleet: FleetProgress, tmp_path: Path) -> None:
    for plot in (plot_fleet_path_3d, plot_fleet_path_top):
        assert {"depot", "depot 1", "depot 2"} <= names(plot(tmp_path / "path.png", fleet))


def test_pictures_of_one_flight_name_every_depot(tmp_path: Path) -> None:
    scene = scene_of(more_depots=MORE)
    flown = fly([scene.depot, *scene.items, scene.depot])
    done = progress(scene, flown, range(5))
    assert done.complete
    for plot in (plot_path_3d, plot_path_top):
        assert {"depot", "depot 1", "depot 2"} <= names(plot(tmp_path / "path.png", done))
    assert FleetProgress.alone(done).home(0) == -1


def test_the_overview_of_a_video_has_every_depot(fleet: FleetProgress) -> None:
    view = framing(fleet.scene.bounds, np.array([1.0, 0.82, -0.72]), 30.0, (1280, 720))
    trails = [(flown.trajectory.x, np.zeros((len(flown.trajectory), 3))) for flown in fleet.flights]
    image = Image.new("RGB", view.size, "white")
    Overview(fleet, view, trails).nodes(image, (0, 0, 0), 10.0)
    for u, v in view.project(fleet.scene.depots)[0].round().astype(int):
        # A square has its colour beside its letter, in the corner where a disc has none.
        assert image.getpixel((int(u) - 7, int(v) - 7)) == FLEET_DEPOT
