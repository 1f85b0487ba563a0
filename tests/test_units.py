"""A vehicle of another size in a world of another size flies, sees and is guided alike."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crowds import crowded

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import fly_law
from mjcollect.generate.place import VEHICLES
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.scene.scene import Scene

LENGTHS = ("bounds", "depot", "items", "obstacles", "epsilon", "return_tolerance", "uav_radius")


def scaled(scene: Scene, length: float, time: float) -> Scene:
    """The same scene with metres and seconds that are so many times as long."""
    changed = {name: getattr(scene, name) * length for name in LENGTHS}
    changed |= {name: getattr(scene, name) * time for name in ("slot", "physics_step")}
    changed |= {"v_max": scene.v_max * length / time, "a_max": scene.a_max * length / time**2}
    return dataclasses.replace(scene, **changed)


def test_the_racer_s_unit_is_the_metre():
    assert crowded(0, 1).unit == 1.0
    assert scaled(crowded(0, 1), 0.25, 0.5).unit == 0.25
    for vehicle in VEHICLES.values():
        limits = {**vehicle.limits, "uav_radius": 0.01}
        made = dataclasses.replace(crowded(0, 1), **limits)
        assert made.unit == pytest.approx(vehicle.v_max**2 / (2 * vehicle.a_max) / 62.5)


@pytest.mark.parametrize(("length", "time"), [(0.25, 0.5), (2.0, 4.0), (1 / 128, 0.25)])
@pytest.mark.parametrize("observation", ["path", "guided"])
def test_scaled_worlds_show_the_same_and_lead_the_same_way(length, time, observation):
    """Powers of two scale without rounding; what is left is the shield's margin of 1e-6 m."""
    seen = []
    for scene in (crowded(3, 12), scaled(crowded(3, 12), length, time)):
        course = Course.segment(scene, (0,), 0)
        sims = Simulations(
            [course], 24, rules=Rules(observation), start="spread",
            rng=np.random.default_rng(5), threads=1,
        )  # fmt: skip
        sims.reset()
        rng, made = np.random.default_rng(6), []
        for slot in range(12):
            made.append(np.concatenate([sims.observe(), sims.law()], axis=1))
            outcome = sims.step(sims.law() if slot % 2 else rng.uniform(-1, 1, (24, 3)))
            sims.reset(np.flatnonzero(outcome.terminated))
            reward = outcome.reward / scene.slot
            made.append(np.stack([reward, outcome.shielded, outcome.success], axis=1))
        sims.close()
        seen.append(made)
    for one, other in zip(*seen, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-3)


def test_scaled_missions_take_scaled_times():
    scene, length, time = crowded(4, 10), 0.125, 0.25
    course = Course.mission(scene, (0,))
    other = Course.mission(scaled(scene, length, time), (0,))
    for flown in (fly_law, lambda course: fly_planner(course, Mpc(course))):
        one, two = flown(course), flown(other)
        assert one.success
        assert two.success
        # The solver's tolerances are absolute: a plan may take a slot more or less.
        durations = one.trajectory.duration * time, two.trajectory.duration
        assert abs(durations[0] - durations[1]) <= 2.01 * other.scene.slot


def test_far_goals_show_as_far_but_no_farther():
    """In a city of 5 km the numbers stay among those that policies have seen."""
    bounds = np.array([[0.0, 0.0, 0.0], [50_000.0, 500.0, 500.0]])
    scene = Scene("far", 0, bounds, [10.0, 250, 250], [[49_000.0, 250, 250]], [])
    sims = Simulations([Course.segment(scene, (0,), 0)], 1, rules=Rules("path"), threads=1)
    sims.reset()
    assert np.abs(sims.observe()).max() <= 8.0
    sims.close()
