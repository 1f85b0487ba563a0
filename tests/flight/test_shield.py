"""The shield: no command touches anything, and none holds a body for ever."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crowds import FLAT, RADIUS, gaps, least_gap
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.projection import project
from mjcollect.flight.shield import shield
from mjcollect.flight.straight_line import slot_path
from mjcollect.flight.world import World
from mjcollect.generate import generate
from mjcollect.geometry.tree import Tree
from mjcollect.scene.scene import Scene

SLOT, A_MAX, V_MAX, COUNT = 0.2, 20.0, 50.0, 128
BOUNDS = np.array([[0.0, 0, 0], [60, 60, 60]])


def world_of(bounds, boxes, slot=SLOT):
    tree = Tree.of(np.asarray(boxes, float))
    return World(
        bounds=np.asarray(bounds, float)[None],
        boxes=tree.boxes[None],
        nodes=tree.nodes[None],
        members=tree.members[None],
        v_max=np.array([[V_MAX]]),
        a_max=np.array([[A_MAX]]),
        radius=np.array([[RADIUS]]),
        unit=np.ones((1, 1)),
        apart=np.full((1, 1), 4 * RADIUS),
        slot=slot,
        step=0.02,
        substeps=round(slot / 0.02),
    )


def shielded(world, q, v, a):
    """What is flown of commands a from q, v (n, 3); the slots of their backups; where it acted."""
    n = len(q)
    a, held, left = a.copy(), np.zeros((n, 3)), np.zeros(n, dtype=np.intp)
    stop, acted = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    shield(world, q, v, a, stop, held, left, acted)
    return a, left, acted


def backup(world, q, v, a, more):
    """Positions (T, 3) of a slot of `a`, `more` of it held, and braking slots until rest."""
    points = [q[None]]
    for _ in range(200):
        whole, speeds = slot_path(world, q[None], v[None], a[None])
        points.append(whole[0, 1:])
        q, v = whole[0, -1], speeds[0]
        speed = float(np.linalg.norm(v))
        if more > 0:
            more, a = more - 1, project(world, v[None], a[None] / A_MAX)[0]
        elif speed < 1e-9:
            return np.concatenate(points)
        else:
            a = -v / speed * min(A_MAX, speed / world.slot)
    raise AssertionError("never at rest")


@pytest.mark.parametrize("slot", [0.2, 1.0])
def test_what_it_lets_pass_leaves_a_way_to_stop(slot):
    """Against backups flown step by step and distances sampled densely, in a box with boxes."""
    rng, passed = np.random.default_rng(5), 0
    for _ in range(400):
        low = rng.uniform(0, 45, (4, 3))
        boxes = np.stack([low, low + rng.uniform(2, 15, (4, 3))], axis=1)
        world = world_of(BOUNDS, boxes, slot)
        q, v, a = rng.uniform(0, 60, 3), rng.normal(size=3), rng.normal(size=3)
        if gaps(q[None], boxes)[0] <= RADIUS:
            continue
        v *= rng.uniform(0, 25) / np.linalg.norm(v)
        a *= rng.uniform(0, A_MAX) / np.linalg.norm(a)
        _, left, acted = shielded(world, q[None], v[None], a[None])
        if not acted[0]:
            passed += 1
            path = backup(world, q, v, a, int(left[0]))
            assert least_gap(path, boxes) >= RADIUS
            assert min((path - BOUNDS[0]).min(), (BOUNDS[1] - path).min()) >= -1e-9
    assert 60 < passed < 340


def test_beside_a_box_it_may_go_but_not_nearer():
    world = world_of(FLAT, [[[100.0, 20, 20], [120, 40, 40]]])
    q, v = np.array([[99.45, 30, 30]]), np.zeros((1, 3))
    for command, allowed in (([0.0, 0, 20], True), ([-20.0, 0, 0], True), ([20.0, 0, 0], False)):
        assert shielded(world, q, v, np.array([command]))[2][0] != allowed


def crowd(seed: int, layout: str, boxes: int) -> Scene:
    """A generated scene at a tenth of its size, with thin walls and a gap hardly wider than a body.

    The depot is the corner of the bounds; the body's radius stays.
    """
    made = generate(seed, 2, obstacles=boxes, layout=layout)
    small = made.obstacles * 0.1
    wall = [
        [[49.0, 0, 0], [49.3, 60, 100]],
        [[49.0, 60 + 2.02 * RADIUS, 0], [49.3, 100, 100]],
    ]
    obstacles = np.concatenate([small[small[:, 0].min(axis=1) > 2.0], wall])
    items = [[46.0, 60 + 1.01 * RADIUS, 50], [52.0, 60 + 1.01 * RADIUS, 50]]
    free = gaps(np.array(items), obstacles) > RADIUS
    keep = [np.all(np.abs(np.array(items).mean(axis=0) - box.mean(axis=0)) > 12) for box in small]
    if not free.all():
        obstacles = np.concatenate([small[np.array(keep)], wall])
    bounds = [[0.0, 0, 0], [100, 100, 100]]
    return Scene("crowd", seed, bounds, [0.0, 0, 0], items, obstacles, epsilon=1.0)


def course_in(made: Scene) -> Course:
    """A course whose guidance, which is not wanted here, knows nothing of the boxes."""
    course = Course(dataclasses.replace(made, obstacles=[]), (0, 1))
    object.__setattr__(course, "scene", made)
    return course


def commands(kind: str, rng, before, q, boxes):
    """Raw actions (N, 3) that are bad for flying."""
    n = len(q)
    if kind == "uniform":
        return rng.uniform(-1, 1, (n, 3))
    if kind == "sticky":
        return np.where(rng.random((n, 1)) < 0.05, rng.normal(size=(n, 3)) * 3, before)
    middle = np.clip(q[:, None], boxes[None, :, 0], boxes[None, :, 1]) - q[:, None]
    nearest = np.linalg.norm(middle, axis=2).argmin(axis=1)
    into = middle[np.arange(n), nearest]
    return 3 * into / np.maximum(np.linalg.norm(into, axis=1, keepdims=True), 1e-9)


def can_brake(made: Scene, q, v) -> bool:
    """Whether full braking from a state keeps clear; whole slots take up to 0.1 m more."""
    speed = np.linalg.norm(v)
    end = q + v / speed * (speed**2 / (2 * A_MAX) + A_MAX * SLOT**2 / 8)
    inside = np.all((end >= made.bounds[0]) & (end <= made.bounds[1]))
    return bool(inside) and least_gap(np.array([q, end]), made.obstacles) > RADIUS


def crashes(made: Scene, kind: str, slots: int, seed: int, use_shield: bool = True) -> int:
    """Contacts and places outside the bounds in random flights, judged by positions and sensor."""
    sims = Simulations([course_in(made)], COUNT, rules=Rules(shield=use_shield), threads=1)
    rng = np.random.default_rng(seed)
    q = rng.uniform(*made.bounds, (8 * COUNT, 3))
    v = rng.normal(size=q.shape)
    v *= (rng.random((len(q), 1)) * V_MAX) / np.linalg.norm(v, axis=1, keepdims=True)
    chosen = np.flatnonzero([can_brake(made, *state) for state in zip(q, v, strict=True)])[:COUNT]
    sims.reset()
    sims.place(np.arange(len(chosen)), q[chosen], v[chosen])
    action, found = rng.normal(size=(COUNT, 3)), 0
    low, high = made.bounds
    for _ in range(slots):
        action = commands(kind, rng, action, sims.state[:, 1:4], made.obstacles)
        outcome = sims.step(action)
        path = sims.path.reshape(-1, 3)
        found += int((gaps(path, made.obstacles) < RADIUS - 1e-12).sum())
        found += int(np.maximum(low - path, path - high).max() > 1e-6)
        found += int(outcome.slot.crashed.sum())
    sims.close()
    return found


@settings(max_examples=4, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from(["floating", "city"]),
    st.integers(5, 20),
    st.sampled_from(["uniform", "sticky", "into boxes"]),
)
def test_random_commands_touch_nothing(seed, layout, boxes, kind):
    assert crashes(crowd(seed, layout, boxes), kind, 250, seed) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uniform", "sticky", "into boxes"])
@pytest.mark.parametrize(("layout", "seed"), [("floating", 1), ("city", 2), ("city", 3)])
def test_a_million_random_commands_touch_nothing(layout, seed, kind):
    assert crashes(crowd(seed, layout, 15), kind, 900, seed) == 0


@pytest.mark.parametrize("kind", ["uniform", "sticky", "into boxes"])
def test_without_it_the_same_flights_crash(kind):
    assert crashes(crowd(1, "city", 15), kind, 100, 1, use_shield=False) > 0


def test_far_from_everything_it_changes_nothing():
    world = world_of([[0, 0, 0], [1000, 1000, 1000]], [[[0.0, 0, 0], [10, 10, 10]]])
    rng = np.random.default_rng(0)
    q, v = rng.uniform(400, 600, (500, 3)), rng.normal(size=(500, 3)) * 15
    v *= np.minimum(1.0, V_MAX / np.linalg.norm(v, axis=1, keepdims=True))
    a = project(world, v, rng.uniform(-1, 1, (500, 3)))
    flown, _, acted = shielded(world, q, v, a)
    assert not acted.any()
    np.testing.assert_array_equal(flown, a)


def test_the_same_bits_for_one_and_for_many():
    made = crowd(3, "city", 15)
    rng, world = np.random.default_rng(0), World.stack([made])
    q, v = rng.uniform(*made.bounds, (200, 3)), rng.normal(size=(200, 3)) * 6
    a = project(world, v, rng.uniform(-1, 1, (200, 3)))
    many = shielded(world, q, v, a)
    assert many[2].any()
    assert not many[2].all()
    for i in range(200):
        one = shielded(world, q[i : i + 1], v[i : i + 1], a[i : i + 1])
        for ours, theirs in zip(one, many, strict=True):
            np.testing.assert_array_equal(ours[0], theirs[i])


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["floating", "city"]))
def test_from_every_place_where_it_holds_a_body_some_command_leads_on(seed, layout):
    made, rng = crowd(seed, layout, 12), np.random.default_rng(seed)
    sims = Simulations([course_in(made)], COUNT, threads=1)
    sims.reset()
    q = rng.uniform(*made.bounds, (20 * COUNT, 3))
    q = q[gaps(q, made.obstacles) > RADIUS + 0.01][:COUNT]
    sims.place(np.arange(COUNT), q, np.zeros_like(q))
    push = rng.normal(size=(COUNT, 3)) * 3
    for _ in range(150):  # into walls and corners
        sims.step(push)
    held = sims.state[:, 1:4].copy()
    moved = np.zeros(COUNT)
    ways = [sign * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    for way in ways:
        sims.place(np.arange(COUNT), held, np.zeros_like(held))
        for _ in range(15):
            sims.step(np.tile(way * 0.5, (COUNT, 1)))
            far = np.linalg.norm(sims.state[:, 1:4] - held, axis=1)
            moved = np.maximum(moved, far)
    sims.close()
    assert moved.min() > 1.0
