"""Places of a fleet at the depot, and the parts of a scene."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crowds import dense, gaps
from traffic import hall

from mjcollect.fleet.episode import courses
from mjcollect.fleet.share import SHARES, STEEP, least_gap, most_places, pads, parts, spread
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.order import TourError
from mjcollect.scene.scene import Scene

BOUNDS = np.array([[0.0, 0, 0], [100, 100, 40]])
POST = [[[52.0, 48.5, 0], [53, 51.5, 40]]]  # 2 m beside the depot
WALL = [[[50.6, 0, 0], [52, 100, 30]]]  # 0.6 m beside it
PILLARS = [
    [[50 + x - 0.5, 50 + y - 0.5, 0], [50 + x + 0.5, 50 + y + 0.5, 40]]
    for x, y in ((3, 0), (-3, 0), (0, 3), (0, -3))
]
DEPOTS = {
    "open": ([50.0, 50, 20], []),
    "corner": ([0.0, 0, 0], []),
    "floor": ([50.0, 50, 0], []),
    "next to a wall": ([50.0, 50, 20], WALL),
    "behind a post": ([50.0, 50, 20], POST),
    "among pillars": ([50.0, 50, 20], PILLARS),
}
ITEMS = [[10.0, 90, 30], [90, 90, 30], [90, 10, 30], [20, 60, 10], [70, 85, 5]]


def scene_at(kind: str, **fields) -> Scene:
    depot, boxes = DEPOTS[kind]
    return Scene("depot", 0, BOUNDS, depot, ITEMS, np.array(boxes).reshape(-1, 2, 3), **fields)


@pytest.mark.parametrize("kind", DEPOTS)
@pytest.mark.parametrize("uavs", range(2, 9))
def test_pads_keep_apart_free_near_and_in_sight(kind, uavs):
    scene = scene_at(kind)
    places, tolerance = pads(scene, uavs)
    assert places.shape == (uavs, 3)
    assert tolerance >= SHARES[-1] * scene.return_tolerance
    offset = np.linalg.norm(places[:, None] - places, axis=2) + 1e9 * np.eye(uavs)
    # Wherever they rest within the tolerance, they keep apart.
    assert offset.min() >= scene.apart + 2 * tolerance - 1e-9
    away = np.linalg.norm(places - scene.depot, axis=1)
    assert (away + tolerance <= scene.return_tolerance + 1e-9).all()
    assert ((places >= BOUNDS[0]) & (places <= BOUNDS[1])).all()
    ways = np.concatenate([dense(np.array([scene.depot, place]), 0.01) for place in places])
    assert gaps(ways, scene.obstacles).min(initial=np.inf) >= scene.uav_radius - 1e-9


def test_a_post_hides_what_is_behind_it():
    """Places there would be free and near enough."""
    hidden = np.array([54.0, 50, 20])
    scene = scene_at("behind a post")
    assert gaps(hidden[None], scene.obstacles)[0] > scene.uav_radius
    for uavs in range(2, 9):
        behind = pads(scene, uavs)[0] - scene.depot
        level = np.abs(behind[:, 1]) / np.maximum(behind[:, 0], 1e-9)
        assert not ((behind[:, 0] > 2) & (level < 0.7)).any()


def test_the_fewer_there_are_the_less_exactly_they_have_to_rest():
    tolerances = [pads(scene_at("open"), uavs)[1] for uavs in range(1, 9)]
    assert np.all(np.diff(tolerances) <= 0.15)  # They are found by steps, in directions of a grid.
    assert tolerances[0] == 5.0
    assert tolerances[1] >= 2.0  # 5 m = half of 2 m + 2 * 2 m, and another 2 m to the place
    assert tolerances[-1] >= 0.5


def test_one_has_the_depot_itself():
    for kind in DEPOTS:
        scene = scene_at(kind)
        places, tolerance = pads(scene, 1)
        np.testing.assert_array_equal(places, scene.depot[None])
        assert tolerance == scene.return_tolerance


def test_clearance_and_a_wider_separation_count():
    scene = scene_at("next to a wall", separation=3.0, uav_radius=0.3, clearance=0.2)
    places, tolerance = pads(scene, 4)
    offset = np.linalg.norm(places[:, None] - places, axis=2) + 1e9 * np.eye(4)
    assert offset.min() >= 3.0 + 2 * tolerance - 1e-9
    assert gaps(places, scene.obstacles).min() >= 0.5


@pytest.mark.parametrize(
    ("kind", "uavs", "fields"),
    [
        ("open", 200, {}),
        ("open", 70, {}),
        ("open", 2, {"separation": 10.0}),
        ("corner", 40, {}),
        ("open", 2, {"return_tolerance": 0.9}),
    ],
)
def test_too_many_are_refused(kind, uavs, fields):
    """10 m apart at 5 m from the depot would leave no tolerance at all."""
    scene = scene_at(kind, **fields)
    with pytest.raises(SceneError) as refused:
        pads(scene, uavs)
    message = str(refused.value)
    assert message.startswith(f"return_tolerance: {scene.return_tolerance}: {uavs} UAVs")
    assert f"{scene.apart:g} m apart" in message
    for way in ("raise it", "lower separation", "fewer UAVs"):
        assert way in message
    with pytest.raises(SceneError, match="return_tolerance"):
        parts(scene, [(0,)] * uavs)


def test_no_more_places_are_thought_possible_than_a_sphere_has_and_no_fewer_than_are_known():
    """Corners of regular bodies in a sphere, with so many corners that far from each other."""
    known = {2: 2.0, 4: np.sqrt(8 / 3), 6: np.sqrt(2), 8: np.sqrt(4 / 3), 12: 1.0515, 20: 0.7136}
    for corners, gap in known.items():
        assert corners <= most_places(3.0, 3.0 * gap) + 1e-9
        assert most_places(3.0, 3.0 * gap) < 2.2 * corners
    assert most_places(1.0, 2.1) == 1


def test_points_are_spread_so_that_none_is_better_placed_elsewhere():
    points = np.random.default_rng(0).uniform(-5, 5, (300, 3))
    chosen = spread(points, 6)
    assert chosen is not None
    least, at_random = least_gap(chosen), [least_gap(points[6 * k : 6 * k + 6]) for k in range(50)]
    assert least > 1.5 * max(at_random)
    for k in range(6):
        others = np.delete(chosen, k, axis=0)
        reached = np.linalg.norm(points[:, None] - others, axis=2)
        own = np.linalg.norm(chosen[k] - others, axis=1)
        assert np.sum(np.maximum(reached, 1e-9) ** -STEEP, axis=1).min() >= np.sum(own**-STEEP) * (
            1 - 1e-6
        )
    assert spread(points[:5], 6) is None


def test_rounding_does_not_choose_among_places_that_are_equally_good():
    """Eight or more lie alike on a sphere, and rounding differs between machines."""
    axis = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    outer = grid[np.abs(grid).max(axis=1) == 1.0]
    points = outer / np.linalg.norm(outer, axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    for uavs in range(2, 9):
        chosen = spread(points, uavs)
        for _ in range(5):
            rounded = points + rng.uniform(-1e-14, 1e-14, points.shape)
            np.testing.assert_allclose(spread(rounded, uavs), chosen, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", DEPOTS)
def test_no_place_is_shut_in_by_those_that_are_taken(kind):
    """From farther out each is reached in a straight line that keeps apart from all others."""
    scene = scene_at(kind)
    places, tolerance = pads(scene, 5)
    for k, place in enumerate(places):
        line = place + np.linspace(0.0, 3.0, 50)[:, None] * (place - scene.depot)
        gap = np.linalg.norm(line[:, None] - np.delete(places, k, axis=0), axis=2).min()
        assert gap >= scene.apart + 2 * tolerance - 1e-9


# Parts


def test_parts_share_out_the_items_and_share_the_boxes():
    scene = scene_at("among pillars")
    tours = ((3, 0), (1, 4), (2,))
    found = parts(scene, tours)
    places, tolerance = pads(scene, 3)
    for part, tour, place in zip(found, tours, places, strict=True):
        np.testing.assert_array_equal(part.items, scene.items[list(tour)])
        np.testing.assert_array_equal(part.depot, place)
        assert part.return_tolerance == tolerance
        assert part.tree is scene.tree
        assert part.boxes is scene.boxes
        assert part.name.startswith(scene.name)
        whole, own = scene.to_dict(), part.to_dict()
        for key in ("name", "items", "depot", "return_tolerance"):
            del whole[key], own[key]
        assert own == whole
        with pytest.raises(ValueError, match="read-only"):
            part.items[0, 0] = 1.0
        with pytest.raises(ValueError, match="read-only"):
            part.depot[0] = 1.0
    every = np.concatenate([part.items for part in found])
    assert sorted(every.tolist()) == sorted(scene.items.tolist())
    assert len({part.slug for part in found}) == 3
    assert len(scene.items) == 5  # The scene stays as it was.
    assert scene.return_tolerance == 5.0


def test_parts_are_scenes_that_can_be_written_and_read(tmp_path):
    for kind in DEPOTS:
        for part in parts(scene_at(kind), ((3, 0), (1, 4), (2,))):
            part.save(tmp_path / "part.json")
            assert Scene.load(tmp_path / "part.json") == part
            dataclasses.replace(part)  # It keeps all rules of a scene.


def test_the_part_of_one_is_the_scene():
    scene = scene_at("next to a wall")
    (part,) = parts(scene, [(4, 3, 2, 1, 0)])
    np.testing.assert_array_equal(part.items, scene.items[::-1])
    assert part.tree is scene.tree
    whole = dataclasses.replace(scene, items=scene.items[::-1], name=part.name)
    assert part == whole


def test_courses_begin_and_end_at_their_places():
    scene = hall([[20, 12, 12], [160, 12, 12], [100, 6, 6]], [], length=200.0)
    found = courses(scene, [(1, 0), (), (2,)])
    assert [len(course.scene.items) for course in found] == [2, 1]
    for course, place in zip(found, pads(scene, 2)[0], strict=True):
        assert course.nodes == (-1, *range(len(course.scene.items)), -1)
        (start,), _ = course.starts("point", 1, np.random.default_rng(0))
        np.testing.assert_array_equal(start, place)
        np.testing.assert_array_equal(course.guidance[-1].goal, place)


@pytest.mark.parametrize(
    ("tours", "message"),
    [
        ([(0,), (5,)], "tours: 5: must be an item, 0 to 4"),
        ([(0,), (-1,)], "tours: -1: must be an item, 0 to 4"),
        ([(0, 1), (1,)], "tours: 1: is visited more than once"),
        ([(0, 0)], "tours: 0: is visited more than once"),
        ([(), ()], "at least one item"),
        ([], "at least one item"),
    ],
)
def test_tours_that_cannot_be_flown_are_refused(tours, message):
    with pytest.raises(TourError, match=message):
        courses(scene_at("open"), tours)
