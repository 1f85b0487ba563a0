"""Small scenes once refused or flown badly: flown, or refused for what is true of them."""

from pathlib import Path

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.envs.recording import fly_law, record
from mjcollect.guidance.aim import place, room_to_boxes
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.planners.mpc import Mpc
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify

CASES = Path(__file__).parent / "cases"


def planned(name):
    scene = Scene.load(CASES / f"{name}.json")
    order = plan_order(scene, "lkh", seed=0)
    return scene, order, Course.mission(scene, order)


@pytest.mark.parametrize(
    "name",
    [
        "depot_2m_from_a_wall", "lab_room", "city_suzhou200", "city_suzhou400",
        "item_30cm_from_a_wall", "item_10cm_above_a_roof", "slot_of_5_s", "epsilon_1mm",
    ],
)  # fmt: skip
def test_the_law_flies_it(name):
    scene, order, course = planned(name)
    flight = fly_law(course)
    assert flight.success
    assert verify(scene, flight.trajectory, order) == []


@pytest.mark.parametrize("name", ["slot_of_5_s", "epsilon_1mm", "item_10cm_above_a_roof"])
def test_the_mpc_flies_it(name):
    scene, order, course = planned(name)
    planner = Mpc(course)
    flight = record(course, lambda _, task: planner.action(task.episodes))
    assert verify(scene, flight.trajectory, order) == []


def test_slots_of_5_s_are_not_wasted():
    """95 s for the first segment once; a stop alone takes a slot, and so does every turn."""
    _, order, course = planned("slot_of_5_s")
    planner = Mpc(course)
    flight = record(course, lambda _, task: planner.action(task.episodes))
    assert order == (0, 1)
    assert flight.arrivals[0] <= 30.0


def test_what_is_walled_in_is_refused_by_name():
    """The slit is as wide as the body, to the last digit."""
    with pytest.raises(GuidanceError, match=r"to items\[0\].*walled in"):
        planned("item_in_a_cage_with_a_1m_slit")


def test_slots_too_long_to_steer_in_are_refused():
    """One slot of full acceleration leads out of this cube from anywhere."""
    with pytest.raises(GuidanceError, match=r"^slot: 0.2 s: too long to steer in"):
        planned("city_in_a_21_cm_cube")


def test_a_leg_begins_where_a_body_can_be():
    scene, _, course = planned("item_30cm_from_a_wall")
    assert room_to_boxes(scene, scene.items[:1])[0] < 0.0
    at = place(scene, 0)
    assert room_to_boxes(scene, at[None])[0] >= 0.0
    assert np.linalg.norm(at - scene.items[0]) <= scene.epsilon
    np.testing.assert_array_equal(place(scene, 1), scene.items[1])  # there is room
    leg = next(guide for guide in course.guidance if np.array_equal(guide.start, at))
    assert leg is not course.guidance[0]
    q, v = Course.segment(scene, (0, 1), 1).starts("ball", 50, np.random.default_rng(0))
    assert room_to_boxes(scene, q).min() >= 0.0
    assert np.linalg.norm(q - scene.items[0], axis=1).max() <= scene.epsilon
    assert not v.any()
