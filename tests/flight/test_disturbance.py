"""Disturbed flights against hand-computed motion and the statistics they are drawn by."""

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.contact import MARGIN
from mjcollect.flight.disturbance import REST_SPEED, SPARED, Disturbance, Disturbances
from mjcollect.flight.disturbance_estimate import GUST_SECONDS
from mjcollect.scene.scene import Scene

SLOT, STEP, N = 0.2, 0.02, 10


@pytest.fixture(scope="module")
def course():
    """An item 60 m ahead in an empty room."""
    room = Scene("room", 0, [[0, 0, 0], [200, 200, 200]], [100, 100, 100], [[160, 100, 100]], [])
    return Course.mission(room, (0,))


def flights(course, level, count=4, seed=3, estimate="none", **kwargs):
    disturbances = Disturbances(level, count, np.random.default_rng(seed), **kwargs)
    rules = Rules(estimate=estimate)
    sims = Simulations([course], count, rules=rules, threads=1, disturbances=disturbances)
    place(sims, course, count)
    return sims


def place(sims, course, count):
    sims.place(np.arange(count), *course.starts("point", count, np.random.default_rng(0)))


def test_none_is_the_undisturbed_flight_bit_for_bit(course):
    calm, still = Simulations([course], 4, threads=1), flights(course, Disturbance())
    place(calm, course, 4)
    for _ in range(40):
        one = calm.step(calm.episodes.guidance_action())
        two = still.step(still.episodes.guidance_action())
        np.testing.assert_array_equal(calm.state, still.state)
        np.testing.assert_array_equal(one.reward, two.reward)
        np.testing.assert_array_equal(one.success, two.success)
    assert one.success.any() or calm.episodes.target.min() > 0


def test_wind_accelerates_all_the_time(course):
    sims = flights(course, Disturbance(wind=3.0))
    begun = sims.episodes.truth.copy()
    for _ in range(5):
        sims.step(np.zeros((4, 3)))
    moved = sims.episodes.truth - begun
    steps = 5 * N
    expected = 3.0 * STEP**2 * steps * (steps + 1) / 2  # semi-implicit Euler
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), expected, rtol=1e-9)
    np.testing.assert_allclose(moved[:, 2], 0.0, atol=1e-12)
    assert np.ptp(moved[:, 0]) > 0.1  # directions differ


def test_gain_and_delay_change_what_is_flown(course):
    action = np.tile([1.0, 0.0, 0.0], (4, 1))
    gained = flights(course, Disturbance(gain=0.2), 32)
    gained.step(np.tile(action[:1], (32, 1)))
    speed = gained.episodes.v[:, 0] / (course.scene.a_max * SLOT)
    assert set(np.round(speed, 9)) == {0.8, 1.2}
    late = flights(course, Disturbance(delay=0.06))
    late.step(action)
    np.testing.assert_allclose(late.episodes.v[:, 0], course.scene.a_max * (SLOT - 0.06))
    late.step(0 * action)  # the first command lasts into the second slot
    np.testing.assert_allclose(late.episodes.v[:, 0], course.scene.a_max * SLOT)


def test_gusts_have_their_strength_and_memory(course):
    count = 4000
    gusts = Disturbances(Disturbance(gusts=2.0), count, np.random.default_rng(0))
    gusts.begin(np.arange(count), np.zeros((count, 3)), np.zeros((count, 3)))
    world = Simulations([course], 1, threads=1).episodes.world
    begun = gusts.controls(world, np.zeros((count, 3)))[:, 0]
    for _ in range(5):
        last = gusts.controls(world, np.zeros((count, 3)))
    assert begun.std() == pytest.approx(2.0, rel=0.03)
    assert last.std() == pytest.approx(2.0, rel=0.03)
    seconds = 5 * SLOT + (N - 1) * STEP
    memory = (begun * last[:, -1]).mean() / 4.0
    assert memory == pytest.approx(np.exp(-seconds / GUST_SECONDS), abs=0.03)


def test_noise_is_in_what_is_seen_alone(course):
    count = 2000
    sims = flights(course, Disturbance(noise=0.5), count)
    sims.step(np.zeros((count, 3)))
    np.testing.assert_array_equal(sims.episodes.truth, np.tile(course.scene.depot, (count, 1)))
    error = sims.episodes.q - sims.episodes.truth
    assert error.std(axis=0) == pytest.approx([0.5] * 3, rel=0.1)
    assert abs(error.mean()) < 0.05
    seen = sims.episodes.observe()["goal_offset"]
    assert np.ptp(seen, axis=0).max() > 0.0


def test_commands_beyond_the_limit_are_cut(course):
    calm = Disturbances(Disturbance(), 1, np.random.default_rng(0))
    world = Simulations([course], 1, threads=1).episodes.world
    flown = calm.controls(world, np.array([[30.0, 40.0, 0.0]]))
    np.testing.assert_allclose(flown[0, 0], [12.0, 16.0, 0.0])


def test_a_stop_that_is_blown_on_has_not_arrived(course):
    """Wind adds 0.2 s of itself to a stop's speed: more than rest from 10 m/s^2 on."""
    goal = course.guidance[0].goal
    for wind, arrives in ((9.9, True), (10.1, False)):
        sims = flights(course, Disturbance(wind=wind), 1)
        sims.place(np.array([0]), goal[None].copy(), np.zeros((1, 3)))
        outcome = sims.step(np.zeros((1, 3)))
        assert np.linalg.norm(sims.episodes.v) == pytest.approx(wind * SLOT)
        assert (wind * SLOT <= REST_SPEED) == arrives
        assert outcome.slot.arrived[0] == arrives
        assert sims.episodes.target[0] == arrives


def test_bounds_are_left_beyond_the_margin_only(course):
    sims = flights(course, Disturbance(), 2)
    q = np.array([[-MARGIN + 0.1, 50, 50], [-MARGIN - 0.1, 50, 50]])
    sims.place(np.arange(2), q, np.zeros((2, 3)))
    assert sims.step(np.zeros((2, 3))).slot.outside.tolist() == [False, True]


def test_levels_vary_up_to_the_greatest(course):
    level = Disturbance(wind=4.0, gusts=0.0, gain=0.3, delay=0.2, noise=1.0)
    sims = flights(course, level, 500, vary=True)
    action = np.tile([1.0, 0.0, 0.0], (500, 1))
    sims.step(action)
    along = sims.episodes.v[:, 0] / course.scene.a_max
    assert along.max() < SLOT * 1.3 + 4.0 * SLOT / 20
    assert along.min() < 0.05
    assert np.ptp(along) > 0.15
    spared = np.isclose(sims.episodes.disturbances._noise, 0.0).mean()
    assert spared == pytest.approx(SPARED, abs=0.08)


def test_one_to_all_of_the_boxes_move_where_levels_vary(course):
    far = Course.mission(
        Scene("hall", 0, [[0, 0, 0], [900] * 3], [100, 450, 450], [[800, 450, 450]], []), (0,)
    )
    sims = flights(far, Disturbance(mover=5.0, boxes=3, turned=60.0), 300, vary=True)
    movers = sims.episodes.disturbances.movers
    moving = (movers.speed > 0).sum(axis=1)
    assert set(moving) == {0, 1, 2, 3}
    path = movers.path[movers.speed > 0]
    across = path[:, 1] - path[:, 0]
    turned = np.degrees(np.arctan2(np.abs(across[:, 0]), np.abs(across[:, 1])))
    assert 50.0 < turned.max() <= 60.0 + 1e-9


def test_goes_on_from_a_saved_state(course):
    level = Disturbance(wind=2.0, gusts=1.0, gain=0.1, delay=0.1, noise=0.3)
    first = flights(course, level, vary=True)
    for _ in range(7):
        first.step(first.episodes.guidance_action())
    saved = first.episodes.disturbances.state_dict()
    other = Disturbances(level, 4, np.random.default_rng(99), vary=True)
    other.load_state_dict(saved)
    world = first.episodes.world
    command = np.ones((4, 3))
    for _ in range(3):
        np.testing.assert_array_equal(
            first.episodes.disturbances.controls(world, command), other.controls(world, command)
        )


@pytest.mark.parametrize(
    ("field", "value"),
    [("wind", -1.0), ("gain", 1.0), ("delay", np.nan), ("noise", np.inf), ("boxes", 0)],
)
def test_bad_levels_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field}: {value}"):
        Disturbance(**{field: value})


def test_the_law_brings_back_what_was_blown_over_a_bound(course):
    """At rest or on its way out; MARGIN lets the flight go on."""
    count = 3
    sims = flights(course, Disturbance(), count)
    q = np.array([[-2.0, 50, 50], [-1, 50, -1], [201, 100, 201.5]])
    v = np.array([[0.0, 0, 0], [-2, 1, -1], [1, 0, 3]])
    sims.place(np.arange(count), q, v)
    arrived = np.zeros(count, dtype=bool)
    for _ in range(60):
        arrived |= sims.step(sims.episodes.guidance_action()).slot.arrived
        assert not sims.episodes.crashed.any()
    assert arrived.all()


@pytest.mark.parametrize("wind", [0.5, 1.0])
def test_the_law_flies_a_tour_from_a_corner_of_the_bounds_in_wind(wind):
    room = Scene("room", 0, [[0, 0, 0], [200, 200, 200]], [0, 0, 0], [[150, 100, 100]], [])
    home = Course.mission(room, (0,))
    sims = flights(home, Disturbance(wind=wind), 16)
    done = np.zeros(16, dtype=bool)
    for _ in range(home.step_limit):
        done |= sims.step(sims.episodes.guidance_action()).success
        assert not sims.episodes.crashed[~done].any()
    assert done.all()
