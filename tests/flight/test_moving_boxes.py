"""Moving boxes against hand-computed places and the exact distance to a box that stands still."""

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.flight.moving_boxes import (
    LEAST_WAY,
    MET,
    SIDE,
    SIGHT,
    SOON,
    STEPS,
    SWING,
    MovingBoxes,
)
from mjcollect.planners.mpc import Mpc
from mjcollect.scene.scene import Scene

START, GOAL = np.array([[100.0, 500.0, 500.0]]), np.array([[900.0, 500.0, 500.0]])


@pytest.fixture(scope="module")
def course():
    """An item 800 m ahead in an empty room."""
    room = Scene("room", 0, [[0, 0, 0], [1000] * 3], START[0], GOAL, [])
    return Course.segment(room, (0,), 0)


def flights(course, level, count, observation="robust"):
    disturbances = Disturbances(level, count, np.random.default_rng(0))
    rules = Rules(observation, shield=False, estimate="none")  # either would keep from the boxes
    sims = Simulations([course], count, rules=rules, threads=1, disturbances=disturbances)
    sims.place(np.arange(count), np.tile(START, (count, 1)), np.zeros((count, 3)))
    return sims


def drawn(count, speed=10.0):
    movers = MovingBoxes(count)
    ends = np.tile(START, (count, 1)), np.tile(GOAL, (count, 1))
    movers.begin(np.arange(count), *ends, np.full((count, 1), speed), np.random.default_rng(0))
    return movers


def test_go_to_and_fro_across_the_way_at_their_speed():
    movers, seconds = drawn(50), 0.1
    period = 4 * SWING / 10.0
    places = []
    for _ in range(round(period / seconds)):
        places.append(movers.centres()[:, 0])
        movers.move(seconds)
    places = np.array(places)
    np.testing.assert_allclose(movers.centres()[:, 0], places[0], atol=1e-9)
    assert np.ptp(places[:, :, [0, 2]], axis=0).max() < 1e-6  # across a way along x: along y
    swing = places[:, :, 1] - 500.0
    assert np.abs(swing).max() <= SWING + 1e-9
    assert np.abs(swing).max(axis=0).min() > SWING - 1.0
    speed = np.abs(np.diff(swing, axis=0)) / seconds
    assert np.median(speed) == pytest.approx(10.0)
    assert speed.max() <= 10.0 + 1e-9
    assert 100 + 0.35 * 800 <= places[:, :, 0].min() <= places[:, :, 0].max() <= 100 + 0.65 * 800


def test_short_legs_and_calm_flights_have_none():
    movers = MovingBoxes(2)
    goal = START + np.array([[LEAST_WAY - 1, 0, 0], [LEAST_WAY + 1, 0, 0]])
    movers.begin(np.arange(2), np.tile(START, (2, 1)), goal, np.full((2, 1), 5.0),
                 np.random.default_rng(0))  # fmt: skip
    assert (movers.speed > 0).tolist() == [[False], [True]]
    assert not np.isfinite(movers.boxes[0]).all() or np.abs(movers.boxes[0]).min() > 1e6
    still, none = np.zeros((3, 3)), drawn(3, speed=0.0)
    assert (none.seen(np.tile(START, (3, 1)), still, np.full((3, 1), 50.0)) == 0).all()


def test_touch_is_judged_between_body_and_box_both_moving(course):
    """A body at rest is hit when the box comes within its radius, and not before."""
    movers = drawn(1)
    world = flights(course, Disturbance(mover=10.0), 1).episodes.world
    centre = movers.centres()[0, 0]
    side = np.sign(movers.centres(0.05)[0, 0, 1] - centre[1])
    for gap, hit in ((0.5 + 1.9, True), (0.5 + 2.1, False)):  # it moves 2 m in the slot
        body = centre + np.array([0.0, side * (SIDE / 2 + gap), 0.0])
        whole = np.tile(body, (1, world.substeps + 1, 1))
        assert movers.touched(world, whole).any() == hit
        away = whole + np.linspace(0, side * 4.0, world.substeps + 1)[None, :, None] * [0, 1, 0]
        assert not movers.touched(world, away).any()


def test_are_seen_with_their_velocity(course):
    movers = drawn(20)
    centre, top, v = movers.centres()[:, 0], np.full((20, 1), 50.0), np.zeros((20, 3))
    v[:, 0] = 10.0
    seen = movers.seen(centre - [SIDE / 2 + SIGHT / 4, 0, 0], v, top)
    assert (seen[:, 1:] == 0.0).all()  # there is one box only
    np.testing.assert_allclose(seen[:, 0, 0], [[0.75, 0.0, 0.0]] * 20, atol=1e-9)
    np.testing.assert_allclose(np.abs(seen[:, 0, -1]), [[0.0, 0.2, 0.0]] * 20, atol=1e-6)
    for k, seconds in enumerate(SOON):  # 10 m nearer each second, and beside its middle still
        nearness = 0.75 + 10.0 * seconds / SIGHT
        np.testing.assert_allclose(seen[:, 0, 1 + k], [[nearness, 0, 0]] * 20, atol=1e-5)
    assert (movers.seen(centre - [SIDE / 2 + SIGHT + 1, 0, 0], v, top) == 0.0).all()


def test_the_nearest_are_shown_and_every_box_is_judged(course):
    """Three boxes: the two nearest are shown in order; whichever touches, the touch counts."""
    movers = MovingBoxes(1, 3)
    movers.begin(np.array([0]), START, GOAL, np.full((1, 3), 4.0), np.random.default_rng(3), 0.5)
    world = flights(course, Disturbance(mover=10.0), 1).episodes.world
    centres = movers.centres()[0]
    q = centres[1] + [0, 0, SIDE / 2 + 5.0]
    offset = np.abs(q - centres) - SIDE / 2
    distance = np.linalg.norm(np.maximum(offset, 0.0), axis=1)
    seen = movers.seen(q[None], np.zeros((1, 3)), np.full((1, 1), 50.0))[0, :, 0]
    nearest = np.maximum(1.0 - np.sort(distance)[:2] / SIGHT, 0.0)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), nearest)
    for box in range(3):
        path = np.tile(centres[box] + [0, 0, SIDE / 2 + 0.4], (1, world.substeps + 1, 1))
        assert movers.touched(world, path).any()


def test_a_path_of_several_corners_is_followed_there_and_back():
    """Against places worked out by hand: 3 m along x, then 4 m along y, at 1 m/s."""
    movers = MovingBoxes(1, 1, 3)
    movers.path[:] = [[0, 0, 0], [3, 0, 0], [3, 4, 0]]
    movers.speed[:], movers.half[:] = 1.0, 0.5
    for seconds, place in ((0, (0, 0)), (2, (2, 0)), (5, (3, 2)), (7, (3, 4)), (9, (3, 2)),
                           (12, (2, 0)), (14, (0, 0)), (15, (1, 0))):  # fmt: skip
        np.testing.assert_allclose(movers.centres(float(seconds))[0, 0, :2], place, atol=1e-9)
    movers.move(5.0)
    np.testing.assert_allclose(movers.velocities[0, 0], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(movers.ahead()[0, 0, 8], [0, 1, 0], atol=1e-9)  # after 1 s
    movers.told = True
    np.testing.assert_allclose(movers.ahead()[0, 0, 24], [0, 1, 0], atol=1e-9)  # there and back


def test_the_law_waits_for_a_slow_one_and_a_blind_flight_does_not(course):
    """The box is seen as one that stands: what rushes on hits it now and then, the law rarely."""
    count = 60
    hits = {}
    for name in ("law", "blind"):
        sims = flights(course, Disturbance(mover=2.0), count)
        blind = flights(course, Disturbance(), count)
        running, hit = np.ones(count, bool), np.zeros(count, bool)
        while running.any():
            pilot = sims if name == "law" else blind
            action = pilot.episodes.guidance_action().copy()
            blind.step(action)
            outcome = sims.step(action)
            hit |= running & outcome.slot.contact
            running &= ~(outcome.terminated | outcome.truncated)
        hits[name] = hit.mean()
    assert hits["blind"] > 0.2
    assert hits["law"] < hits["blind"] / 4


@pytest.mark.parametrize("sees", [True, False])
def test_the_mpc_keeps_from_a_box_that_it_sees(course, sees):
    """One that stands in the way, of which the way does not know: it goes round."""
    sims = flights(course, Disturbance(mover=1e-6), 1)
    sims.episodes.disturbances.movers.phase[:] = 0.25  # right in the way
    planner, hit, ended = Mpc(course), False, False
    while not ended:
        if sees:
            action = planner.action(sims.episodes)
        else:
            plan = planner.plan(sims.episodes.q[0], sims.episodes.seen_v[0], 0)
            action = plan.a[0] / course.scene.a_max
        outcome = sims.step(action[None])
        hit |= bool(outcome.slot.contact[0])
        ended = bool(outcome.terminated[0] | outcome.truncated[0])
    assert hit != sees
    assert bool(outcome.success[0]) == sees


def test_where_a_body_would_come_nearest_to_a_box_is_foretold():
    movers = MovingBoxes(1, boxes=2)
    movers.path[0, 0] = [[400.0, 0, 500], [400, 1000, 500]]  # along y, and one that is not there
    movers.half[0], movers.phase[0, 0], movers.speed[0, 0] = 20.0, 0.25, 10.0  # now at y = 500
    here, velocity = np.array([300.0, 490.0, 500.0]), np.array([40.0, 10.0, 0.0])
    ways = here + STEPS[:, None] * np.array([velocity, [0.0, 0.0, 0.0]])[:, None]
    met = movers.met(ways[None])
    # As fast across as the box it passes 10 m below its centre, so through it, after 2.5 s.
    np.testing.assert_allclose(met[0, 0, 0], [0, 1, 0, np.exp(-2.5 / SOON[-1])], atol=1e-9)
    # At rest it is nearest now, 80 m from the surface.
    way = np.array([100.0, 10.0, 0.0]) / np.hypot(100.0, 10.0) / (1.0 + 80.0 / MET)
    np.testing.assert_allclose(met[0, 0, 1], [*way, 1.0], atol=1e-9)
    assert not met[0, 1].any()
