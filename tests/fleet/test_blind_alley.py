"""A depot at the end of a corridor in which UAVs cannot pass each other."""

from __future__ import annotations

import json

import numpy as np
import pytest
from traffic import WIDTH, LawFlights, hall, wall

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import courses
from mjcollect.fleet.flight import fly_fleet
from mjcollect.fleet.share import pads
from mjcollect.guidance.landing import landings
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify_fleet
from train.fleets.report import Sharing, write_fleet
from train.support.run_folder import RunFolder

ITEMS = [[100.0, 12, 12], [170, 12, 12], [140, 8, 8]]
MOUTH = 40.0


def alley(depot: float, separation: float, items=2, more=()) -> Scene:
    """The depot is so many metres from the end, and more depots at others."""
    whole = hall(ITEMS[:items], wall(0, MOUTH, 1.5))
    place, *others = ([x, WIDTH / 2, WIDTH / 2] for x in (depot, *more))
    return Scene(
        "alley", 0, whole.bounds, place, whole.items, whole.obstacles, separation=separation,
        more_depots=np.reshape(others, (-1, 3)),
    )  # fmt: skip


SCENE = alley(6.0, 4.0)


@pytest.fixture(scope="module")
def outer() -> int:
    """Who rests nearer to the corridor's mouth."""
    return int(pads(SCENE, 2)[0][:, 0].argmax())


@pytest.fixture(scope="module")
def early(outer) -> tuple[Course, ...]:
    """Who rests nearer to the mouth has the nearer item, and would be home first."""
    return courses(SCENE, [(0,), (1,)] if outer == 0 else [(1,), (0,)])


def in_turn(flown: LawFlights, scene: Scene, places: np.ndarray) -> None:
    """All come home, the deepest first, and keep apart."""
    assert not flown.crashed
    assert flown.gap >= scene.apart - 1e-6
    assert (flown.slots > 0).all()
    assert np.argsort(places[:, 0]).tolist() == np.argsort(flown.slots).tolist()


def test_a_fleet_whose_last_one_rests_nearest_to_the_mouth_comes_home(outer):
    late = courses(SCENE, [(1,), (0,)] if outer == 0 else [(0,), (1,)])
    flown = LawFlights(late, 100)
    in_turn(flown, SCENE, pads(SCENE, 2)[0])
    # The other one is home in time, so nobody loses any.
    assert flown.slots[outer] <= LawFlights([late[outer]], 100).slots[0] + 2


def test_a_fleet_whose_first_one_rests_nearest_to_the_mouth_comes_home(early, outer):
    flown = LawFlights(early, 120)
    in_turn(flown, SCENE, pads(SCENE, 2)[0])
    assert not flown.asked
    # It stays outside until the other one is home, off its way.
    entered = np.flatnonzero(flown.path[outer, :, 0] < MOUTH)
    entered = entered[entered > flown.path.shape[1] // 4]  # after it has left
    steps = round(SCENE.slot / SCENE.physics_step)
    assert entered[0] > flown.slots[1 - outer] * steps
    assert np.abs(flown.path[outer, entered[0] // 2 : entered[0], 1:] - 12).max() > SCENE.apart


def test_three_from_two_depots_in_one_alley_come_home():
    scene = alley(6.0, 4.0, items=3, more=[22.0])
    fleet = courses(scene, [(2,), (1,), (0,)])
    flown = LawFlights(fleet, 200)
    in_turn(flown, scene, np.array([course.scene.depot for course in fleet]))


def test_a_recorded_flight_in_which_one_waits_outside_is_verified(early, outer, tmp_path):
    tours = ((0,), (1,)) if outer == 0 else ((1,), (0,))
    flown = fly_fleet(early, Simulations.law, Rules())
    assert flown.success
    assert flown.made_room[outer] > 0.1
    assert flown.made_room[1 - outer] == 0
    SCENE.save(tmp_path / "scene.json")
    sharing = Sharing(SCENE, 2, tours, early)
    write_fleet(RunFolder(tmp_path), sharing, flown, "guidance", 0, [[None] * 2] * 2, plots=False)
    assert verify_fleet(tmp_path) == []
    result = json.loads((tmp_path / "fleet.json").read_text())
    assert result["success"]
    assert result["separation"] >= 4.0 - 1e-6


def test_waiting_outside_is_saved_restored_and_not_counted(early, outer):
    """Two fleets, the second one 10 slots ahead of the first."""
    one, other = (Simulations(early * 2, 4, uavs=2, threads=1) for _ in range(2))
    for sims in (one, other):
        sims.reset()
    for _ in range(10):
        one.step(one.law())
    one.reset(np.array([0, 1]))
    traffic, slots = one.episodes.traffic, 0
    while traffic.lands_after[outer] < 0:
        one.step(one.law())
        slots += 1
    assert traffic.lands_after[outer] == 1 - outer
    assert traffic.lands_after[2 + outer] == 2 + 1 - outer
    assert traffic.gives_way.tolist() == [outer == 0, outer == 1] * 2
    assert one.episodes.steps[outer] == slots - 1
    other.load_state_dict(one.state_dict())
    while not one.episodes.home[:2].all():
        for sims in (one, other):
            sims.step(sims.law())
        slots += 1
        np.testing.assert_array_equal(one.path, other.path)
        assert slots < 150
    assert one.episodes.steps[1 - outer] == slots  # Time at home counts, as ever.
    assert one.episodes.steps[outer] < slots - 20
    for sims in (one, other):
        sims.close()


def test_a_reset_forgets_who_waits_outside(early, outer):
    sims = Simulations(early * 2, 4, uavs=2, threads=1)
    sims.reset()
    while sims.episodes.traffic.lands_after[outer] < 0:
        sims.step(sims.law())
    sims.reset(np.array([1 - outer]))
    assert (sims.episodes.traffic.lands_after[:2] == -1).all()
    assert sims.episodes.traffic.lands_after[2 + outer] == 2 + 1 - outer
    sims.close()


# Who lands after whom


def let_pass(*flights: Course) -> list[tuple[int, ...] | None]:
    found = landings([course.guidance for course in flights])
    return [None if each is None else each.last for each in found]


def test_who_rests_before_the_end_of_an_alley_lands_after_those_behind_it(early, outer):
    found = let_pass(*early)
    assert found[1 - outer] is None
    assert found[outer] == ((-1, 1) if outer == 0 else (1, -1))


def test_an_item_behind_one_that_rests_is_collected_first():
    """One rests in the corridor; the other has to collect something behind it, and to leave."""
    places = [[150.0, 6, 6], [4, 12, 12], [150, 18, 18], [20, 12, 12], [60, 12, 12]]
    scene = hall(places, wall(0, MOUTH, 1.5), separation=4.0)
    found = let_pass(Course(scene, (0, 1, 2)), Course(scene, (4, 3)))
    assert found == [None, (1, -1)]


def test_of_two_that_would_wait_for_each_other_the_first_one_does_not():
    """Both rest behind one hole, each so near to it that the other one could not come in."""
    places = [[100.0, 6, 12], [100, 18, 12], [37, 7, 12], [37, 17, 12]]
    scene = hall(places, wall(40, 50, 1.5), separation=6.0, epsilon=1.0)
    flights = Course(scene, (0, 2)), Course(scene, (1, 3))
    assert let_pass(*flights) == [None, (0, -1)]
    assert let_pass(*flights[::-1]) == [None, (0, -1)]


def test_in_the_open_nobody_waits_for_another(fleet):
    assert let_pass(*fleet) == [None] * 3
    assert let_pass(fleet[0], fleet[0]) == [None, None]  # They have no places of their own.


def test_places_lie_on_both_sides_of_a_depot_near_the_end():
    """3 m before and behind it: 6 m = 2 m that they keep apart + 2 * 2 m of tolerance."""
    scene = alley(3.0, 1.9)
    places, tolerance = pads(scene, 2)
    assert (places[:, 0] < 3.0).sum() == 1
    assert tolerance > 1.5
