import numpy as np
import pytest

from mjcollect.geometry import enclosure
from mjcollect.geometry.boxes import point_box_distance
from mjcollect.geometry.enclosure import walled_in
from mjcollect.geometry.occupancy import blocked_grid
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene

BOUNDS = np.array([[0.0] * 3, [1000.0] * 3])
FAR_ITEM = [100.0, 100.0, 900.0]


def plates(centre, half, thick=3.0, door=0.0):
    """Six plates around a centre; a square door in the middle of the upper x plate."""
    centre, boxes = np.array(centre, float), []
    for axis in range(3):
        for side in (-1, 1):
            low, high = centre - half - thick, centre + half + thick
            if side < 0:
                high[axis] = centre[axis] - half
            else:
                low[axis] = centre[axis] + half
            boxes.append(np.stack([low, high]))
    if door:
        plate = boxes.pop(1)
        for axis in (1, 2):
            for side in (0, 1):
                part = plate.copy()
                part[1 - side, axis] = centre[axis] + (side - 0.5) * door
                if axis == 2:
                    part[:, 1] = centre[1] - door / 2, centre[1] + door / 2
                boxes.append(part)
    return np.array(boxes)


def scene(items, obstacles, **fields):
    fields = {"bounds": BOUNDS, "depot": [0.0] * 3} | fields
    return Scene(name="t", seed=0, items=items, obstacles=obstacles, **fields)


@pytest.mark.parametrize("half", [6.0, 20.0, 150.0])
@pytest.mark.parametrize("centre", [[500.0] * 3, [480.3, 222.2, 717.0]])
def test_caged_item_is_refused(centre, half):
    with pytest.raises(SceneError, match=r"items\[1\].*walled in.*the depot"):
        scene([FAR_ITEM, centre], plates(centre, half))


@pytest.mark.parametrize(
    ("door", "passes"), [(0.4, False), (0.99, False), (1.01, True), (1.5, True), (30.0, True)]
)
def test_cage_with_a_door_depends_on_its_width(door, passes):
    boxes = plates([500.0] * 3, 20.0, door=door)
    if passes:
        scene([[500.0] * 3], boxes)
    else:
        with pytest.raises(SceneError, match=r"items\[0\].*walled in"):
            scene([[500.0] * 3], boxes)


def test_a_wider_body_no_longer_fits_the_door():
    boxes = plates([500.0] * 3, 20.0, door=3.0)
    scene([[500.0] * 3], boxes, uav_radius=1.4)
    with pytest.raises(SceneError, match="walled in"):
        scene([[500.0] * 3], boxes, uav_radius=1.6)


def test_tolerance_ball_that_reaches_out_of_the_cage_is_enough():
    boxes = plates([500.0] * 3, 3.0, thick=1.0)
    scene([[500.0] * 3], boxes, epsilon=5.0)
    with pytest.raises(SceneError, match="walled in"):
        scene([[500.0] * 3], boxes, epsilon=4.2)


def test_caged_depot_is_refused():
    with pytest.raises(SceneError, match=r"depot.*walled in.*every item"):
        scene([FAR_ITEM, [200.0] * 3], plates([500.0] * 3, 20.0), depot=[500.0] * 3)


def test_depot_and_every_item_in_one_cage_is_legal():
    made = scene([[510.0] * 3, [490.0] * 3], plates([500.0] * 3, 20.0), depot=[500.0] * 3)
    assert walled_in(made) == []


def test_item_outside_the_depot_cage_is_refused_alone():
    with pytest.raises(SceneError, match=r"items\[1\].*walled in"):
        scene([[510.0] * 3, FAR_ITEM], plates([500.0] * 3, 20.0), depot=[500.0] * 3)


def test_wall_across_the_cube():
    wall = np.array([[[400.0, 0, 0], [410, 1000, 1000]]])
    with pytest.raises(SceneError, match=r"items\[0\].*walled in"):
        scene([[900.0] * 3, [100.0] * 3], wall)
    slit = wall.copy()
    slit[0, 0, 2] = 0.9  # the body's centre may touch the ground, but not the wall
    scene([[900.0] * 3, [100.0] * 3], slit)
    slit[0, 0, 2] = 0.4
    with pytest.raises(SceneError, match="walled in"):
        scene([[900.0] * 3, [100.0] * 3], slit)


def test_tightly_spaced_depot_and_item_are_accepted():
    # Both nearer to a face than any grid resolves.
    wall = np.array([[[400.0, 0, 0], [410, 1000, 999]]])
    scene([[399.0, 500, 500]], wall, depot=[410.6, 500, 500], epsilon=0.6)


def test_caged_item_among_two_hundred_boxes():
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 950, (194, 3))
    clutter = np.stack([low, low + 50], axis=1)
    clutter = clutter[point_box_distance(np.full(3, 500.0), clutter) > 100]
    clutter = clutter[point_box_distance(np.zeros(3), clutter) > 5]
    boxes = np.concatenate([clutter, plates([500.0] * 3, 20.0)])
    with pytest.raises(SceneError, match=r"items\[0\].*walled in"):
        scene([[500.0] * 3], boxes)
    scene([[500.0] * 3], np.concatenate([clutter, plates([500.0] * 3, 20.0, door=1.2)]))


def test_wide_cage_full_of_boxes():
    # Too many boxes for an exact decomposition: the plates are among the largest.
    rng = np.random.default_rng(0)
    low = rng.uniform(110, 840, (194, 3))
    clutter = np.stack([low, low + 40], axis=1)
    clutter = clutter[point_box_distance(np.full(3, 500.0), clutter) > 12]
    boxes = np.concatenate([clutter, plates([500.0] * 3, 400.0)])
    with pytest.raises(SceneError, match=r"items\[1\].*walled in"):
        scene([[50.0] * 3, [500.0] * 3], boxes)
    scene([[500.0] * 3], np.concatenate([clutter, plates([500.0] * 3, 400.0, door=1.2)]))


def flood(made, spacing):
    """Items reached on a fine grid of body centres that move by one step along an axis."""
    axes = [np.arange(a, b + 1e-9, spacing) for a, b in made.bounds.T]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    free = np.ones(points.shape[:-1], dtype=bool)
    for box in made.obstacles:
        free &= point_box_distance(points, box) >= made.uav_radius
    reached, count = np.zeros_like(free), 0
    reached[tuple(np.round((made.depot - made.bounds[0]) / spacing).astype(int))] = True
    while reached.sum() > count:
        count = reached.sum()
        for axis in range(3):
            layers = np.moveaxis(reached, axis, 0)
            layers[1:] |= layers[:-1]
            layers[:-1] |= layers[1:]
            reached &= free
    away = np.linalg.norm(points[reached][:, None] - made.items, axis=-1)
    return set(np.flatnonzero((away <= made.epsilon).any(axis=0)).tolist())


def test_random_mazes_agree_with_a_flood_fill(monkeypatch):
    """What a flood fill reaches is never refused; most of what it does not reach is."""
    monkeypatch.setattr("mjcollect.scene.depots.walled_in", lambda space: [])
    rng = np.random.default_rng(4)
    refused = unreached = reachable = 0
    for _ in range(15):
        # Blocks on a lattice of 4 m with faces on whole metres: gaps of 1 m are too narrow.
        cells = np.argwhere(rng.random((5, 5, 5)) < rng.choice([0.5, 0.7]))
        cells = cells[cells.any(axis=1)]
        low = 4.0 * cells
        boxes = np.stack([low, low + rng.choice([3.0, 4.0], low.shape, p=[0.2, 0.8])], axis=1)
        items = rng.uniform(1, 19, (60, 3))
        items = items[(point_box_distance(items[:, None], boxes) > 0.8).all(axis=1)]
        if len(items) == 0:
            continue
        made = scene(
            items, boxes, bounds=[[0] * 3, [20] * 3], depot=[1.0] * 3, epsilon=0.5,
            return_tolerance=0.5, uav_radius=0.75,
        )  # fmt: skip
        found = walled_in(made)
        reached = flood(made, 0.5)
        if found == [-1]:
            found = list(range(len(items)))
        assert reached.isdisjoint(found)
        refused += len(found)
        unreached += len(items) - len(reached)
        reachable += len(reached)
    assert min(unreached, reachable) >= 50
    assert refused >= 0.8 * unreached, (refused, unreached)


def test_blocked_grid_equals_brute_force():
    rng = np.random.default_rng(0)
    bounds = np.array([[-10.0, 0, 5], [30, 20, 15]])
    low = rng.uniform(bounds[0], bounds[1] - 1, (6, 3))
    boxes = np.stack([low, np.minimum(low + rng.uniform(0.2, 6, (6, 3)), bounds[1])], axis=1)
    shape, radius = (21, 9, 6), 0.7
    blocked = blocked_grid(bounds, boxes, radius, shape)
    assert blocked.shape == shape
    assert 0 < blocked.sum() < blocked.size
    spacing = (bounds[1] - bounds[0]) / (np.array(shape) - 1)
    for node in np.ndindex(shape):
        centre = bounds[0] + spacing * node
        cell = np.stack([centre - spacing / 2, centre + spacing / 2])
        gap = np.maximum(np.maximum(cell[0] - boxes[:, 1], boxes[:, 0] - cell[1]), 0)
        assert blocked[node] == (np.linalg.norm(gap, axis=1) < radius).any()


def test_blocked_grid_without_obstacles_is_free():
    assert not blocked_grid(BOUNDS, np.empty((0, 2, 3)), 0.5, (3, 4, 5)).any()


def test_inner_boxes_lie_within_the_radius():
    box = np.array([[[0.0, 0, 0], [2, 3, 4]]])
    for grown in enclosure._inner_boxes(box, 0.5, enclosure._ALL_SUBSETS):
        corners = np.array(np.meshgrid(*grown.T)).reshape(3, -1).T
        assert np.all(point_box_distance(corners, box[0]) < 0.5)
