"""Fleets keep apart: whatever UAVs are told to fly, they neither meet nor touch a box."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from crowds import RADIUS, dense, gaps
from hypothesis import given, settings
from hypothesis import strategies as st
from traffic import ARENA, among, arena, blind_course, chase, free_places, least_pair_gap, pair_gaps

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.separation import first_meeting, longest_plan, plan_row, too_near
from mjcollect.flight.shield import HELD
from mjcollect.flight.world import World
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.scene import Scene

FLEETS, SLOTS = 8, 100
LIMITS = [
    {"v_max": 50.0, "a_max": 20.0, "slot": 0.2, "physics_step": 0.02},
    {"v_max": 15.0, "a_max": 5.0, "slot": 0.1, "physics_step": 0.02},
    {"v_max": 3.0, "a_max": 40.0, "slot": 0.5, "physics_step": 0.05},
]


@pytest.fixture(scope="module")
def blind() -> Course:
    return blind_course()


# Plans


def shortened(vector, most):
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-300))


@pytest.mark.parametrize("limits", LIMITS)
def test_a_plan_is_what_mujoco_flies(limits):
    """The command is held, then full braking, each within both limits, until rest."""
    scene = Scene("open", 0, [[-1e4] * 3, [1e4] * 3], [0] * 3, [[9e3] * 3], [], **limits)
    model, world = compile_model(scene), World.stack([scene])
    rng, longest = np.random.default_rng(0), 0
    for slots in (*range(10), 9, 9):
        data = mujoco.MjData(model)
        q, v, a = (rng.normal(size=3) for _ in range(3))
        q, v = q * 100, shortened(v * scene.v_max, scene.v_max)
        a *= rng.uniform(0, 2) * scene.a_max / np.linalg.norm(a)
        data.qpos[:], data.qvel[:] = q, v
        flown, left = [q], slots
        while left > 0 or np.linalg.norm(data.qvel) > 1e-9:
            now = data.qvel.copy()
            if left > 0:
                end = shortened(now + scene.slot * shortened(a, scene.a_max), scene.v_max)
            else:
                end = now - shortened(now, scene.a_max * scene.slot)
            data.ctrl[:] = (end - now) / scene.slot
            for _ in range(scene.substeps):
                mujoco.mj_step(model, data)
                flown.append(data.qpos.copy())
            left -= 1
        path = np.full((longest_plan(world, max(HELD) + 1), 3), np.nan)
        count = plan_row(world, 0, q, v, a, slots, path)
        assert count == len(flown)
        np.testing.assert_allclose(path[:count], flown, rtol=0, atol=1e-9)
        longest = max(longest, count)
    assert longest > 9 * scene.substeps


def test_no_plan_is_longer_than_the_memory_for_it():
    """At v_max a plan still brakes to rest within it."""
    for limits in LIMITS:
        scene = Scene("open", 0, [[-1e4] * 3, [1e4] * 3], [0] * 3, [[9e3] * 3], [], **limits)
        world = World.stack([scene])
        path = np.empty((longest_plan(world, max(HELD) + 1), 3))
        v = np.array([scene.v_max, 0, 0])
        count = plan_row(world, 0, np.zeros(3), v, np.zeros(3), max(HELD) + 1, path)
        last = np.diff(path[:count], axis=0)[-1] / scene.physics_step
        assert np.linalg.norm(last) <= scene.a_max * scene.slot
        more = np.empty((len(path) + 1000, 3))
        assert count == plan_row(world, 0, np.zeros(3), v, np.zeros(3), max(HELD) + 1, more)


def wander(rng, count, stride):
    """A path (count, 3) through the middle of a small room, in steps of up to `stride`."""
    turns = rng.normal(size=(count, 3)).cumsum(axis=0) * rng.uniform(0, 0.3) + rng.normal(size=3)
    steps = stride * rng.uniform(0.2, 1) * turns / np.linalg.norm(turns, axis=1, keepdims=True)
    path = steps.cumsum(axis=0)
    return path - path[rng.integers(count)] + rng.normal(size=3) * rng.uniform(0, 4)


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 10**9))
def test_the_first_meeting_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    count, counts = (int(n) for n in rng.integers(1, 120, 2))
    one, other = wander(rng, count, 0.5), wander(rng, counts, 0.5)
    found = first_meeting(one, count, other, counts, apart := float(rng.uniform(0.1, 3)), 1.0)
    most = max(count, counts)
    first, second = (
        np.concatenate([path, np.repeat(path[-1:], most - len(path), axis=0)])
        for path in (one, other)
    )
    offset = second - first
    limit = min(apart, float(np.linalg.norm(offset[0])) - 1e-10)
    shares = np.linspace(0, 1, 501)[:, None, None]
    pieces = offset[:-1] + shares * (offset[1:] - offset[:-1])
    sampled = np.linalg.norm(pieces, axis=2).min(axis=0, initial=np.inf)
    coarse = 1e-3  # half of what lies between two samples
    before = sampled if found < 0 else sampled[: found - 1]
    assert (before >= limit).all()
    if found >= 0:
        assert 1 <= found < most
        assert sampled[found - 1] < np.hypot(limit, coarse)


def test_wandering_paths_meet_in_all_ways():
    """Otherwise brute force would say little; some meet one that has come to its end."""
    kinds = set()
    for seed in range(200):
        rng = np.random.default_rng(seed)
        one, other = wander(rng, 40, 0.5), wander(rng, 15, 0.5)
        found = first_meeting(one, 40, other, 15, 1.0, 1.0)
        kinds.add("never" if found < 0 else "late" if found >= 15 else "soon")
        if np.linalg.norm(one[0] - other[0]) < 1.0:
            kinds.add("near at first")
    assert kinds == {"never", "late", "soon", "near at first"}


def test_a_meeting_between_two_rows_is_found():
    """They are 3.2 m apart at every row, and pass at 0.5 m halfway."""
    one = np.array([[0.0, 0, 0], [0, 0, 0]])
    other = np.array([[-np.sqrt(10), 0.5, 0], [np.sqrt(10), 0.5, 0]])
    assert first_meeting(one, 2, other, 2, 0.51, 10.0) == 1
    assert first_meeting(one, 2, other, 2, 0.49, 10.0) == -1
    scene = arena(0)  # keeps 2 m
    world = World.stack([scene])
    for aside, met in ((1.999, True), (2.001, False)):
        path = np.stack([one, other + np.array([0, aside - 0.5, 0])])
        np.testing.assert_array_equal(too_near(world, 2, path), [[met], [met]])
    assert not too_near(world, 1, path).any()


# Fleets


class Fleets:
    """Fleets flown by commands; how near UAVs came, and what they touched.

    Attributes:
        path: (N, T, 3) positions at every physics step. gap: least distance of two UAVs of a fleet.
        acted: slots in which the shield did. contacts: slots with a contact that MuJoCo sensed.
        crashed: whether any slot did.
    """

    def __init__(self, course, uavs, kind, seed, *, shield=True, fleets=FLEETS, slots=SLOTS):
        scene, rng = course.scene, np.random.default_rng(seed)
        count = fleets * uavs
        rules = Rules(shield=shield)
        sims = Simulations([course], count, rules=rules, threads=1, uavs=uavs)
        sims.reset()
        q = np.concatenate([free_places(rng, scene, uavs) for _ in range(fleets)])
        sims.place(np.arange(count), q, np.zeros_like(q))
        paths, action = [q[:, None]], rng.normal(size=q.shape)
        self.acted = self.contacts = 0
        self.crashed = False
        for _ in range(slots):
            if kind == "hostile":
                action = chase(paths[-1][:, -1], uavs)
            else:
                anew = rng.normal(size=q.shape) * 3
                action = np.where(rng.random((count, 1)) < 0.2, anew, action)
            outcome = sims.step(action)
            paths.append(sims.path.copy())
            self.acted += int(outcome.shielded.sum())
            self.contacts += int((sims._sensors > 0).any(axis=1).sum())
            self.crashed |= bool(outcome.slot.crashed.any() or outcome.struck.any())
        sims.close()
        self.path = np.concatenate(paths, axis=1)
        self.gap = least_pair_gap(self.path, uavs)


@pytest.mark.parametrize("uavs", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", ["random", "hostile"])
def test_fleets_neither_meet_nor_touch_a_box(blind, uavs, kind):
    scene = arena(uavs, boxes=10)
    assert len(scene.obstacles) >= 5
    flown = Fleets(among(blind, scene), uavs, kind, seed=uavs)
    assert flown.gap >= scene.apart - 1e-6
    assert not flown.crashed
    assert flown.contacts == 0
    assert flown.acted > FLEETS
    assert np.abs(np.diff(flown.path, axis=1)).max() > 0.1  # metres in a physics step
    for track in flown.path:
        assert gaps(dense(track, spacing=0.1), scene.obstacles).min() >= RADIUS
    outside = np.maximum(ARENA[0] - flown.path, flown.path - ARENA[1]).max()
    assert outside <= 1e-6
    if kind == "hostile":  # As near as they may: what keeps them apart is put to the test.
        assert flown.gap < scene.apart + 0.5


@pytest.mark.parametrize("uavs", [2, 5])
def test_without_the_shield_hostile_fleets_collide(blind, uavs):
    scene = arena(uavs, boxes=10)
    flown = Fleets(among(blind, scene), uavs, "hostile", seed=uavs, shield=False, slots=20)
    assert flown.gap < 2 * RADIUS
    assert flown.contacts > 0
    assert flown.crashed


def test_a_wider_separation_is_kept(blind):
    scene = arena(3, boxes=4, separation=5.0)
    flown = Fleets(among(blind, scene), 3, "hostile", seed=3, slots=50)
    assert 5.0 - 1e-6 <= flown.gap < 5.5
    assert not flown.crashed


def test_fleets_fly_alike_under_other_limits(blind):
    scene = arena(4, v_max=8.0, a_max=6.0, slot=0.4, physics_step=0.04, uav_radius=0.4)
    flown = Fleets(among(blind, scene), 4, "hostile", seed=4, slots=50)
    assert scene.apart - 1e-6 <= flown.gap < scene.apart + 0.5
    assert not flown.crashed


def test_uavs_that_start_too_near_come_no_nearer(blind):
    scene = arena(0, boxes=0)
    sims = Simulations([among(blind, scene)], 4, threads=1, uavs=2)
    sims.reset()
    q = np.array([[30.0, 10, 10], [31.5, 10, 10], [60, 5, 5], [60, 5, 6.2]])
    sims.place(np.arange(4), q, np.zeros_like(q))
    path = [q[:, None]]
    for _ in range(40):
        sims.step(chase(path[-1][:, -1], 2))
        path.append(sims.path.copy())
    path = np.concatenate(path, axis=1)
    assert pair_gaps(path[0], path[1]).min() >= 1.5 - 1e-6
    assert pair_gaps(path[2], path[3]).min() >= 1.2 - 1e-6
    for _ in range(20):  # and they part
        sims.step(-chase(sims.path[:, -1], 2))
    assert np.linalg.norm(sims.path[0, -1] - sims.path[1, -1]) > 3
    sims.close()


@pytest.mark.parametrize("solid", [True, False])
def test_mujoco_senses_two_uavs_that_touch(solid):
    scene = arena(0, boxes=0)
    model = compile_model(scene, solid=solid, uavs=3)
    data = mujoco.MjData(model)
    for gap, touch in ((2 * RADIUS + 1e-3, 0), (2 * RADIUS - 1e-3, 1)):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = np.concatenate([[30, 10, 10], [30, 10, 10 + gap], [50, 10, 10]])
        mujoco.mj_forward(model, data)
        assert ((data.sensordata > 0) == [touch, touch, False]).all()
    alone = compile_model(scene, uavs=1)
    assert alone.geom("quadrotor/body").conaffinity == 0  # as it was before there were fleets


def test_two_uavs_bounce_off_each_other_far_from_any_box(blind):
    """Without the shield: the simulation looks for contacts wherever two may meet."""
    scene = arena(0, boxes=0)
    rules = Rules(shield=False)
    sims = Simulations([among(blind, scene)], 2, rules=rules, threads=1, uavs=2)
    sims.reset()
    q, v = np.array([[40.0, 10, 10], [50, 10, 10]]), np.array([[10.0, 0, 0], [-10, 0, 0]])
    sims.place(np.arange(2), q, v)
    contacts, nearest = [], np.inf
    for _ in range(6):
        sims.step(np.zeros((2, 3)))
        contacts.append((sims._sensors > 0).any(axis=(0, 1)))
        nearest = min(nearest, pair_gaps(*sims.path).min())
    np.testing.assert_array_equal(np.any(contacts, axis=0), [True, True])
    assert 0.5 < nearest < 2 * RADIUS  # They do not fly through each other.
    assert sims.path[0, -1, 0] < sims.path[1, -1, 0]
    sims.close()


def test_fleets_side_by_side_do_not_influence_each_other(blind):
    scene, uavs = arena(7, boxes=10), 3
    course, rng = among(blind, scene), np.random.default_rng(7)
    q = np.stack([free_places(rng, scene, uavs) for _ in range(4)])

    def flown(fleets):
        """Positions, and where the shield acted, of fleets with some of these numbers."""
        count = len(fleets) * uavs
        sims = Simulations([course], count, threads=1, uavs=uavs)
        sims.reset()
        sims.place(np.arange(count), q[fleets].reshape(-1, 3), np.zeros((count, 3)))
        found, at = [], q[fleets].reshape(-1, 3)
        for slot in range(60):
            random = np.random.default_rng(slot).uniform(-1, 1, (4, uavs, 3))[fleets]
            action = random.reshape(-1, 3) if slot % 3 == 0 else chase(at, uavs)
            acted = sims.step(action).shielded
            at = sims.path[:, -1].copy()
            found.append((sims.path.reshape(len(fleets), uavs, -1, 3).copy(), acted))
        sims.close()
        paths, acted = zip(*found, strict=True)
        return np.concatenate(paths, axis=2), np.stack(acted, axis=1).reshape(len(fleets), uavs, -1)

    whole = flown([0, 1, 2, 3])
    assert whole[1].any()
    for fleets in ([0], [3], [2, 1]):
        for ours, theirs in zip(flown(fleets), whole, strict=True):
            np.testing.assert_array_equal(ours, theirs[fleets])
