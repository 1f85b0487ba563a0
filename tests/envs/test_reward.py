from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.reward import PRESETS, lost_reward, paper_reward, potential, time_reward
from mjcollect.flight.contact import Slot
from mjcollect.flight.world import World
from mjcollect.guidance.approach import Approach
from mjcollect.scene.scene import Scene

A, TOP, SLOT, GAMMA = 20.0, 50.0, 0.2, 0.99
WORLD = World.stack([Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [])])


def approach(distance, closing, offset=None, returning=False, slack=0.0, next_excess=0.0):
    """What rewards read of an `Approach`."""
    distance, closing = np.atleast_1d(distance).astype(float), np.atleast_1d(closing).astype(float)
    count = len(distance)
    offset = np.zeros((count, 3)) if offset is None else np.asarray(offset, float)
    made = SimpleNamespace(
        closing=closing,
        speed=np.abs(closing),
        offset=offset,
        returning=np.full(count, returning),
        near=np.maximum(distance - slack, 0.0),
        far=distance + slack,
        next_excess=np.full(count, next_excess),
    )
    made.time_to_go = lambda world: Approach.time_to_go(made, world)  # type: ignore[arg-type]
    return made


def events(contact=False, outside=False, arrived=False):
    flags = [np.array([flag]) for flag in (contact, outside, arrived)]
    return Slot(*flags, np.array([10]))


def test_a_stop_is_paid_for_what_it_costs_on_the_next_leg():
    before = approach(3.0, 4.0)
    near, far = (
        time_reward(WORLD, before, approach(3.0, 0.0, next_excess=m), events(arrived=True), GAMMA)[
            0
        ]
        for m in (-5.0, 5.0)
    )
    assert near - far == pytest.approx(GAMMA * 10.0 / TOP)
    near, far = (
        lost_reward(WORLD, before, approach(3.0, 0.0, next_excess=m), events(arrived=True), GAMMA)[
            0
        ]
        for m in (-5.0, 5.0)
    )
    assert near - far == pytest.approx(10.0 / TOP)


# The `time` preset


def test_the_shaping_telescopes():
    rng = np.random.default_rng(1)
    distance, closing = rng.uniform(0, 500, 20), rng.uniform(-50, 50, 20)
    ways = [approach(d, v) for d, v in zip(distance, closing, strict=True)]
    for last in (events(), events(arrived=True)):
        rewards = [
            time_reward(WORLD, a, b, last if b is ways[-1] else events(), GAMMA)[0]
            for a, b in pairwise(ways)
        ]
        discount = GAMMA ** np.arange(len(rewards))
        shaping = np.sum(discount * (np.array(rewards) + SLOT))
        end = 0.0 if last.arrived[0] else potential(WORLD, ways[-1], GAMMA)[0]
        start = potential(WORLD, ways[0], GAMMA)[0]
        assert shaping == pytest.approx(GAMMA ** len(rewards) * end - start, abs=1e-10)


def test_the_potential_is_the_discounted_price_of_the_time_to_go():
    for slots in (0, 1, 25, 300):
        seconds = slots * SLOT
        distance = A * (seconds / 2) ** 2 if seconds <= 5 else 125 + (seconds - 5) * TOP
        price = -SLOT * np.sum(GAMMA ** np.arange(slots))
        assert potential(WORLD, approach(distance, 0.0), GAMMA)[0] == pytest.approx(price, abs=1e-9)


def best_flight(speeding, cruising):
    """Distance left and speed at the slots' ends of the least-time flight from rest to rest."""
    t = SLOT * np.arange(2 * speeding + cruising + 1)
    up, flat = SLOT * speeding, SLOT * cruising
    v = np.minimum(np.minimum(A * t, A * up), A * (t[-1] - t))
    flown = np.where(
        t <= up,
        A * t**2 / 2,
        np.where(t <= up + flat, A * up**2 / 2 + A * up * (t - up), np.nan),
    )
    total = A * up**2 + A * up * flat
    left = np.where(np.isnan(flown), A * (t[-1] - t) ** 2 / 2, total - flown)
    return left, v


@pytest.mark.parametrize(("speeding", "cruising"), [(2, 0), (7, 0), (12.5, 40)])
@pytest.mark.parametrize("preset", [time_reward, lost_reward])
def test_a_perfect_straight_flight_earns_nothing_and_any_waste_costs(preset, speeding, cruising):
    left, v = best_flight(speeding, cruising)
    ways = [approach(d, s) for d, s in zip(left, v, strict=True)]
    rewards = [
        preset(WORLD, a, b, events(arrived=b is ways[-1]), GAMMA)[0] for a, b in pairwise(ways)
    ]
    np.testing.assert_allclose(rewards, 0.0, atol=1e-6)
    hover = preset(WORLD, ways[0], ways[0], events(), GAMMA)[0]
    price = GAMMA ** (2 * speeding + cruising) if preset is time_reward else 1.0
    assert hover == pytest.approx(-SLOT * price, abs=1e-9)


def test_lost_adds_up_to_the_flight_s_time_over_the_least():
    left, v = best_flight(12.5, 40)
    ways = [approach(d, s) for d, s in zip(left, v, strict=True)]
    flown = [ways[0], *ways[:5], ways[4], *ways[5:]]  # waits a slot at first, and hangs one later
    lost = sum(
        lost_reward(WORLD, a, b, events(arrived=b is ways[-1]), GAMMA)[0]
        for a, b in pairwise(flown)
    )
    assert lost == pytest.approx(-2 * SLOT, abs=1e-9)


def test_no_stop_takes_less_than_braking_whatever_the_direction():
    """Beside the goal, across the way: nothing closing, and still to be brought to rest."""
    across = approach(0.0, 0.0, slack=3.0)
    across.speed = np.array([10.0])
    assert across.time_to_go(WORLD)[0] == pytest.approx(10.0 / A)


@pytest.mark.parametrize("crash", [{"contact": True}, {"outside": True}])
def test_a_crash_costs_two_whatever_the_way(crash):
    for d, v in [(0.0, 0.0), (300.0, -50.0), (1500.0, 50.0)]:
        for preset in (time_reward, lost_reward):
            assert preset(WORLD, approach(d, v), approach(d, v), events(**crash), GAMMA) == -2.0
    assert PRESETS["time"].crash_ends
    assert not PRESETS["paper"].crash_ends


# The `paper` preset: section V-A, to the letter


@pytest.mark.parametrize(
    ("returning", "flags", "bonus"),
    [
        (False, {}, 0.0),
        (False, {"arrived": True}, 100.0),  # r2
        (True, {}, 0.0),
        (True, {"arrived": True}, 100.0),  # r4
        (False, {"contact": True}, -100.0),  # r5
        (True, {"outside": True}, -200.0),  # r6
        (False, {"contact": True, "outside": True}, -300.0),
        (False, {"contact": True, "arrived": True}, 0.0),
    ],
)
def test_paper_rewards(returning, flags, bonus):
    before = approach(1.0, 0.0, [[1.0, 1.0, 1.0]], returning)
    after = approach(7.0, 0.0, [[300.0, 400.0, 1200.0]], returning)
    found = paper_reward(WORLD, before, after, events(**flags), GAMMA)
    assert found[0] == pytest.approx(-1300.0 + bonus)  # r1 or r3, and one of the others


@pytest.fixture
def paper_flights(blocked_course):
    sims = Simulations([blocked_course], 3, rules=Rules("guided", "paper", shield=False), threads=1)
    yield sims
    sims.close()


def test_under_paper_a_crash_is_charged_and_motion_goes_on(paper_flights):
    scene, sims = paper_flights.episodes.course(0).scene, paper_flights
    # Through the box in the way; out through the wall; through nothing.
    q = np.array([[185.0, 20, 30], [385.0, 30, 50], [20.0, 30, 30]])
    v = np.array([[40.0, 0, 0], [40.0, 0, 0], [40.0, 0, 0]])
    sims.place(np.arange(3), q, v)
    goal, charged = scene.items[0], np.zeros((6, 3))
    for slot in range(6):
        outcome = sims.step(np.zeros((3, 3)))
        assert not outcome.terminated.any()
        far = np.linalg.norm(sims.episodes.q - goal, axis=1)
        charged[slot] = outcome.reward + far
        np.testing.assert_allclose(sims.episodes.q, q + v * 0.2 * (slot + 1), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(sims.episodes.v, v)
    # 8 m a slot: within 0.5 m of the box from 189.5 to 210.5, out of bounds beyond 400.
    expected = [
        [-100.0, 0, 0],
        [-100.0, -200, 0],
        [-100.0, -200, 0],
        [-100.0, -200, 0],
        [0, -200, 0],
        [0, -200, 0],
    ]
    np.testing.assert_allclose(charged, expected, atol=1e-9)
    assert sims.episodes.crashed.tolist() == [True, True, False]


def test_under_time_a_crash_ends_the_episode(blocked_course):
    sims = Simulations([blocked_course], 1, threads=1)
    sims.place(np.array([0]), np.array([[185.0, 20, 30]]), np.array([[40.0, 0, 0]]))
    outcome = sims.step(np.zeros((1, 3)))
    sims.close()
    assert outcome.terminated[0]
    assert not outcome.success[0]
    assert not outcome.truncated[0]
    assert outcome.reward[0] == -2.0


def test_a_course_may_return_and_pays_r3_by_the_depot(free_scene):
    home = Course.segment(free_scene, (0, 1), 2)
    sims = Simulations([home], 1, rules=Rules("guided", "paper", shield=False), threads=1)
    sims.reset()
    first = sims.step(np.zeros((1, 3))).reward[0]
    sims.place(np.array([0]), np.array([[12.0, 30, 30]]), np.zeros((1, 3)))
    last = sims.step(np.zeros((1, 3)))
    sims.close()
    assert first == pytest.approx(-np.linalg.norm(free_scene.items[1] - free_scene.depot))
    assert last.reward[0] == pytest.approx(-2.0 + 100.0)
    assert last.success[0]
