from __future__ import annotations

import re
from fractions import Fraction
from itertools import combinations

import mujoco
import numpy as np
import pytest

from mjcollect.generate import generate
from mjcollect.scene import mjcf
from mjcollect.scene.assets import asset_path
from mjcollect.scene.mjcf import (
    ACTUATORS,
    HIT_SENSOR,
    JOINTS,
    UAV_BODY,
    UAV_GEOM,
    build,
    compile_model,
)
from mjcollect.scene.scene import Scene

ODD = [1 / 3, 0.1 + 0.2, 2**0.5]  # not short in decimal: the XML must keep every digit


def scene(**fields) -> Scene:
    fields = {
        "obstacles": [[ODD, [50.1, 60.7, 80.3]], [[300.0, 0, 0], [302.0, 990.0, 1000.0]]],
        "depot": [200.0, 0.0, 1.7],
    } | fields
    items = [[100.0, 1 / 7, 200], [700.0, 650, 999]]
    return Scene("t", 0, [[0] * 3, [1000] * 3], items=items, **fields)


def run(model, commands, q=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0)):
    """Positions, velocities and sensor after each step of the commands (R, 3)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    rows = []
    for a in commands:
        data.ctrl[:] = a
        mujoco.mj_step(model, data)
        rows.append([*data.qpos, *data.qvel, data.sensordata[0]])
    rows = np.array(rows)
    return rows[:, :3], rows[:, 3:6], rows[:, 6] > 0


def names(model, kind):
    count = {"geom": model.ngeom, "site": model.nsite, "camera": model.ncam}[kind]
    return [getattr(model, kind)(index).name for index in range(count)]


def test_boxes_sites_and_cameras_are_the_scene():
    flown = scene(epsilon=4.5, return_tolerance=3.0)
    model = compile_model(flown)
    boxes = [name for name in names(model, "geom") if name.startswith("obstacle_")]
    assert boxes == [f"obstacle_{index}" for index in range(2)]
    for name, box in zip(boxes, flown.obstacles, strict=True):
        geom = model.geom(name)
        assert geom.type == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_allclose(geom.pos - geom.size, box[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(geom.pos + geom.size, box[1], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(geom.quat, [1, 0, 0, 0])
    sites = [name for name in names(model, "site") if name.startswith("item_")]
    assert sites == ["item_0", "item_1"]
    for name, item in zip(sites, flown.items, strict=True):
        np.testing.assert_array_equal(model.site(name).pos, item)
        assert model.site(name).size[0] == 4.5
    np.testing.assert_array_equal(model.site("depot").pos, flown.depot)
    assert model.site("depot").size[0] == 3.0
    assert {"top", "overview", "quadrotor/chase"} == set(names(model, "camera"))
    assert model.camera("quadrotor/chase").bodyid == model.body(UAV_BODY).id


def test_one_body_on_three_undamped_slides_with_three_unlimited_motors():
    model = compile_model(scene(physics_step=0.05, uav_radius=0.7))
    assert (model.nq, model.nv, model.nu, model.nsensor, model.njnt) == (3, 3, 3, 1, 3)
    for axis, (joint, actuator) in enumerate(zip(JOINTS, ACTUATORS, strict=True)):
        assert model.joint(joint).type == mujoco.mjtJoint.mjJNT_SLIDE
        np.testing.assert_array_equal(model.joint(joint).axis, np.eye(3)[axis])
        assert model.joint(joint).qposadr == axis
        assert not model.joint(joint).limited
        assert model.actuator(actuator).trnid[0] == model.joint(joint).id
        assert not model.actuator(actuator).ctrllimited
        assert not model.actuator(actuator).forcelimited
    assert not model.dof_damping.any()
    assert not model.dof_armature.any()
    assert not model.dof_frictionloss.any()
    assert not model.jnt_stiffness.any()
    assert not model.opt.gravity.any()
    assert model.opt.timestep == 0.05
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.geom(UAV_GEOM).type == mujoco.mjtGeom.mjGEOM_SPHERE
    assert model.geom(UAV_GEOM).size[0] == 0.7
    np.testing.assert_array_equal(model.geom(UAV_GEOM).pos, 0)
    assert model.sensor(HIT_SENSOR).type == mujoco.mjtSensor.mjSENS_CONTACT


def test_only_the_sphere_and_the_boxes_collide():
    model = compile_model(scene())
    able = (model.geom_contype[:, None] & model.geom_conaffinity) > 0
    pairs = {
        frozenset((model.geom(i).name, model.geom(j).name))
        for i, j in combinations(range(model.ngeom), 2)
        if able[i, j] or able[j, i]
    }
    assert pairs == {frozenset((UAV_GEOM, f"obstacle_{index}")) for index in range(2)}
    assert model.ngeom > 20  # rotors, arms, ground: there, and not in any pair


@pytest.mark.parametrize("hull", ["0.45", "0.0137", "730"])
def test_actuators_give_the_commanded_acceleration_whatever_the_mass(hull, tmp_path, monkeypatch):
    xml = asset_path("quadrotor.xml").read_text()
    edited = re.sub(r'mass="0.45"', f'mass="{hull}"', xml)
    (tmp_path / "quadrotor.xml").write_text(edited)
    monkeypatch.setattr(mjcf, "asset_path", lambda *parts: tmp_path.joinpath(*parts))
    model = compile_model(scene(obstacles=[]))
    data = mujoco.MjData(model)
    for a in ([20.0, 0, 0], [0, -20.0, 0], [1e-3, 7.7, -13.1]):
        data.ctrl[:] = a
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc, a, rtol=1e-13, atol=1e-15)
    mass = model.body_subtreemass[model.body(UAV_BODY).id]
    np.testing.assert_array_equal(model.actuator_gear[:, 0], mass)
    assert mass == pytest.approx(0.8495 + float(hull), abs=0.5)  # the rest of the craft is there


@pytest.mark.parametrize("seed", range(3))
def test_free_flight_is_the_closed_form_to_round_off(seed):
    rng = np.random.default_rng(seed)
    flown = scene(obstacles=[])
    commands = np.repeat(rng.uniform(-20, 20, (100, 3)), 10, axis=0)
    start, speed = rng.uniform(0, 1000, 3), rng.uniform(-29, 29, 3)
    x, v, hit = run(compile_model(flown), commands, start, speed)
    step = Fraction(flown.physics_step)
    for axis in range(3):
        at, moving = Fraction(start[axis]), Fraction(speed[axis])
        for a in commands[:, axis]:
            moving += Fraction(a) * step
            at += moving * step
        assert abs(float(Fraction(x[-1, axis]) - at)) < 1e-9
        assert abs(float(Fraction(v[-1, axis]) - moving)) < 1e-10
    assert not hit.any()


@pytest.mark.parametrize("factor", [0.5, 40.0])
def test_visual_scale_changes_pictures_only(factor):
    flown = scene(depot=[296.0, 500, 500])
    models = []
    for scale in (1.0, factor):
        root = build(flown, visual_scale=scale)
        models.append(mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets()))
    commands = np.random.default_rng(0).uniform(-20, 20, (100, 3))
    flights = [run(model, commands, flown.depot, [20.0, 0, 0]) for model in models]
    assert flights[0][2].any()  # through a contact, too
    for plain, scaled in zip(*flights, strict=True):
        np.testing.assert_array_equal(plain, scaled)
    one, other = models
    assert one.geom(UAV_GEOM).size[0] == other.geom(UAV_GEOM).size[0] == 0.5
    for name in ("quadrotor/hull", "quadrotor/rotor_fl", "quadrotor/arm_fl", "quadrotor/leg_l"):
        np.testing.assert_allclose(other.geom(name).size, factor * one.geom(name).size)
        np.testing.assert_allclose(
            other.geom(name).pos, factor * one.geom(name).pos, rtol=1e-12, atol=1e-12
        )


def test_a_box_that_is_not_solid_is_sensed_and_flown_through():
    flown = scene()
    start, speed = [296.0, 500, 500], [20.0, 0, 0]
    still = np.zeros((40, 3))
    _, v, hit = run(compile_model(flown, solid=False), still, start, speed)
    np.testing.assert_array_equal(v, np.tile(speed, (40, 1)))
    # The sensor describes the state before the step.
    before = 296.0 + 20.0 * flown.physics_step * np.arange(40)
    np.testing.assert_array_equal(hit, (before > 299.5) & (before < 302.5))
    _, bounced, struck = run(compile_model(flown), still, start, speed)
    assert struck.any()
    assert bounced[-1, 0] < 19.0


def test_city_and_two_hundred_boxes_compile():
    city = Scene.find("city_6")
    crowd = generate(seed=1, items=8, obstacles=200)
    for flown in (city, crowd):
        model = compile_model(flown)
        corners = np.stack([model.geom_pos - model.geom_size, model.geom_pos + model.geom_size], 1)
        box = [model.geom(f"obstacle_{index}").id for index in range(len(flown.obstacles))]
        np.testing.assert_allclose(corners[box], flown.obstacles, rtol=0, atol=1e-12)
        assert len(names(model, "site")) == len(flown.items) + 2  # depot, centre of the craft
        x, _, hit = run(model, np.tile([1.0, 2.0, 3.0], (10, 1)), flown.depot)
        assert not hit.any()
        np.testing.assert_allclose(x[-1], np.array([1, 2, 3]) * 0.02**2 * 55, rtol=1e-9)
