"""The ways that are timed fly as many steps as they say."""

from __future__ import annotations

import pytest

from benchmarks import gymnasium_vector as timed


@pytest.mark.parametrize("way", [timed.SINGLE, timed.SYNC, timed.VECTOR, timed.RAW])
def test_each_way_flies(blocked_course, way):
    count = 1 if way == timed.SINGLE else 4
    assert timed.working(way, blocked_course, count, 10)() == 10 // count * count
