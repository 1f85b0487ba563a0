"""A scene's clearance is kept by law, MPC, shield and reference, and asked for by the judge."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crowds import gaps

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.recording import fly_law
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify

CLEARANCE = 3.0


@pytest.fixture(scope="module")
def wide(corridor):
    return dataclasses.replace(corridor, clearance=CLEARANCE)


@pytest.fixture(scope="module")
def course(wide):
    return Course.mission(wide, (0, 1))


def test_law_and_mpc_keep_it_and_without_it_fly_nearer(wide, course, corridor):
    for flight in (fly_law(course), fly_planner(course, Mpc(course))):
        assert flight.success
        assert not verify(wide, flight.trajectory, (0, 1))
        assert gaps(flight.trajectory.x, wide.obstacles).min() >= wide.reach - 1e-6
    near = fly_law(Course.mission(corridor, (0, 1))).trajectory
    assert gaps(near.x, corridor.obstacles).min() < wide.reach
    assert not verify(corridor, near, (0, 1))
    assert {found.kind for found in verify(wide, near, (0, 1))} == {"clearance"}


def test_the_shield_keeps_it_from_random_commands(wide):
    rng, count = np.random.default_rng(0), 64
    sims = Simulations([Course.mission(wide, (0, 1))], count, threads=1)
    sims.reset()
    action = rng.normal(size=(count, 3))
    least = np.inf
    for _ in range(300):
        action = np.where(rng.random((count, 1)) < 0.05, rng.normal(size=(count, 3)), action)
        action[:, 0] = np.abs(action[:, 0]) * np.where(rng.random(count) < 0.8, 1, -1)
        sims.step(action)
        least = min(least, float(gaps(sims.path.reshape(-1, 3), wide.obstacles).min()))
    sims.close()
    assert wide.reach - 1e-9 <= least < wide.reach + 1.0  # kept, and tried


def test_scene_files_keep_it_and_refuse_what_it_makes_impossible(wide, corridor, tmp_path):
    wide.save(tmp_path / "s.json")
    assert Scene.load(tmp_path / "s.json") == wide
    assert wide != corridor
    assert "clearance" not in corridor.to_dict()
    assert wide.reach == wide.uav_radius + CLEARANCE
    for value in (-1.0, float("nan")):
        with pytest.raises(SceneError, match="clearance"):
            dataclasses.replace(corridor, clearance=value)
    with pytest.raises(SceneError, match="clearance") as refused:
        dataclasses.replace(corridor, clearance=30.0)
    assert refused.value.field in ("depot", "items[0]", "items[1]")
