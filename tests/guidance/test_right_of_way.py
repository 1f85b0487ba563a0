"""Who stands in another's way makes room: fleets come home, through whatever is wide enough."""

from __future__ import annotations

import numpy as np
import pytest
from crowds import RADIUS, crowded, dense, gaps
from traffic import LawFlights, hall, street, wall

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.flight.world import World
from mjcollect.guidance.right_of_way import LONGEST, PATIENCE
from mjcollect.guidance.room import (
    CELLS,
    ROOM,
    SPACINGS,
    gap_to_path,
    straightened,
    way_to_room,
)
from mjcollect.scene.scene import Scene

LEFT, RIGHT = [15.0, 12.0, 12.0], [165.0, 12.0, 12.0]
NARROW, WIDE = 1.5, 3.0  # half a hole; bodies keep 4 m apart in a narrow one, else 2 m
DEAD_END = [[[119.5, 8.0, 8.0], [120.5, 16.0, 16.0]]]
GRID = [(y, z) for y in (4.0, 12.0, 20.0) for z in (4.0, 12.0, 20.0)][:8]


def both_ways(scene, pairs=((0, 1), (1, 0))) -> list[Course]:
    return [Course(scene, pair) for pair in pairs]


@pytest.fixture(scope="module")
def narrow() -> list[Course]:
    """Two that want through a narrow corridor at once, from its two ends."""
    return both_ways(hall([LEFT, RIGHT], wall(60, 120, NARROW), separation=4.0))


@pytest.fixture(scope="module")
def gap8() -> dict[tuple[int, int], Course]:
    """Eight ways through one gap to the right, four back."""
    left, right = ([[x, y, z] for y, z in GRID] for x in (20.0, 220.0))
    scene = hall(left + right, wall(115, 125, 2.0), 240.0, separation=6.0)
    ways = [(i, i + 8) for i in range(8)] + [(i + 8, i) for i in range(1, 8, 2)]
    return {way: Course(scene, way) for way in ways}


def check(flown: LawFlights, scene: Scene):
    """All are home, nobody met anybody, nothing was touched."""
    assert (flown.slots > 0).all(), flown.slots
    assert not flown.crashed
    assert flown.gap >= scene.apart - 1e-6
    boxes = scene.obstacles
    assert min(gaps(dense(track, spacing=0.2), boxes).min() for track in flown.path) >= RADIUS
    assert np.maximum(scene.bounds[0] - flown.path, flown.path - scene.bounds[1]).max() <= 1e-6


def alone(course: Course) -> int:
    return int(LawFlights([course], 100).slots[0])


# Fleets come home


def test_head_on_in_the_open_the_first_one_does_not_notice():
    courses = both_ways(hall([LEFT, RIGHT], []))
    flown = LawFlights(courses, 60)
    check(flown, courses[0].scene)
    assert flown.gap < 5  # They do meet.
    assert flown.slots[0] <= alone(courses[0]) + 1
    assert flown.slots[1] <= flown.slots[0] + 5
    assert not flown.asked


def test_three_that_cross_at_one_point():
    middle = np.array([90.0, 12, 12])
    places = [middle + sign * arm for arm in np.diag([40.0, 11, 11]) for sign in (-1, 1)]
    courses = both_ways(hall(places, []), [(0, 1), (2, 3), (5, 4)])
    starts = [middle - [10, 0, 0], places[2], places[5]]  # so that they come there together
    flown = LawFlights(courses, 60, starts)
    check(flown, courses[0].scene)
    assert flown.gap < 4
    assert flown.slots[0] <= LawFlights(courses[:1], 60, starts[:1]).slots[0] + 1
    assert flown.slots.max() <= flown.slots[0] + 10


def test_head_on_in_a_wide_corridor_they_pass():
    courses = both_ways(hall([LEFT, RIGHT], wall(60, 120, WIDE)))
    flown = LawFlights(courses, 60)
    check(flown, courses[0].scene)
    assert flown.slots.min() <= alone(courses[0]) + 2
    assert not flown.asked


def test_in_a_narrow_corridor_the_second_one_backs_out(narrow):
    flown = LawFlights(narrow, 200)
    check(flown, narrow[0].scene)
    assert flown.asked == {(1, 0)}
    assert flown.slots[0] < flown.slots[1]
    # It backs out, waits beside the mouth, and flies through once more.
    inside = (flown.path[:, :, 0] > 60) & (flown.path[:, :, 0] < 120)
    first, second = (np.flatnonzero(np.diff(row.astype(int))) for row in inside)
    assert (len(first), len(second)) == (2, 4)


def test_from_a_dead_end_one_is_let_out_before_another_goes_in():
    """The first one wants in, and could not get out of the second one's way once there."""
    scene = hall([LEFT, [118.0, 12, 12]], [*wall(60, 120, NARROW), *DEAD_END], separation=4.0)
    courses = both_ways(scene)
    flown = LawFlights(courses, 200)
    check(flown, scene)
    assert flown.asked == {(0, 1)}
    assert flown.slots[1] < flown.slots[0]


def test_eight_fly_through_one_gap(gap8):
    courses = [gap8[i, i + 8] for i in range(8)]
    flown = LawFlights(courses, 120)
    check(flown, courses[0].scene)
    assert len(set(flown.slots.tolist())) > 4  # They come one after the other.


def test_eight_fly_through_one_gap_from_both_sides(gap8):
    ways = [(i, i + 8) if i % 2 == 0 else (i + 8, i) for i in range(8)]
    courses = [gap8[way] for way in ways]
    flown = LawFlights(courses, 250)
    check(flown, courses[0].scene)
    assert len(flown.asked) > 1


@pytest.mark.parametrize(("seed", "uavs", "separation"), [(24, 2, 0.0), (104, 3, 6.0)])
def test_crowded_streets_are_flown_both_ways(seed, uavs, separation):
    scene, pairs = street(seed, uavs, separation=separation)
    assert len(scene.obstacles) >= 10
    courses = both_ways(scene, pairs)
    flown = LawFlights(courses, 150)
    check(flown, scene)
    if separation:
        assert flown.gap < scene.apart + 2  # They have to do with each other.


# What making room is


def test_a_batch_in_which_one_makes_room_is_saved_and_restored(narrow):
    one, other = (Simulations(narrow * 2, 4, uavs=2, threads=1) for _ in range(2))
    for sims in (one, other):
        sims.reset()
    one.place(np.array([2]), np.array([[1.0, 12, 12]]), np.zeros((1, 3)))
    while one.episodes.traffic.asked_by[1] < 0:
        one.step(one.law())
    assert one.episodes.traffic.asked_by.tolist() == [-1, 0, -1, -1]
    other.load_state_dict(one.state_dict())
    kept = other.state_dict()
    asked = []
    for _ in range(60):
        ours, theirs = (sims.step(sims.law()) for sims in (one, other))
        np.testing.assert_array_equal(one.path, other.path)
        np.testing.assert_array_equal(ours.shielded, theirs.shielded)
        np.testing.assert_array_equal(one.episodes.makes_room, other.episodes.makes_room)
        asked.append(one.episodes.traffic.asked_by.tolist())
    assert asked[0][1] == 0  # It went on making room,
    assert asked[-1][1] == -1  # until the other had passed.
    assert {entry[3] for entry in asked} == {-1, 2}  # And it began to in the other fleet.
    last = other.path.copy()
    other.load_state_dict(kept)  # What was saved did not change meanwhile.
    for _ in range(60):
        other.step(other.law())
    np.testing.assert_array_equal(other.path, last)
    for sims in (one, other):
        sims.close()


def test_a_reset_forgets_who_makes_room(narrow):
    sims = Simulations(narrow * 2, 4, uavs=2, threads=1)
    sims.reset()
    traffic = sims.episodes.traffic
    while (traffic.asked_by < 0).any() and sims.episodes.steps[0] < 60:
        sims.step(sims.law())
        if traffic.asked_by[1] == 0:
            break
    assert traffic.asked_by.tolist() == [-1, 0, -1, 2]
    sims.reset(np.array([2, 3]))
    assert traffic.asked_by.tolist() == [-1, 0, -1, -1]
    sims.reset(np.array([0]))  # Nobody is left for whom to make room.
    assert traffic.asked_by.tolist() == [-1, -1, -1, -1]
    fresh = Simulations(narrow, 2, uavs=2, threads=1)
    fresh.reset()
    sims.reset(np.array([1]))
    for _ in range(40):
        sims.step(sims.law())
        fresh.step(fresh.law())
        np.testing.assert_array_equal(sims.path[:2], fresh.path)
    for each in (sims, fresh):
        each.close()


def test_nobody_waits_for_ever(narrow):
    """The one that the other makes room for stands still where it is."""
    sims = Simulations(narrow, 2, uavs=2, threads=1)
    sims.reset()
    while sims.episodes.traffic.asked_by[1] < 0:
        sims.step(sims.law())
    slots = 0
    while sims.episodes.traffic.asked_by[1] == 0:
        action = sims.law()
        action[0] = -sims.episodes.v[0]
        sims.step(action)
        slots += 1
        assert slots < 400
    assert slots * narrow[0].scene.slot == pytest.approx(PATIENCE, abs=1.0)
    sims.close()


# Where to go


def searched(world, start, path, others, spacing, longest=LONGEST) -> np.ndarray:
    """The way (P, 3) to room."""
    came, queue = (np.empty(CELLS**3, dtype=np.int32) for _ in range(2))
    route = np.full((longest, 3), np.nan)
    count = way_to_room(
        world, 0, start, path, len(path), others, spacing * world.apart[0, 0], came, queue, route
    )
    return route[:count]


def nearest(point, path) -> float:
    """Distance of a point from a polyline, sampled."""
    return float(np.linalg.norm(dense(path, spacing=0.01) - point, axis=1).min())


@pytest.mark.parametrize("separation", [2.0, 6.0])
def test_room_lies_off_the_path_and_a_free_way_leads_there(separation):
    found = asked = 0
    for seed in range(12):
        rng, scene = np.random.default_rng(seed), crowded(seed, 30, separation=separation)
        world, room = World.stack([scene]), ROOM * scene.apart
        path = rng.uniform([20, 5, 5], [380, 55, 55], (6, 3))
        path = path[np.argsort(path[:, 0])]
        near = dense(path, spacing=1.0)
        near = near[gaps(near, scene.obstacles) > RADIUS + 0.01]
        start = near[rng.integers(len(near))]
        others = start + rng.normal(size=(3, 3)) * 2 * scene.apart
        others = others[np.linalg.norm(others - start, axis=1) > scene.apart]
        for spacing in SPACINGS:
            asked += 1
            route = searched(world, start, path, others, spacing)
            if not len(route):
                continue
            found += 1
            end = route[-1]
            assert nearest(end, path) >= room - 1e-6
            assert abs(gap_to_path(end, path, len(path)) - nearest(end, path)) < 1e-3
            assert (np.linalg.norm(others - end, axis=1) >= room - 1e-9).all()
            whole = np.concatenate([start[None], route])
            steps = np.abs(np.diff(whole, axis=0))
            np.testing.assert_allclose(steps.sum(axis=1), spacing * scene.apart, atol=1e-9)
            assert gaps(dense(whole, spacing=0.02), scene.obstacles).min() >= RADIUS
            assert (np.maximum(scene.bounds[0] - route, route - scene.bounds[1]) <= 0).all()
            away = np.linalg.norm(whole[:, None] - others, axis=2)
            assert ((away[1:] >= scene.apart - 1e-9) | (away[1:] >= away[:-1])).all()
            count = straightened(scene.tree, RADIUS, start, short := route.copy(), len(route))
            short = np.concatenate([start[None], short[:count]])
            np.testing.assert_array_equal(short[-1], end)
            assert count <= len(route)
            assert gaps(dense(short, spacing=0.02), scene.obstacles).min() >= RADIUS
    assert found > 0.8 * asked


def test_room_is_where_the_fewest_steps_lead():
    """In the open, straight away from the path."""
    scene = hall([LEFT, RIGHT], [])
    world, path = World.stack([scene]), np.array([LEFT, RIGHT])
    for spacing in SPACINGS:
        route = searched(world, np.array([90.0, 12, 12]), path, np.empty((0, 3)), spacing)
        steps = np.ceil(ROOM / spacing)
        assert len(route) == steps
        away = np.linalg.norm(route[-1] - [90, 12, 12])
        assert away == pytest.approx(steps * spacing * scene.apart)


def test_where_there_is_no_room_none_is_found():
    """In a narrow corridor, between two that rest on both sides."""
    scene = hall([LEFT, RIGHT], wall(60, 120, NARROW), separation=4.0)
    world, path = World.stack([scene]), np.array([LEFT, RIGHT])
    start, ends = np.array([90.0, 12, 12]), np.array([[84.0, 12, 12], [96.0, 12, 12]])
    for spacing in SPACINGS[:2]:
        assert len(searched(world, start, path, ends, spacing)) == 0
        assert len(searched(world, start, path, ends[:1], spacing)) > 0


def bent_corridor() -> Scene:
    """A flat corridor, 3 m wide, that bends twice before it leads to a yard."""
    solid = [
        [[0, 0], [50, 8.5]],  # below the first leg
        [[0, 11.5], [22.5, 72]],  # above it, left of the second one
        [[25.5, 8.5], [50, 64.5]],  # right of the second one, below the third one
        [[22.5, 67.5], [50, 72]],  # above the third one
    ]
    boxes = [[[x0, y0, 0], [x1, y1, 3]] for (x0, y0), (x1, y1) in solid]
    places = [[4, 10, 1.5], [65, 66, 1.5]]
    bounds = [[0, 0, 0], [75, 72, 3]]
    return Scene("bent", 0, bounds, places[0], places[1:], boxes, separation=4.0)


def test_a_long_way_to_room_is_free_from_its_beginning():
    """It has more corners than are kept."""
    scene = bent_corridor()
    start = np.array([10.0, 10, 1.5])
    path = np.array([[70.0, 66, 1.5], [24, 66, 1.5], [24, 10, 1.5], [4, 10, 1.5]])
    world, none = World.stack([scene]), np.empty((0, 3))
    route = searched(world, start, path, none, SPACINGS[0], longest=4 * LONGEST)
    assert len(route) > LONGEST
    whole = np.concatenate([start[None], route])
    assert gaps(dense(whole, spacing=0.05), scene.obstacles).min() >= RADIUS
