"""Turned boxes: shield, simulator, law, planners, judge and file agree where they stand."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import fly_law
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.render.arrivals import progress
from mjcollect.render.path_figures import plot_path_3d, plot_path_top
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import segments_table
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify

BOUNDS = [[0.0, 0, 0], [200, 200, 60]]


def gaps(points, scene):
    """Distance (N,) of points (N, 3) to a scene's nearest box."""
    return gaps_to(points, scene.obstacles, scene.yaw)


def gaps_to(points, boxes, yaws):
    """Distance (N,) of points (N, 3) to the nearest box, each turned by complex numbers."""
    least = np.full(len(points), np.inf)
    for (low, high), yaw in zip(boxes, yaws, strict=True):
        away = points - (low + high) / 2
        level = (away[:, 0] + 1j * away[:, 1]) * np.exp(-1j * np.radians(yaw))
        over = np.abs(np.stack([level.real, level.imag, away[:, 2]], axis=1)) - (high - low) / 2
        least = np.minimum(least, np.linalg.norm(np.maximum(over, 0.0), axis=1))
    return least


def strewn(seed, count=12, **fields):
    """Boxes of any yaw between a depot and two items."""
    rng, boxes, yaws = np.random.default_rng(seed), [], []
    ends = np.array([[10.0, 10, 5], [185, 180, 40], [180, 25, 20]])
    while len(boxes) < count:
        half, yaw = rng.uniform([3, 8, 10], [12, 30, 30]), rng.uniform(-180, 180)
        centre = np.array([*rng.uniform(40, 160, 2), half[2]])
        box = np.stack([centre - half, np.minimum(centre + half, [200, 200, 60])])
        if gaps_to(ends, [box], [yaw]).min() > 12:
            boxes.append(box)
            yaws.append(yaw)
    return Scene("strewn", seed, BOUNDS, ends[0], ends[1:], boxes, yaw=yaws, **fields)


@pytest.fixture(scope="module")
def scene():
    return strewn(3)


@pytest.fixture(scope="module")
def course(scene):
    return Course.mission(scene, (0, 1))


def test_the_law_and_the_mpc_fly_free_and_the_judge_agrees(scene, course):
    assert any(row["blocked"] for row in segments_table(scene, (0, 1)))
    for flight in (fly_law(course), fly_planner(course, Mpc(course))):
        assert flight.success
        assert not verify(scene, flight.trajectory, (0, 1))
        assert gaps(flight.trajectory.x, scene).min() >= scene.uav_radius - 1e-9


def test_the_judge_sees_a_flight_through_a_turned_box(scene, course):
    """A flight that is free among the boxes as they stand is not free among them unturned."""
    flight = fly_law(Course.mission(dataclasses.replace(scene, obstacles=[], yaw=[]), (0, 1)))
    kinds = {violation.kind for violation in verify(scene, flight.trajectory, (0, 1))}
    touched = bool((gaps(flight.trajectory.x, scene) < scene.uav_radius).any())
    assert touched
    assert "contact" in kinds


@pytest.mark.parametrize("disturbed", [False, True])
def test_random_commands_touch_nothing(disturbed):
    made, count = strewn(5, 16), 64
    course = Course(dataclasses.replace(made, obstacles=[], yaw=[]), (0, 1))
    object.__setattr__(course, "scene", made)
    rng = np.random.default_rng(1)
    disturbances = Disturbances(Disturbance(), count, rng) if disturbed else None
    sims = Simulations([course], count, threads=1, disturbances=disturbances)
    sims.reset()
    low, high = made.bounds
    for shielded in (True, False):
        if not shielded:
            sims.close()
            sims = Simulations([course], count, rules=Rules(shield=False), threads=1)
            sims.reset()
        action, near, sensed = rng.normal(size=(count, 3)), 0, 0
        for _ in range(200):
            action = np.where(rng.random((count, 1)) < 0.05, rng.normal(size=(count, 3)), action)
            outcome = sims.step(action)
            path = sims.path.reshape(-1, 3)
            near += int((gaps(path, made) < made.uav_radius - 1e-9).sum())
            sensed += int(outcome.slot.contact.sum())
            outside = np.maximum(low - path, path - high).max()
            # In disturbed air no more is promised of bounds than a probability.
            assert not shielded or disturbed or outside <= 1e-6
        assert (near > 0) == (sensed > 0) == (not shielded)
    sims.close()


def test_simulator_and_sweep_agree_where_turned_boxes_stand(scene, course):
    """MuJoCo's sensor, which knows nothing of our distances, fires just where bodies are inside."""
    rng, count = np.random.default_rng(0), 128
    sims = Simulations([course], count, rules=Rules(shield=False), threads=1)
    sims.reset()
    inside, outside = 0, 0
    for _ in range(10):
        q = rng.uniform([30, 30, 1], [170, 170, 55], (count, 3))
        sims.place(np.arange(count), q, np.zeros((count, 3)))
        hit = sims.step(np.zeros((count, 3))).slot.contact
        gap = gaps(q, scene)
        sure = np.abs(gap - scene.uav_radius) > 1e-3
        np.testing.assert_array_equal(hit[sure], gap[sure] < scene.uav_radius)
        inside, outside = inside + int(hit.sum()), outside + int((~hit).sum())
    sims.close()
    assert min(inside, outside) > 50


def test_a_scene_file_keeps_yaw_and_leaves_out_zero(scene, tmp_path):
    scene.save(tmp_path / "s.json")
    assert Scene.load(tmp_path / "s.json") == scene
    document = json.loads((tmp_path / "s.json").read_text())
    assert all("yaw" in box for box in document["obstacles"])
    still = dataclasses.replace(scene, yaw=np.zeros(len(scene.obstacles)))
    assert not any("yaw" in box for box in still.to_dict()["obstacles"])
    assert still != scene
    assert still.boxes is still.obstacles


@pytest.mark.parametrize(
    ("box", "yaw", "field"),
    [
        ([[5, 50, 0], [25, 150, 20]], 45.0, "obstacles[0]"),  # its corners leave the bounds
        ([[5, 50, 0], [25, 150, 20]], 400.0, "obstacles[0].yaw"),
        ([[60, 95, 0], [140, 105, 20]], 90.0, "items[0]"),  # unturned it would not hold the item
    ],
)
def test_what_turning_makes_impossible_is_refused(box, yaw, field):
    fields = {"depot": [5.0, 5, 5], "items": [[100.0, 130, 10]], "obstacles": [box]}
    Scene("t", 0, BOUNDS, **fields)
    with pytest.raises(SceneError) as refused:
        Scene("t", 0, BOUNDS, **fields, yaw=[yaw])
    assert refused.value.field == field


def test_pictures_show_boxes_as_they_are_turned(scene, course, tmp_path):
    flown = progress(scene, fly_law(course).trajectory, (0, 1))
    axes = plot_path_top(tmp_path / "top.png", flown).axes[0]
    drawn = [patch.get_xy()[:4] for patch in axes.patches if len(patch.get_xy()) == 5]
    assert len(drawn) == len(scene.obstacles)
    for outline in drawn:
        points = np.c_[outline, np.full(4, 5.0)]
        np.testing.assert_allclose(gaps(points, scene), 0.0, atol=1e-6)
    zoned = dataclasses.replace(scene, no_fly=(2, 5))
    flown = progress(zoned, flown.trajectory, (0, 1))
    axes = plot_path_top(tmp_path / "top.png", flown).axes[0]
    hatched = [patch for patch in axes.patches if patch.get_hatch()]
    assert len(hatched) == 2
    with pytest.raises(SceneError, match="no_fly"):
        dataclasses.replace(scene, no_fly=(99,))
    plot_path_3d(tmp_path / "path.png", flown)
    assert (tmp_path / "path.png").stat().st_size > 10_000
