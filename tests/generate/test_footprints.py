"""Rectangles over footprints: they hold all of it, add little, and stay in the window."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mjcollect.generate.footprints import EXCESS, LEAST_EXCESS, cover, polygons


def outline(rectangle):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * rectangle.half
    return shapely.Polygon(rectangle.centre + corners @ rectangle.axes)


def turned(shape, degrees):
    return shapely.affinity.rotate(shape, degrees, origin=(0, 0))


@st.composite
def footprints(draw):
    """A star-shaped polygon of 3 to 12 corners, maybe with a yard."""
    count = draw(st.integers(3, 12))
    radii = np.array(draw(st.lists(st.floats(4, 40), min_size=count, max_size=count)))
    angles = 2 * np.pi * (np.arange(count) + draw(st.floats(0, 1))) / count
    ring = np.c_[radii * np.cos(angles), radii * np.sin(angles)]
    shape = shapely.Polygon(ring)
    if draw(st.booleans()):
        shape = shape.difference(shapely.Polygon(ring * 0.5))
    assume(shape.is_valid and shape.geom_type == "Polygon")
    return shape


@settings(deadline=None, max_examples=60)
@given(footprints())
def test_rectangles_hold_a_footprint_and_add_little(shape):
    rectangles = cover(shape)
    union = shapely.union_all([outline(each) for each in rectangles])
    assert shape.difference(union).area < 0.05 * len(rectangles) + 1e-6  # slivers
    added = sum(outline(each).area for each in rectangles) - shape.area
    alone = shapely.oriented_envelope(shape).area - shape.area
    assert added <= max(alone, EXCESS * shape.area + LEAST_EXCESS * len(rectangles)) + 1.0


@settings(deadline=None, max_examples=40)
@given(footprints(), st.floats(-30, 30), st.floats(-30, 30))
def test_rectangles_stay_in_the_window(shape, x, y):
    window = shapely.box(x - 25, y - 25, x + 25, y + 25)
    for part in polygons(shapely.intersection(shape, window)):
        rectangles = cover(part, window=window)
        for each in rectangles:
            assert outline(each).difference(window).area < 1e-6
        union = shapely.union_all([outline(each) for each in rectangles])
        slivers = 0.05 * len(rectangles) + 0.02 * part.length
        assert part.difference(union).area < slivers


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 120.0])
def test_an_l_becomes_two_rectangles_and_a_rectangle_one_at_any_angle(degrees):
    corner = shapely.box(0, 0, 40, 30).difference(shapely.box(15, 12, 41, 31))
    two = cover(turned(corner, degrees))
    assert len(two) == 2
    assert sum(outline(each).area for each in two) == pytest.approx(corner.area, rel=5e-3)
    (one,) = cover(turned(shapely.box(-20, -5, 20, 5), degrees))
    assert sorted(one.half.tolist()) == pytest.approx([5.0, 20.0], abs=0.02)
    assert min((one.yaw - degrees) % 90, (degrees - one.yaw) % 90) == pytest.approx(0.0, abs=0.1)


def test_a_yard_stays_open():
    yard = shapely.box(-30, -30, 30, 30).difference(shapely.box(-20, -20, 20, 20))
    rectangles = cover(turned(yard, 25.0))
    inside = turned(shapely.box(-15, -15, 15, 15), 25.0)
    assert all(outline(each).intersection(inside).area < 1e-6 for each in rectangles)
