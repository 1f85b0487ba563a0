import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.geometry.among_boxes import segment_clear
from mjcollect.geometry.boxes import (
    EMPTY_BOX,
    inflate,
    nearest_point_offset,
    point_box_distance,
    segment_box_distance,
)

UNIT = np.array([[0.0] * 3, [1.0] * 3])


def random_boxes(rng, count):
    low = rng.uniform(-5, 5, (count, 3))
    return np.stack([low, low + rng.uniform(0.1, 4, (count, 3))], axis=1)


@pytest.mark.parametrize(
    ("point", "offset"),
    [
        ([0.5, 0.5, 0.5], [0, 0, 0]),
        ([2, 0.5, 0.5], [-1, 0, 0]),
        ([-1, -2, 0.5], [1, 2, 0]),
        ([3, 3, -2], [-2, -2, 2]),
        ([1, 1, 1], [0, 0, 0]),
    ],
)
def test_point_to_unit_cube(point, offset):
    assert nearest_point_offset(np.array(point, float), UNIT).tolist() == offset
    assert point_box_distance(np.array(point, float), UNIT) == pytest.approx(np.linalg.norm(offset))


def test_point_distance_is_least_over_the_box():
    rng = np.random.default_rng(0)
    boxes = random_boxes(rng, 30)
    share = np.linspace(0, 1, 15)
    grid = np.stack(np.meshgrid(share, share, share), -1).reshape(-1, 3)
    for box in boxes:
        point = rng.uniform(-8, 8, 3)
        inside = box[0] + grid * (box[1] - box[0])
        sampled = np.linalg.norm(inside - point, axis=1).min()
        exact = float(point_box_distance(point, box))
        assert exact <= sampled + 1e-12
        assert sampled <= exact + np.linalg.norm(box[1] - box[0]) / 14


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [
        ([-1, 0.5, 0.5], [2, 0.5, 0.5], 0.0),  # through
        ([-1, 1, 1], [2, 1, 1], 0.0),  # along an edge
        ([-1, 2, 0.5], [2, 2, 0.5], 1.0),  # past a face
        ([2, 0, 3], [2, 1, 3], np.sqrt(5)),  # beside an edge
        ([2, 2, 2], [2, 2, 2], np.sqrt(3)),  # a point off a corner
        ([0.5, 0.5, 0.5], [0.5, 0.5, 0.5], 0.0),  # a point inside
        ([3, 0, 0.5], [0, 3, 0.5], 1 / np.sqrt(2)),  # across an edge
        ([2, 0.5, 0.5], [5, 0.5, 0.5], 1.0),  # leaving
        ([5, 0.5, 0.5], [2, 0.5, 0.5], 1.0),  # ending short
    ],
)
def test_segment_to_unit_cube(start, end, distance):
    start, end = np.array(start, float), np.array(end, float)
    assert segment_box_distance(start, end, UNIT) == pytest.approx(distance, abs=1e-12)
    assert segment_box_distance(end, start, UNIT) == pytest.approx(distance, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32))
def test_segment_distance_is_least_over_its_points(seed):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 20)
    start, end = rng.uniform(-8, 8, (2, 3))
    if seed % 3 == 0:
        end[rng.integers(3)] = start[0]  # also along an axis
    points = start + np.linspace(0, 1, 4001)[:, None] * (end - start)
    sampled = point_box_distance(points[:, None], boxes).min(axis=0)
    exact = segment_box_distance(start, end, boxes)
    assert np.all(exact <= sampled + 1e-9)
    assert np.all(sampled <= exact + np.linalg.norm(end - start) / 8000 + 1e-9)


def test_shapes_broadcast():
    boxes = random_boxes(np.random.default_rng(0), 7)
    points = np.zeros((4, 5, 3))
    assert point_box_distance(points[..., None, :], boxes).shape == (4, 5, 7)
    assert segment_box_distance(points[..., None, :], points[..., None, :], boxes).shape == (
        4,
        5,
        7,
    )
    assert segment_clear(points, points, boxes, 0.1).shape == (4, 5)


def test_inflate():
    assert inflate(UNIT, 0.5).tolist() == [[-0.5] * 3, [1.5] * 3]
    assert inflate(np.stack([UNIT, UNIT]), np.array([1.0, 2.0]))[1].tolist() == [[-2] * 3, [3] * 3]


def test_clear_means_at_least_the_radius_away_from_every_box():
    boxes = np.stack([UNIT, UNIT + 10])
    start = np.array([[-5, 0.5, 1.5], [-5, 0.5, 1.49], [-5, 10.5, 11.2]])
    end = start + np.array([20, 0, 0])
    assert segment_clear(start, end, boxes, 0.5).tolist() == [True, False, False]
    assert segment_clear(start, end, boxes, 0.1).tolist() == [True, True, True]


def test_without_boxes_everything_is_clear():
    none = np.empty((0, 2, 3))
    assert segment_clear(np.zeros((4, 3)), np.ones((4, 3)), none, 0.5).tolist() == [True] * 4
    assert bool(segment_clear(np.zeros(3), np.ones(3), none, 0.5))


def test_a_padding_box_is_far_and_finite():
    distance = segment_box_distance(np.zeros(3), np.full(3, 1e5), EMPTY_BOX)
    assert np.isfinite(distance)
    assert distance > 1e8
