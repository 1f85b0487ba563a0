"""Flights of a course in disturbed air, many at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import (
    ENDS,
    CourseAir,
    DisturbedFlight,
    DisturbedFlights,
    by_policies,
    fly_batch,
    fly_disturbed,
)
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import Flight, fly_law
from mjcollect.flight.contact import MARGIN
from mjcollect.flight.disturbance import REST_SPEED, Disturbance
from mjcollect.scene.air import Air
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import DISTURBED_MARGIN, DISTURBED_REST, verify

WINDY = Disturbance(wind=3.0, gusts=1.0, gain=0.1, delay=0.04, noise=0.2)
MOVER = {"size": [10, 10, 10], "path": [[95, 10, 15], [95, 40, 15]], "speed": 5.0}


def law(course: Course, level: Disturbance, flights: int = 4, seed: int = 0) -> DisturbedFlights:
    return fly_batch(course, Simulations.law, Rules(), level, flights, seed, bar=False)


@pytest.fixture(scope="module")
def course(scene_file) -> Course:
    return Course.mission(Scene.load(scene_file), (0, 1))


@pytest.fixture(scope="module")
def flown(course: Course) -> DisturbedFlights:
    return law(course, WINDY)


def test_flights_are_recorded_as_they_were_flown_and_judged_so(course, flown) -> None:
    assert sum(flown.ended.values()) == 4
    assert flown.ended["home"] >= 3
    for each in flown.flights:
        flight, air = each.flight, each.air
        found = verify(course.scene, flight.trajectory, (0, 1), disturbed=True)
        assert (found == []) == (each.ended == "home")
        assert np.hypot(*air.wind[:2]) == pytest.approx(3.0)
        assert len(air.push) == len(flight.shielded)
        assert air.delay == pytest.approx(0.04)
    kinds = {
        v.kind for v in verify(course.scene, flown.flights[flown.shown].flight.trajectory, (0, 1))
    }
    assert kinds  # by the rules of calm air it is none


def test_the_same_seed_gives_the_same_flights_and_another_one_others(course, flown) -> None:
    again, other = law(course, WINDY), law(course, WINDY, seed=1)
    for one, two in zip(flown.flights, again.flights, strict=True):
        np.testing.assert_array_equal(one.flight.trajectory.x, two.flight.trajectory.x)
        np.testing.assert_array_equal(one.air.push, two.air.push)
    assert not np.array_equal(other.flights[0].air.wind, flown.flights[0].air.wind)


def test_calm_flights_of_a_batch_are_the_calm_flight(course) -> None:
    single, many = fly_law(course), law(course, Disturbance(), 2)
    for each in many.flights:
        assert each.air is None
        np.testing.assert_allclose(each.flight.trajectory.x, single.trajectory.x, atol=1e-9)
        np.testing.assert_allclose(each.flight.trajectory.a, single.trajectory.a, atol=1e-9)
        assert each.flight.arrivals == pytest.approx(single.arrivals)


def test_a_policy_for_each_segment_flies_its_own(course) -> None:
    asked: list[tuple[int, int]] = []

    class Still:
        observation = "guided"

        def __init__(self, segment: int) -> None:
            self.segment = segment

        def __call__(self, seen: np.ndarray) -> np.ndarray:
            asked.append((self.segment, len(seen)))
            return np.full((len(seen), 3), self.segment)

    sims = Simulations([course], 3, threads=1)
    sims.reset()
    sims.episodes.target[:] = [1, 0, 1]
    actions = by_policies([Still(0), Still(1), Still(2)])(sims)
    sims.close()
    assert asked == [(0, 1), (1, 2)]
    assert actions[:, 0].tolist() == [1, 0, 1]


def test_boxes_of_the_scene_move_in_every_flight_and_are_known(course) -> None:
    scene = replace(course.scene, moving=[MOVER])
    flown = law(Course.mission(scene, (0, 1)), Disturbance(), 2)
    for each in flown.flights:
        assert each.air.moving == scene.moving
        found = verify(scene, each.flight.trajectory, (0, 1), disturbed=True)
        assert (found == []) == (each.ended == "home")


def test_boxes_move_across_any_long_segment(corridor) -> None:
    level = Disturbance(mover=10.0, boxes=2)
    flown = law(Course.mission(corridor, (0, 1)), level, 6)
    middles = [np.mean(box.path, axis=0)[0] for f in flown.flights for box in f.air.moving]
    assert len(middles) == 12
    assert min(middles) > 80
    ends = {each.ended for each in flown.flights}
    assert ends <= set(ENDS)
    for each in flown.flights:
        found = verify(
            corridor, each.flight.trajectory, (0, 1), disturbed=True, moving=each.air.moving
        )
        assert ("contact" in {v.kind for v in found}) == (each.ended in ENDS[1:3])


def test_no_box_begins_where_the_flight_does(corridor) -> None:
    """The depot lies beside the middle of long segments, where boxes move to and fro."""
    items = [[20.0, 30.0, 30.0], [390.0, 30.0, 30.0], [12.0, 32.0, 30.0]]
    near = replace(corridor, depot=[200.0, 50.0, 57.0], items=items, obstacles=[])
    course = Course.mission(near, (0, 1, 2))
    level, n = Disturbance(mover=5.0, boxes=3), 200
    air = CourseAir(course, level, n, np.random.default_rng(0))
    start = np.tile(near.depot, (n, 1))
    air.begin(np.arange(n), start, start)
    off = np.abs(start[:, None] - air.movers.centres()) - air.movers.half
    assert np.linalg.norm(np.maximum(off, 0.0), axis=2).min() >= 20.0


def test_too_short_segments_for_a_moving_box_are_refused(course) -> None:
    class Law:
        observation = "guided"

    with pytest.raises(ValueError, match="mover: 5: no segment is 200 m long"):
        fly_disturbed(course, Law(), Disturbance(mover=5.0), 2)  # type: ignore[arg-type]


def test_judge_and_flight_agree_on_what_is_allowed() -> None:
    assert REST_SPEED == DISTURBED_REST
    assert MARGIN == DISTURBED_MARGIN


def test_intervals_are_those_of_wilson_and_student() -> None:
    def one(seconds: float, ended: str) -> DisturbedFlight:
        rows = np.zeros((2, 3))
        trajectory = Trajectory(np.array([0.0, seconds]), rows, rows, rows)
        return DisturbedFlight(Flight(trajectory, ended == "home", 0, (), (), 0.2), ended, None)

    ends = ["moving box", "home", "home", "too late", "home"]
    flown = DisturbedFlights(tuple(map(one, [3.0, 10.0, 11.0, 60.0, 15.0], ends)))
    assert flown.ended == dict(zip(ENDS, (3, 0, 1, 0, 1), strict=True))
    assert flown.shown == 1
    z, n, p = 1.959964, 5, 0.6
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    reach = z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert flown.success_rate == pytest.approx((p, middle - reach, middle + reach), abs=1e-6)
    assert flown.contact_rate.value == pytest.approx(0.2)
    low, high = stats.t.interval(0.95, 2, 12.0, stats.sem([10.0, 11.0, 15.0]))
    assert flown.mean_time == pytest.approx((12.0, low, high))
    assert DisturbedFlights(flown.flights[:1]).mean_time == (None, None, None)
    assert DisturbedFlights(flown.flights[1:2]).mean_time == (10.0, None, None)
    shares = (0.0, 0.0, 0.4)
    gave = tuple(replace(one(1.0, "home"), gave_way=share) for share in shares)
    high = stats.t.interval(0.95, 2, np.mean(shares), stats.sem(shares))[1]
    assert DisturbedFlights(gave).gave_way == pytest.approx((0.4 / 3, 0.0, high))


def test_flights_say_how_often_the_shield_gave_way(corridor, monkeypatch) -> None:
    rooms = []
    step = Simulations.step

    def watched(sims, action):
        outcome = step(sims, action)
        rooms.append(outcome.room.copy())
        return outcome

    monkeypatch.setattr(Simulations, "step", watched)
    level = Disturbance(wind=6.0, gusts=3.0, gain=0.3, delay=0.1, mover=10.0, boxes=3)
    flown = law(Course.mission(corridor, (0, 1)), level, 6)
    gave = np.array(rooms) < 1.0
    for index, each in enumerate(flown.flights):
        slots = len(each.flight.shielded)
        assert each.gave_way == pytest.approx(gave[:slots, index].mean())
    assert flown.gave_way.value > 0.0


def test_air_comes_back_from_its_file_to_the_digit(flown, tmp_path) -> None:
    air = flown.flights[0].air
    air.save(tmp_path / "air.json")
    back = Air.load(tmp_path / "air.json")
    np.testing.assert_array_equal(back.push, air.push)
    np.testing.assert_array_equal(back.wind, air.wind)
    assert (back.gain, back.delay, back.moving) == (air.gain, air.delay, air.moving)
    np.testing.assert_allclose(back.pushes(np.array([0.2])), air.push[:1])
