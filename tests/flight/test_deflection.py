"""Deflection: what leads into something is braked across it, and goes on along it."""

from __future__ import annotations

import numpy as np
import pytest
from crowds import RADIUS
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from test_shield import A_MAX, V_MAX, world_of

from mjcollect.flight.deflection import deflect_row
from mjcollect.flight.projection import project
from mjcollect.flight.shield import shield
from mjcollect.flight.straight_line import slot_path
from mjcollect.geometry.boxes import EMPTY_BOX

ROOM = np.array([[0.0, 0.0, 0.0], [1000.0, 1000.0, 1000.0]])
WALL = [[300.0, -100.0, -100.0], [340.0, 1100.0, 1100.0]]


def fly(world, q, v, command, slots):
    """Positions and velocities (slots + 1, 3) of a body that is asked for one command always."""
    places, speeds = [np.array(q, float)], [np.array(v, float)]
    stop, acted, left = np.zeros(1, bool), np.zeros(1, bool), np.zeros(1, np.intp)
    held = np.zeros((1, 3))
    for _ in range(slots):
        a = project(world, speeds[-1][None], np.asarray(command)[None] / A_MAX)
        shield(world, places[-1][None], speeds[-1][None], a, stop, held, left, acted)
        path, ends = slot_path(world, places[-1][None], speeds[-1][None], a)
        places.append(path[0, -1])
        speeds.append(ends[0])
    return np.array(places), np.array(speeds)


@pytest.mark.parametrize("angle", [20.0, 45.0, 60.0])
def test_at_an_angle_to_a_wall_a_body_keeps_its_speed_along_it(angle):
    world, along = world_of(ROOM, [WALL]), 40.0 * np.cos(np.radians(angle))
    v = [40.0 * np.sin(np.radians(angle)), along, 0.0]
    places, speeds = fly(world, [200.0, 100.0, 500.0], v, np.zeros(3), 60)
    assert places[:, 0].max() <= 300.0 - RADIUS
    assert places[-1, 0] > 290.0
    assert speeds[:, 1].min() > 0.95 * along  # full braking would take all of it


def test_at_rest_on_a_bound_what_leads_out_is_left_out():
    world = world_of(ROOM, [EMPTY_BOX])
    places, _ = fly(world, [500.0, 500.0, 0.0], np.zeros(3), np.array([10.0, 0.0, -10.0]), 10)
    assert places[:, 2].min() >= -1e-6
    assert places[-1, 0] > 510.0  # 20 m in free air


def test_in_a_corner_of_two_walls_both_are_kept_clear_of():
    other = [[-100.0, 300.0, -100.0], [1100.0, 340.0, 1100.0]]
    world = world_of(ROOM, [WALL, other])
    places, _ = fly(world, [290.0, 290.0, 500.0], np.zeros(3), np.full(3, 10.0), 15)
    assert places[:, :2].max() <= 300.0 - RADIUS
    assert places[-1, 2] > 515.0


vectors = arrays.arrays(float, 3, elements=st.floats(-1, 1))


@settings(deadline=None)
@given(vectors, vectors, vectors, st.floats(-1, 200))
def test_a_deflected_command_is_no_stronger_and_leads_less_towards_it(v, a, away, gap):
    assume(np.linalg.norm(away) > 0.1)
    away, v, a = away / np.linalg.norm(away), v * V_MAX / 2, a * A_MAX / 2
    was, world = a.copy(), world_of(ROOM, [EMPTY_BOX])
    deflected = deflect_row(world, 0, v, A_MAX, away, gap, a)
    if not deflected:
        np.testing.assert_array_equal(a, was)
        return
    assert np.linalg.norm(a) <= A_MAX + 1e-9
    assert a @ away <= was @ away + 1e-9
    # Along it nothing turns round: what is left of the command is a share of what it was.
    rest, before = a - (a @ away) * away, was - (was @ away) * away
    np.testing.assert_allclose(np.cross(rest, before), 0.0, atol=1e-6)
    assert rest @ before >= -1e-9
