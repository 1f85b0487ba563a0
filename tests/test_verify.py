import json
from dataclasses import replace

import numpy as np
import pytest
from straight_flights import ITEMS, ORDER, SLOT_ROWS, STEP, cut, edited, fly, mission, scene

from mjcollect.geometry.boxes import segment_box_distance
from mjcollect.scene.moving import MovingBox
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import Trajectory
from mjcollect.verify import Violation, verify
from mjcollect.verify.__main__ import main
from mjcollect.verify.flight import _clearance


def kinds(found: list[Violation]) -> set[str]:
    return {violation.kind for violation in found}


def test_the_unbroken_mission_is_a_success():
    flight = mission()
    assert np.linalg.norm(flight.v, axis=1).max() > 49  # it does reach the limits
    assert verify(scene(), flight, ORDER) == []


@pytest.mark.parametrize("segment", range(4))
def test_each_unbroken_segment_is_a_success(segment):
    nodes = [[0.0] * 3, *ITEMS, [0.0] * 3]
    flight = fly(nodes[segment : segment + 2])
    assert verify(scene(), flight, ORDER, segment=segment) == []
    assert kinds(verify(scene(), flight, ORDER, segment=(segment + 1) % 4)) >= {"start"}


def test_speed():
    found = verify(scene(v_max=49.0), mission(), ORDER)
    assert kinds(found) == {"speed"}
    assert all(49.0 < violation.value <= 50.0 for violation in found)
    assert [violation.segment for violation in found] == [0, 1, 2, 3]  # once a segment


def test_acceleration():
    flight = mission()
    found = verify(scene(a_max=19.9), flight, ORDER)
    assert kinds(found) == {"acceleration"}
    assert all(violation.limit == 19.9 and violation.value > 19.9 for violation in found)
    slack = np.linalg.norm(flight.a, axis=1).max() - 5e-7
    assert verify(scene(a_max=slack), flight, ORDER) == []


def test_bounds_are_inclusive_with_a_hair():
    low = Scene("t", 0, [[0] * 3, [1000, 1000, 1000]], [0] * 3, ITEMS, [])
    flight = fly([[0, 0, 0], ITEMS[0]])
    shift = np.array([0.0, 0.0, 1.0])
    for depth, expected in ((5e-7, set()), (5e-5, {"start", "bounds"})):
        dipped = replace(flight, x=flight.x - depth * shift)
        found = verify(low, dipped, ORDER, segment=0)
        assert kinds(found) == expected
    for violation in found:
        assert violation.value == pytest.approx(5e-5)
        assert violation.t == 0.0


@pytest.mark.parametrize(("gap", "touches"), [(0.6, False), (0.5, False), (0.4999, True)])
def test_contact_with_a_wall_beside_the_path(gap, touches):
    wall = [[100.0, gap, 0], [200, 10, 10]]
    found = verify(scene(obstacles=[wall]), mission(), ORDER)
    assert kinds(found) == ({"contact"} if touches else set())
    if touches:
        assert len(found) == 1
        assert found[0].value == pytest.approx(gap)
        assert (found[0].segment, found[0].limit) == (0, 0.5)


def test_contact_between_rows_is_found():
    flight = fly([[0, 0, 0], ITEMS[0]])
    row = int(np.argmax(flight.v[:, 0]))
    ahead = (flight.x[row, 0] + flight.x[row + 1, 0]) / 2
    # A needle that the body sweeps over, 0.3 m from both rows' spheres at a metre per row.
    needle = [[ahead - 1e-4, 0.3, 0], [ahead + 1e-4, 0.31, 10]]
    radius = 0.35
    at_rows = np.linalg.norm(flight.x - np.clip(flight.x, needle[0], needle[1]), axis=1).min()
    assert at_rows > radius
    found = verify(scene(obstacles=[needle], uav_radius=radius), flight, ORDER, segment=0)
    assert kinds(found) == {"contact"}
    assert found[0].t == pytest.approx(row * STEP)
    assert found[0].value == pytest.approx(0.3, abs=1e-3)


def test_contact_counts_each_touch_once():
    walls = [[[x, 0.4, 0], [x + 20.0, 10, 10]] for x in (50.0, 120.0, 220.0)]
    found = verify(scene(obstacles=walls), mission(), ORDER)
    assert [violation.kind for violation in found] == ["contact"] * 3


@pytest.mark.parametrize("part", ["x", "v"])
@pytest.mark.parametrize("row", [1, 50, -2])
def test_state_that_does_not_follow_from_the_last(part, row):
    flight = mission()
    value = getattr(flight, part)[row] + [0, 0, 1e-5]
    found = verify(scene(), edited(flight, part, row, value), ORDER)
    assert kinds(found) == {"timestep"}
    assert len(found) == 1
    assert found[0].t == pytest.approx(flight.t[row] if row > 0 else flight.t[-2], abs=0.03)


def test_wrong_acceleration_row():
    flight = mission()
    assert kinds(verify(scene(), edited(flight, "a", 30, [0, 0, 0]), ORDER)) == {"timestep"}


@pytest.mark.parametrize(
    "stretch",
    [
        lambda t: t * 1.01,
        lambda t: t + 0.02,
        lambda t: np.where(t > 3, t + 0.02, t),
        lambda t: t + 1e-5 * (t == t[7]),
    ],
)
def test_clock(stretch):
    flight = mission()
    found = verify(scene(), replace(flight, t=stretch(flight.t)), ORDER)
    assert kinds(found) == {"timestep"}
    assert len(found) == 1


def test_missing_row():
    flight = mission()
    parts = {part: np.delete(getattr(flight, part), 40, axis=0) for part in "txva"}
    assert kinds(verify(scene(), Trajectory(**parts), ORDER)) == {"timestep"}


@pytest.mark.parametrize("part", ["t", "x", "v", "a"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite(part, value):
    found = verify(scene(), edited(mission(), part, 25, value), ORDER)
    assert found == [Violation("timestep", pytest.approx(0.5), 0, None, 1e-6)]
    json.dumps(found[0].to_dict(), allow_nan=False)


def test_start_beside_the_depot():
    flight = fly([[0.01, 0, 0], *ITEMS, [0, 0, 0]])
    found = verify(scene(), flight, ORDER)
    assert kinds(found) == {"start"}
    assert found[0].value == pytest.approx(0.01)


def test_start_in_motion():
    flight = mission()
    moving = cut(flight, 5, len(flight))
    found = verify(scene(), moving, ORDER)
    assert kinds(found) == {"start"}
    values = [violation.value for violation in found]
    np.testing.assert_allclose(values, [np.linalg.norm(flight.x[5]), np.linalg.norm(flight.v[5])])


def test_flying_through_an_item_is_no_stop():
    through = fly([[0, 0, 0], ITEMS[0], [300, 800, 0], ITEMS[2], [0, 0, 0]])
    found = verify(scene(), through, ORDER)
    assert kinds(found) == {"stop"}
    assert (len(found), found[0].segment) == (1, 1)
    assert found[0].value > 1.0  # m/s, the slowest within the ball
    assert np.linalg.norm(through.x[round(found[0].t / STEP)] - ITEMS[1]) <= 5.0


def test_nearly_at_rest_is_not_at_rest():
    flight = mission()
    row = np.flatnonzero((flight.v == 0).all(axis=1))[1]
    # One row moves by a micron too much: the state stays within tolerance of its recursion.
    found = verify(scene(), edited(flight, "v", row, [9e-7, 0, 0]), ORDER)
    assert found == []
    found = verify(scene(), edited(flight, "v", row, [1.1e-6, 0, 0]), ORDER)
    assert kinds(found) >= {"stop"}


@pytest.mark.parametrize(("short", "expected"), [(4.99, set()), (5.01, {"stop"})])
def test_stop_within_epsilon(short, expected):
    flight = fly([[0, 0, 0], [300 - short, 0, 0], *ITEMS[1:], [0, 0, 0]])
    found = verify(scene(), flight, ORDER)
    assert kinds(found) == expected
    if expected:
        assert (found[0].value, found[0].limit) == (pytest.approx(5.01, abs=1e-3), 5.0)
    flight = fly([[0, 0, 0], [300 - short, 0, 0]])
    assert kinds(verify(scene(), flight, ORDER, segment=0)) == expected


def test_items_out_of_order():
    found = verify(scene(), mission((1, 0, 2)), ORDER)
    assert [(violation.kind, violation.value, violation.limit) for violation in found] == [
        ("order", 1, 0)
    ]
    assert verify(scene(), mission((1, 0, 2)), (1, 0, 2)) == []


def test_an_item_left_out():
    found = verify(scene(), mission((0, 2)), ORDER)
    assert [(violation.kind, violation.segment) for violation in found] == [("stop", 1)]


def test_an_extra_stop_at_a_later_item_breaks_nothing():
    assert verify(scene(), mission((1, 0, 1, 2)), ORDER) == []


@pytest.mark.parametrize(("short", "expected"), [(4.99, set()), (5.01, {"return"})])
def test_return_within_its_tolerance(short, expected):
    towards = np.array(ITEMS[2]) / 500.0
    flight = fly([[0, 0, 0], *ITEMS, short * towards])
    assert kinds(verify(scene(), flight, ORDER)) == expected
    assert verify(scene(return_tolerance=6.0, epsilon=1.0), flight, ORDER) == []


def test_passing_the_depot_without_stopping():
    flight = fly([[0, 0, 0], *ITEMS, [0, 0, 0]])
    found = verify(scene(), cut(flight, 0, len(flight) - 3), ORDER)
    assert kinds(found) == {"return"}
    assert found[0].limit == 1e-6


def test_last_row_must_not_push():
    flight = mission()
    found = verify(scene(), edited(flight, "a", -1, [0, 0, 1.0]), ORDER)
    assert [(violation.kind, violation.value) for violation in found] == [("return", 1.0)]
    single = edited(fly([[0, 0, 0], ITEMS[0]]), "a", -1, [0, 0, 1.0])
    assert kinds(verify(scene(), single, ORDER, segment=0)) == {"stop"}


def test_flight_cut_off_reports_what_is_left():
    flight = mission()
    found = verify(scene(), cut(flight, 0, 300), ORDER)
    assert sorted(v.segment for v in found if v.kind == "stop") == [0, 1, 2]
    assert {v.segment for v in found if v.kind == "return"} == {3}
    assert kinds(found) == {"stop", "return"}


def hover(rows: int, at) -> Trajectory:
    x = np.tile(np.asarray(at, float), (rows, 1))
    return Trajectory(np.arange(rows) * STEP, x, np.zeros_like(x), np.zeros_like(x))


def test_a_segment_takes_a_slot_even_inside_its_ball():
    near = Scene("t", 0, [[0] * 3, [100] * 3], [0] * 3, [[3.0, 0, 0], [0, 3.0, 0]], [])
    assert verify(near, hover(3 * SLOT_ROWS + 1, [0, 0, 0]), (0, 1)) == []
    assert kinds(verify(near, hover(3 * SLOT_ROWS, [0, 0, 0]), (0, 1))) == {"return"}
    assert kinds(verify(near, hover(SLOT_ROWS, [0, 0, 0]), (0, 1), segment=0)) == {"stop"}
    assert verify(near, hover(SLOT_ROWS + 1, [0, 0, 0]), (0, 1), segment=0) == []


def test_one_row_inside_a_box_is_contact():
    found = verify(scene(obstacles=[[[100.0] * 3, [200] * 3]]), hover(1, [150] * 3), ORDER)
    assert {"contact", "start", "stop", "return"} <= kinds(found)


def test_every_violation_is_json():
    text = json.dumps([v.to_dict() for v in verify(scene(v_max=30.0), mission((1, 0, 2)), ORDER)])
    assert set(json.loads(text)[0]) == {"kind", "t", "segment", "value", "limit"}


@pytest.mark.parametrize("order", [(0, 1), (0, 1, 1), (0, 1, 3)])
def test_bad_order_is_refused(order):
    with pytest.raises(ValueError, match="order"):
        verify(scene(), mission(), order)


@pytest.mark.parametrize("segment", [-1, 4])
def test_bad_segment_is_refused(segment):
    with pytest.raises(ValueError, match="segment"):
        verify(scene(), mission(), ORDER, segment=segment)


def test_clearance_equals_the_exact_distance():
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 900, (60, 3))
    boxes = np.stack([low, low + rng.uniform(1, 100, (60, 3))], axis=1)
    x = 500 + np.cumsum(rng.normal(scale=6.0, size=(3000, 3)), axis=0)
    radius = 20.0
    found = _clearance(x, boxes, radius)
    ends = np.concatenate([x[1:], x[-1:]])
    exact = segment_box_distance(x[:, None], ends[:, None], boxes).min(axis=1)
    assert (exact < radius).sum() > 100
    assert np.allclose(found[exact < radius], exact[exact < radius], atol=1e-9)
    assert np.all(found[exact >= radius] >= radius)


# Disturbed air and moving boxes


def test_disturbed_flights_may_creep_at_stops_push_harder_and_leave_the_bounds_a_little():
    flight = mission()
    row = len(flight) - 1
    assert kinds(verify(scene(a_max=19.0, v_max=45.0), flight, ORDER)) == {"speed", "acceleration"}
    assert verify(scene(a_max=19.0, v_max=45.0), flight, ORDER, disturbed=True) == []
    creeping = edited(flight, "v", row, [1.9, 0, 0])
    assert kinds(verify(scene(), creeping, ORDER, disturbed=True)) == {"timestep"}
    hurrying = edited(flight, "v", row, [2.1, 0, 0])
    assert kinds(verify(scene(), hurrying, ORDER, disturbed=True)) == {"timestep", "return"}
    low = fly([[0, 0, 0], *(ITEMS[item] for item in ORDER), [0, 0, 0]])
    for shift, found in ((4.9, {"start"}), (5.1, {"start", "bounds", "return"})):
        shifted = replace(low, x=low.x - [0, 0, shift])
        assert kinds(verify(scene(epsilon=5.2), shifted, ORDER, disturbed=True)) == found


def mover(gap: float, sideways: float = 0.0) -> MovingBox:
    """Comes towards the first segment's middle from above, down to `gap` m over the body's way."""
    down = 200 + gap  # 2 m high: its lower side is `gap` above the line at the end of its path
    path = ((150.0, sideways, 201.0 + down), (150.0, sideways, 1.0 + gap))
    flight = mission()
    passing = float(flight.t[np.argmin(np.abs(flight.x[:2000, 0] - 150.0))])
    return MovingBox((2.0, 2.0, 2.0), path, (200 + down - gap) / passing)


def test_a_moving_box_is_missed_or_touched_by_a_hair():
    assert verify(scene(obstacles=[]), mission(), ORDER, moving=[mover(0.6)]) == []
    (hit,) = verify(scene(obstacles=[]), mission(), ORDER, moving=[mover(0.3)])
    assert (hit.kind, hit.segment, hit.limit) == ("contact", 0, 0.5)
    assert hit.value < 0.5
    assert verify(scene(obstacles=[]), mission(), ORDER, moving=[mover(0.3, sideways=2.0)]) == []


def test_a_fast_thin_box_that_is_nowhere_near_at_any_row_is_found():
    """It crosses the way between two rows: only the relative sweep sees it."""
    flight = mission()
    row = int(np.argmin(np.abs(flight.x[:2000, 0] - 150.0)))
    when, speed = flight.t[row] + STEP / 2, 5000.0
    where = (flight.x[row] + flight.x[row + 1]) / 2
    path = tuple((where[0], where[1] + y, where[2]) for y in (-speed * when, speed * when))
    box = MovingBox((4.0, 0.1, 4.0), path, speed)
    gaps = np.abs(flight.x[:, 1] - box.centres(flight.t)[:, 1])[row - 5 : row + 6]
    assert gaps.min() > 40
    assert "contact" in kinds(verify(scene(obstacles=[]), flight, ORDER, moving=[box]))


def test_the_boxes_of_the_scene_count_unless_others_are_named():
    with_box = scene(obstacles=[], moving=[mover(0.3)])
    assert kinds(verify(with_box, mission(), ORDER)) == {"contact"}
    assert verify(with_box, mission(), ORDER, moving=[]) == []


def test_the_command_judges_a_run_folder(tmp_path, capsys):
    scene().save(tmp_path / "scene.json")
    (tmp_path / "mission.json").write_text(json.dumps({"order": list(ORDER)}))
    mission().save(tmp_path / "trajectory.csv")
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == "no rule is broken\n"
    mission((0, 2, 1)).save(tmp_path / "trajectory.csv")
    assert main([str(tmp_path)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("order: 2 at ")
    count = len(said) - 1
    assert said[-1] == f"{count} rule{'s' if count > 1 else ''} broken"
    assert main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere: cannot be judged" in capsys.readouterr().err
