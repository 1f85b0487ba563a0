"""The shield in disturbed air: its margins hold as often as they say, and give way slowly."""

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.contact import MARGIN
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.flight.disturbance_estimate import Estimate
from mjcollect.flight.disturbed_shield import (
    BRAKES,
    CHANCE,
    GIVE,
    HELD,
    LAG,
    RESTS,
    SAG,
    Margins,
    disturbed_shield,
    manoeuvre_row,
)
from mjcollect.flight.moving_boxes import STEPS
from mjcollect.flight.projection import project
from mjcollect.flight.world import World
from mjcollect.geometry.tree import in_one_leaf
from mjcollect.scene.scene import Scene

A_MAX, SLOT = 20.0, 0.2
NOWHERE = np.full((1, 1, 2, 3), 1e9)
FULL = Disturbance(wind=5.0, gusts=2.5, gain=0.25, delay=0.1, noise=0.5)


def world_of(boxes=NOWHERE):
    return World(
        np.array([[[-500.0] * 3, [500.0] * 3]]), *in_one_leaf(np.asarray(boxes, float)),
        np.array([[50.0]]), np.array([[A_MAX]]), np.array([[0.5]]), np.ones((1, 1)),
        np.array([[2.0]]), SLOT, 0.02, 10,
    )  # fmt: skip


def margins_of(count=1, boxes=NOWHERE, velocity=(0.0, 0.0, 0.0), spread=0.0, blur=0.0):
    known = Estimate.calm(count)._replace(
        spread=np.full((count, 1), spread), blur=np.full((count, 1), blur)
    )
    ahead = np.asarray(velocity)[None, None, None] * STEPS[:, None]
    v = np.zeros((count, 3))
    return Margins.of(known, np.array([[A_MAX]]), v, np.asarray(boxes, float), ahead)


def shielded(world, margins, q, v, a, asked=1.0):
    """What is flown of a command, whether it was changed, its room and what is asked for next."""
    q, v, a = (np.array(value, float)[None].copy() for value in (q, v, a))
    stop, acted = np.zeros(1, bool), np.zeros(1, bool)
    asked, room = np.full(1, asked), np.ones(1)
    disturbed_shield(
        world, margins, q, v, a, stop, np.zeros((1, 3)), np.zeros(1, np.intp), asked, room, acted
    )
    return a[0], bool(acted[0]), room[0], asked[0]


def manoeuvre(world, margins, i, q, v, a, more=0):
    most = 2 * (max(HELD) + 1) + BRAKES + len(RESTS) + 1
    path, times = np.empty((most, 3)), np.empty(most)
    count = manoeuvre_row(world, i, margins.braking[i, 0], q, v, a, more, path, times)
    return path[:count], times[:count]


@pytest.mark.parametrize("more", [0, 2, 8])
def test_a_backup_in_calm_air_is_what_is_flown(more):
    """Against MuJoCo's semi-implicit steps: held, then braked, then at rest."""
    world, margins = world_of(), margins_of()
    q, v, a = np.zeros(3), np.array([8.0, -3.0, 1.0]), np.array([-5.0, 12.0, 4.0])
    path, times = manoeuvre(world, margins, 0, q, v, a, more)
    at, now, seconds, where = q.copy(), v.copy(), 0.0, {0.0: q.copy()}
    for slot in range(120):
        speed = np.linalg.norm(now)
        flown = a if slot <= more else -now / max(speed, 1e-9) * min(A_MAX, speed / SLOT)
        for _ in range(10):
            now = now + flown * 0.02
            at = at + now * 0.02
            seconds += 0.02
            where[round(seconds, 2)] = at.copy()
    for point, time in zip(path, times, strict=True):
        if time <= (more + 1) * SLOT + 1e-9:
            np.testing.assert_allclose(point, where[round(time, 2)], atol=1e-9)
    np.testing.assert_allclose(path[-1], at, atol=0.25)  # braking is no parabola in slots
    assert times[-1] == pytest.approx(times[-1 - len(RESTS)] + RESTS[-1])


@pytest.mark.parametrize(("share", "slots"), [(1.0, 5), (1.0, 25), (0.5, 25), (0.25, 25)])
def test_who_brakes_strays_beyond_the_margin_no_more_often_than_stated(share, slots):
    """Flights in disturbed air that brake after some slots, against the tube foretold for them."""
    count, rng = 400, np.random.default_rng(1)
    room = Scene("room", 0, [[0, 0, 0], [4000] * 3], [2000] * 3, [[3500, 2000, 2000]], [])
    air = Disturbances(FULL.times(share), count, np.random.default_rng(2))
    sims = Simulations(
        [Course.segment(room, (0,), 0)], count, rules=Rules(shield=False), threads=1,
        disturbances=air,
    )  # fmt: skip
    sims.place(np.arange(count), np.full((count, 3), 2000.0), np.zeros((count, 3)))
    action = np.zeros((count, 3))
    for slot in range(slots + 1):
        if slot % 4 == 0:
            fresh = rng.normal(size=(count, 3))
            action = 0.7 * action + 0.5 * fresh / np.linalg.norm(fresh, axis=1, keepdims=True)
        if slot < slots:
            sims.step(action)
    episodes = sims.episodes
    known, a_max = episodes.known, episodes.world.a_max
    margins = Margins.of(
        known, a_max, episodes.seen_v, np.tile(NOWHERE, (count, 1, 1, 1)),
        np.zeros((count, 1, len(STEPS), 3)),
    )  # fmt: skip
    a = known.flown(known.counter(project(episodes.seen_world, episodes.seen_v, action), a_max))
    q, v, world = episodes.q, episodes.seen_v, episodes.seen_world
    tubes = np.array([manoeuvre(world, margins, i, q[i], v[i], a[i])[0] for i in range(count)])
    strayed = np.zeros(count, bool)
    for slot in range(18):
        sims.step(action)
        for k in (4, 9):
            seconds = slot * SLOT + (k + 1) * 0.02 - known.late
            margin = margins.blur + margins.spread * LAG * np.maximum(seconds, 0.0)
            strayed |= off(tubes, sims.path[:, k]) > np.maximum(margin, SAG)[:, 0]
        v = episodes.seen_v
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        left = episodes.seen_world.a_max
        action = -v / np.maximum(speed, 1e-12) * np.minimum(left, speed / SLOT) / left
    assert 0.0 < strayed.mean() <= CHANCE


def off(paths, points):
    """The distances of points (n, 3) from polylines (n, P, 3)."""
    step, begun = np.diff(paths, axis=1), points[:, None] - paths[:, :-1]
    share = np.sum(begun * step, axis=2) / np.maximum(np.sum(step**2, axis=2), 1e-12)
    away = begun - np.clip(share, 0.0, 1.0)[..., None] * step
    return np.linalg.norm(away, axis=2).min(axis=1)


def test_the_margin_grows_with_what_is_not_known():
    """Flying at a wall: with more spread and blur, commands are changed from farther away."""
    wall = [[[[100.0, -200, -200], [120, 200, 200]]]]
    begins = []
    for spread, blur in ((0.0, 0.0), (1.0, 0.0), (3.0, 0.0), (3.0, 1.0)):
        margins = margins_of(spread=spread, blur=blur)
        acted = [
            shielded(world_of(wall), margins, [x, 0, 0], [20.0, 0, 0], [0.0, 0, 0])[1]
            for x in np.arange(40.0, 95.0, 0.5)
        ]
        begins.append(int(np.argmax(acted)))
    assert begins[0] > begins[1] > begins[2] > begins[3]


def test_nothing_is_changed_where_there_is_room():
    a, acted, room, asked = shielded(world_of(), margins_of(spread=2.0), [0, 0, 0], [9.0, 0, 0],
                                     [3.0, 4.0, 5.0])  # fmt: skip
    assert (not acted, room, asked) == (True, 1.0, 1.0)
    np.testing.assert_array_equal(a, [3.0, 4.0, 5.0])


def test_bounds_count_beyond_their_margin():
    world, margins = world_of(), margins_of(spread=1.0, blur=0.1)
    _, acted, _, _ = shielded(world, margins, [504.0, 0, 0], [0.0] * 3, [A_MAX, 0, 0])
    assert acted
    _, acted, _, _ = shielded(world, margins, [504.0, 0, 0], [0.0] * 3, [-A_MAX, 0, 0])
    assert not acted
    a, _, _, _ = shielded(world, margins, [500.0 + MARGIN, 0, 0], [0.0] * 3, [0.0, 0, 0])
    assert a[0] < 0.0  # outside, it comes back


def test_a_box_that_comes_along_is_left_in_time():
    """A body at rest in its way is moved aside, whatever it asks for, and is never touched."""
    box = np.array([[[[-60.0, -20, -20], [-20, 20, 20]]]])
    world, q, v = world_of(), np.zeros(3), np.zeros(3)
    moved = 0
    for slot in range(60):
        here = box + np.array([10.0, 0, 0]) * SLOT * slot
        margins = margins_of(boxes=here, velocity=(10.0, 0.0, 0.0))
        a, acted, _, _ = shielded(world, margins, q, v, [0.0, 0, 0])
        moved += acted
        for step in range(1, 11):
            v = v + a * 0.02
            q = q + v * 0.02
            now = here[0, 0] + np.array([10.0, 0, 0]) * 0.02 * step
            assert np.linalg.norm(np.clip(q, now[0], now[1]) - q) >= 0.5
    assert moved > 3


def test_creeping_asks_for_less_and_flying_on_for_more():
    wall = [[[[1.5, -200, -200], [20, 200, 200]]]]
    margins = margins_of(spread=3.0)
    into = ([0.0, 0, 0], [0.0] * 3, [5.0, 0, 0])
    asked, seen = 1.0, []
    for _ in range(30):
        _, acted, room, after = shielded(world_of(wall), margins, *into, asked)
        seen.append((asked, acted))
        assert after == pytest.approx(max(asked - GIVE, 0.0) if acted else min(asked + GIVE, 1.0))
        assert acted or room >= asked
        asked = after
    assert not seen[-1][1] or seen[-1][0] < 0.5  # it gave way
    fast = shielded(world_of(wall), margins, [-20.0, 0, 0], [20.0, 0, 0], [5.0, 0, 0], 0.5)
    assert fast[1]
    assert fast[3] == pytest.approx(0.5 + GIVE)  # whoever is fast is given nothing


def test_before_a_moving_box_the_margin_never_gives_way():
    box = np.array([[[[1.5, -20, -20], [40, 20, 20]]]])
    margins = margins_of(spread=3.0, boxes=box)
    for asked in (1.0, 0.5, 0.0):
        a, acted, _, _ = shielded(world_of(), margins, [0.0] * 3, [0.0] * 3, [5.0, 0, 0], asked)
        assert acted
        assert a[0] < 5.0
