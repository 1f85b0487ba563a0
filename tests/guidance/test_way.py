"""What a way says at a point, against scipy, and what is seen along it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from mjcollect.envs.episode import Episodes, Rules
from mjcollect.geometry.tree import Tree
from mjcollect.guidance.approach import LOOK_AHEAD
from mjcollect.guidance.way import Way, interpolate_field, query_rows


def random_way(rng, least, counts=((5, 7, 4), (9, 3, 6))) -> Way:
    """Two fields of random values, the second over a part of the first; no box hides the aim."""
    sizes = [int(np.prod(count)) for count in counts]
    return Way(
        points=np.array([[1e3, 1e3, 1e3]]),
        remaining=np.zeros(1),
        next_direction=np.ones((1, 3)),
        cut=np.ones(1),
        tree=Tree.of(np.array([[[900.0] * 3, [950.0] * 3]])),  # in sight of none
        margin=np.zeros((1, 1)),
        most_margin=np.zeros(1),
        stop=np.zeros(4),
        unit=np.ones(1),
        low=np.array([[0.0, 0, 0], [10.0, 20, 5]]),
        spacing=np.array([[10.0, 8, 12], [2.0, 5, 3]]),
        nodes=np.array(counts),
        first=np.array([0, sizes[0]]),
        values=rng.uniform(least, 3e3, sum(sizes)).astype(np.float32),
    )


def interpolator(way, field):
    """The same field by scipy."""
    axes = [
        way.low[field, k] + way.spacing[field, k] * np.arange(way.nodes[field, k]) for k in range(3)
    ]
    values = way.values[way.first[field] :][: np.prod(way.nodes[field])]
    return RegularGridInterpolator(axes, values.reshape(way.nodes[field]).astype(np.float64))


@pytest.mark.parametrize("field", [0, 1])
def test_interpolation_is_scipy_s_and_downhill_its_slope(field):
    rng = np.random.default_rng(field)
    way = random_way(rng, 1e-3)
    reference = interpolator(way, field)
    size = way.spacing[field] * (way.nodes[field] - 1)
    hair = 1e-4
    for q in way.low[field] + rng.uniform(0.01, 0.99, (200, 3)) * size:
        downhill = np.empty(3)
        value = interpolate_field(way, field, q, downhill)
        assert value == pytest.approx(reference(q)[0], rel=1e-12)
        cell = (q - way.low[field]) / way.spacing[field] % 1.0
        if np.all((cell > 0.01) & (cell < 0.99)):  # no kink within a hair
            steps = hair * np.eye(3)
            slope = (reference(q + steps) - reference(q - steps)) / (2 * hair)
            np.testing.assert_allclose(downhill, -slope, rtol=1e-6, atol=1e-5)


def test_the_finest_field_that_is_defined_is_read():
    rng = np.random.default_rng(2)
    way = random_way(rng, 2e3)  # all farther than the straight line
    way.values[way.first[1] :].reshape(way.nodes[1])[4:] = np.nan  # from x = 18 on
    for x, field in ((12.3, 1), (15.9, 1), (16.1, 0), (25.0, 0)):
        q = np.array([x, 24.0, 11.0])
        distance, direction = np.empty(1), np.empty((1, 3))
        query_rows(way, np.array([0]), q[None], distance, direction)
        assert distance[0] == pytest.approx(interpolator(way, field)(q)[0], rel=1e-12)
        assert np.linalg.norm(direction) == pytest.approx(1.0)


def test_points_ahead_follow_the_directions(blocked_course):
    guide = blocked_course.guidance[0]
    q = np.random.default_rng(0).uniform([5.0, 5, 5], [180.0, 55, 55], (50, 3))
    v = np.random.default_rng(1).normal(size=(50, 3))
    episodes = Episodes([blocked_course], 50, Rules())
    episodes.reset(np.arange(50), q, v)
    seen = episodes.observe()
    point, points = q, []
    for stride in LOOK_AHEAD:
        distance, direction = guide.query(point)
        point = point + direction * np.minimum(stride, distance)[:, None]
        points.append((point - q) / 100)
    ahead = np.stack(points[1:], axis=1).reshape(50, -1)
    np.testing.assert_allclose(seen["guide_ahead"], ahead, rtol=0, atol=1e-12)
    bends = np.linalg.norm(np.cross(points[0], points[-1]), axis=1)
    assert np.mean(bends > 1e-3) > 0.3  # round the box, not straight on
