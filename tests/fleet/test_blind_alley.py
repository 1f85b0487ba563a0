"""A depot at the end of a corridor in which UAVs cannot pass each other."""

from __future__ import annotations

import pytest
from traffic import WIDTH, LawFlights, hall, wall

from mjcollect.fleet.episode import courses
from mjcollect.fleet.share import pads
from mjcollect.scene.scene import Scene

ITEMS = [[100.0, 12, 12], [170, 12, 12]]


def alley(depot: float, separation: float) -> Scene:
    """The depot is so many metres from the end."""
    whole = hall(ITEMS, wall(0, 40, 1.5))
    place = [depot, WIDTH / 2, WIDTH / 2]
    return Scene(
        "alley", 0, whole.bounds, place, whole.items, whole.obstacles, separation=separation
    )


@pytest.fixture(scope="module")
def tours() -> list[tuple[tuple[int], ...]]:
    """The first: who rests nearer to the corridor's mouth has the farther item."""
    outer = int(pads(alley(6.0, 4.0), 2)[0][:, 0].argmax())
    last = ((0,), (1,)) if outer == 1 else ((1,), (0,))
    return [last, last[::-1]]


def flown(tours) -> LawFlights:
    return LawFlights(courses(alley(6.0, 4.0), tours), 300)


@pytest.mark.xfail(reason="who is home makes no room, and may shut the corridor; to be mended")
def test_a_fleet_whose_last_one_rests_nearest_to_the_mouth_comes_home(tours):
    fleet = flown(tours[0])
    assert (fleet.slots > 0).all()
    assert fleet.gap >= 4.0 - 1e-6


@pytest.mark.xfail(reason="who is home makes no room, and shuts the corridor; to be mended")
def test_a_fleet_whose_first_one_rests_nearest_to_the_mouth_comes_home(tours):
    fleet = flown(tours[1])
    assert not fleet.crashed
    assert fleet.gap >= 4.0 - 1e-6
    assert (fleet.slots > 0).all()


def test_places_lie_on_both_sides_of_a_depot_near_the_end():
    """3 m before and behind it: 6 m = 2 m that they keep apart + 2 * 2 m of tolerance."""
    scene = alley(3.0, 1.9)
    places, tolerance = pads(scene, 2)
    assert (places[:, 0] < 3.0).sum() == 1
    assert tolerance > 1.5
