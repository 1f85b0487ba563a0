"""Racing lines: quicker than the law without them, never nearer to boxes than they say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crowds import FLAT, RADIUS, Flown, crowded, dense, gaps

from mjcollect.batch import Simulations
from mjcollect.bounds import leg_time
from mjcollect.course import Course
from mjcollect.disturbance import Disturbance, Disturbances
from mjcollect.episode import Rules
from mjcollect.flight import World, slot_path
from mjcollect.kernels.line import BEHIND, FASTER, follow_row
from mjcollect.planners.mpc import WALLS, Mpc
from mjcollect.racing_line import MOST_ROOM, least_slots, racing_line, rehearse
from mjcollect.scene import Scene
from train.flight_recorder import record

WALL = [[190.0, 0, 0], [210, 45, 60]]
NO_LINE = np.empty((0, 7))


def scene(obstacles, depot=(120.0, 12, 30), item=(285.0, 12, 30), **fields) -> Scene:
    return Scene("t", 0, FLAT, depot, [item], obstacles, **fields)


def without_line(course):
    """The same course, its guidance without lines."""
    plain = Course(course.scene, course.nodes, course.before, course.beyond)
    for guide in plain.guidance:
        guide.way = guide.way._replace(line=NO_LINE)
    return plain


@pytest.fixture(scope="module")
def bend():
    """Over a wall's end and back: a turn by more than a right angle."""
    return Course.segment(scene([WALL]), (0,), 0)


def test_a_sharp_turn_is_flown_quicker_and_clear(bend):
    line = bend.guidance[0].way.line
    assert len(line) > 2
    with_it, without = Flown(bend, 64, seed=7), Flown(without_line(bend), 64, seed=7)
    assert with_it.won.all()
    assert without.won.all()
    assert with_it.least_gap(bend.scene.obstacles) >= RADIUS - 1e-9
    assert with_it.farthest_outside(bend.scene.bounds) <= 1e-6
    assert with_it.slots.mean() < without.slots.mean() - 1


def test_only_flights_that_a_box_crosses_do_without():
    """The line was planned without it; those beside them keep theirs, bit for bit."""
    bend = Course.segment(scene([WALL], depot=(60.0, 12, 30), item=(345.0, 12, 30)), (0,), 0)
    assert len(bend.guidance[0].way.line) > 2
    calm = np.array([True, False])
    flights = []
    for level in (Disturbance(), Disturbance(mover=1e-9)):
        disturbances = Disturbances(level, 2, np.random.default_rng(0), calm=calm)
        rules = Rules("robust")
        sims = Simulations([bend], 2, rules=rules, threads=1, disturbances=disturbances)
        sims.place(np.arange(2), *bend.starts("point", 2, np.random.default_rng(0)))
        states = []
        for _ in range(60):
            sims.step(sims.episodes.guidance_action())
            states.append(np.concatenate([sims.episodes.q, sims.episodes.v], axis=1))
        flights.append(np.array(states))
    still, crossed = flights
    assert np.array_equal(still[:, 0], crossed[:, 0])
    assert not np.array_equal(still[:, 1], crossed[:, 1])


def test_a_line_out_of_a_corner_keeps_clear_of_the_bounds():
    """Else it would have no room, and could not be followed."""
    alley = scene([[[60.0, 8, 0], [100, 60, 60]]], depot=(0, 0, 0), item=(110, 50, 30))
    course = Course.segment(alley, (0,), 0)
    line = course.guidance[0].way.line
    assert len(line) > 2
    low, high = alley.bounds
    clear = np.minimum(line[:, :3] - low, high - line[:, :3]).min(axis=1)
    growing = clear[: np.argmax(clear > WALLS - 0.01)]
    assert len(growing) < 20
    assert (np.diff(growing) > 0).all()
    assert clear[len(growing) :].min() > WALLS - 0.01
    plain = without_line(course)
    assert rehearse(course.guidance[0], alley.depot[None]) < rehearse(
        plain.guidance[0], alley.depot[None]
    )


def test_a_straight_leg_has_no_line():
    assert len(Course.segment(scene([]), (0,), 0).guidance[0].way.line) == 0


def test_lines_keep_the_limits_and_the_room_they_claim(bend):
    space, line = bend.scene, bend.guidance[0].way.line
    q, v, room = line[:, :3], line[:, 3:6], line[:, 6]
    assert np.array_equal(line[0, :6], [*space.depot, 0, 0, 0])
    assert np.linalg.norm(np.diff(v, axis=0), axis=1).max() <= space.a_max * space.slot * (1 + 1e-9)
    assert np.linalg.norm(v, axis=1).max() <= space.v_max * (1 + 1e-9)
    assert room.max() <= MOST_ROOM
    assert room.min() >= 0.0
    for k in range(len(line) - 1):
        assert gaps(dense(q[k : k + 2]), space.obstacles).min() >= RADIUS + room[k]


@pytest.mark.parametrize("seed", range(4))
def test_crowded_scenes_are_never_flown_slower_on_average(seed):
    course = Course.segment(crowded(seed, 12), (0,), 0)
    flown, without = Flown(course, 32, seed=5), Flown(without_line(course), 32, seed=5)
    assert flown.won.all()
    assert flown.least_gap(course.scene.obstacles) >= RADIUS - 1e-9
    assert flown.slots.mean() <= without.slots.mean() + 1


def test_a_rehearsal_is_the_flight_in_mujoco(bend):
    guide = bend.guidance[0]
    q, v = bend.starts("spread", 24, np.random.default_rng(3))
    flown = Flown(bend, 24, places=(q, v))
    expected = np.where(flown.won, flown.slots, np.inf)
    assert np.array_equal(rehearse(guide, q, v), expected)
    assert np.isfinite(expected).sum() > 12


def test_slot_path_is_the_motion_of_mujoco(bend):
    rng = np.random.default_rng(0)
    sims = Simulations([bend], 8, threads=1)
    q, v, a = rng.uniform(20, 50, (8, 3)), rng.uniform(-20, 20, (8, 3)), rng.uniform(-9, 9, (8, 3))
    sims.place(np.arange(8), q, v)
    sims.roll(a)
    path, end = slot_path(World.stack([bend.scene]), q, v, a)
    assert np.allclose(path[:, 1:], sims.path, rtol=0, atol=1e-11)
    assert np.allclose(end, sims.speeds[:, -1], rtol=0, atol=1e-11)
    assert np.array_equal(path[:, 0], q)
    sims.close()


def test_the_same_scene_gives_the_same_line(bend):
    again = Course.segment(scene([WALL]), (0,), 0).guidance[0].way.line
    assert np.array_equal(again, bend.guidance[0].way.line)
    fresh = without_line(bend).guidance[0]
    assert np.array_equal(racing_line(fresh), again)


def test_least_slots_of_a_straight_leg_is_the_analytic_number():
    course = Course.segment(scene([], item=(300.0, 30, 30)), (0,), 0)
    q = np.random.default_rng(1).uniform(*FLAT, (50, 3))
    space = course.scene
    far = np.maximum(np.linalg.norm(space.items[0] - q, axis=1) - space.epsilon, 0.0)
    expected = np.ceil(leg_time(far, space.v_max, space.a_max) / space.slot - 1e-6)
    more = least_slots(course.guidance[0], q) - expected  # its aim is a little aside
    assert more.min() >= 0
    assert more.max() <= 1
    assert np.mean(more == 0) > 0.5


def test_a_plan_for_a_bigger_body_keeps_farther_from_boxes(bend):
    def least(body):
        planner = Mpc(bend, body=body)
        flight = record(bend, lambda _, task: planner.action(task.episodes))
        assert flight.success
        return gaps(dense(flight.trajectory.x), bend.scene.obstacles).min()

    assert least(None) < 2.5
    assert least(4.0) >= 4.0 - 1e-6


def moved(vector, x, y, z):
    return vector + np.array([x, y, z])


class TestFollow:
    """When a line is followed: at its place, within its room, not faster than it is."""

    world = World.stack([Scene("t", 0, FLAT, (10.0, 30, 30), [(390.0, 30, 30)], [])])
    t = 0.2 * np.arange(12)
    line = np.zeros((12, 7))
    line[:, 0], line[:, 1:3], line[:, 3], line[:, 6] = 50 + 10 * t**2, 30.0, 20 * t, 3.0

    def follows(self, q, v):
        action = np.full(3, np.nan)
        if not follow_row(self.world, 0, self.line, np.array(q), np.array(v), action):
            return None
        assert np.linalg.norm(action) <= 1 + 1e-9
        return action

    def test_on_the_line_its_own_acceleration(self):
        for k in range(10):
            action = self.follows(self.line[k, :3], self.line[k, 3:6])
            np.testing.assert_allclose(action, [1, 0, 0], atol=1e-6)

    def test_beside_it_back_towards_it(self):
        q, v = self.line[5, :3], self.line[5, 3:6]
        assert self.follows(moved(q, 0, 2.5, 0), v)[1] < -0.1
        assert self.follows(moved(q, 0, 0, -2.5), v)[2] > 0.1
        assert abs(self.follows(moved(q, 0, 1.0, 0), v)[1]) < 1e-9  # within the idle share

    def test_not_out_of_its_room_or_on_the_way_there(self):
        q, v = self.line[5, :3], self.line[5, 3:6]
        assert self.follows(moved(q, 0, 3.1, 0), v) is None
        assert self.follows(moved(q, 0, 2.5, 0), moved(v, 0, 6.0, 0)) is None

    def test_not_faster_nor_far_from_its_place_nor_past_its_end(self):
        q, v = self.line[5, :3], self.line[5, 3:6]
        assert self.follows(moved(q, -5 * BEHIND, 0, 0), v) is None
        assert self.follows(q, moved(v, 20 + 2 * FASTER, 0, 0)) is None
        assert self.follows(self.line[11, :3], self.line[11, 3:6]) is None

    def test_without_a_line_nothing_is_followed(self):
        action = np.empty(3)
        for line in (NO_LINE, self.line[:1]):
            assert not follow_row(self.world, 0, line, self.line[0, :3], np.zeros(3), action)


def test_a_line_must_pay_for_itself(bend, monkeypatch):
    """Where no plan is quicker from the whole ball, there is none."""
    guide = without_line(bend).guidance[0]
    slow = dataclasses.replace(bend.scene, a_max=5.0)
    monkeypatch.setattr(
        "mjcollect.racing_line._planned",
        lambda _, body: np.tile(np.append(slow.depot, np.zeros(4)), (40, 1)),
    )
    assert len(racing_line(guide)) == 0
