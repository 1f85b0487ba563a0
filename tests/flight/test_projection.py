from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mjcollect.flight.projection import project
from mjcollect.flight.world import World
from mjcollect.scene.scene import Scene

HOLDS = 1 + 1e-12


def scene(**fields) -> Scene:
    return Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [], **fields)


LIMITS = {
    "default": World.stack([scene()]),
    "slow": World.stack([scene(v_max=5.0, a_max=20.0)]),
    "long slot": World.stack([scene(slot=1.0)]),
    "weak": World.stack([scene(v_max=50.0, a_max=2.0, slot=0.6)]),
}
anything = st.floats(allow_nan=True, allow_infinity=True)
actions = st.tuples(*[anything | st.floats(-2, 2)] * 3).map(np.array)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@st.composite
def velocities(draw):
    """In the v_max = 1 ball, often on its surface."""
    v = draw(vectors)
    size = np.linalg.norm(v)
    if size > 1 or (size > 1e-3 and draw(st.booleans())):
        v = v / size
    return v


@pytest.mark.parametrize("limits", LIMITS)
@settings(max_examples=120, deadline=None)
@given(velocities(), actions)
@example(np.array([1.0, 0, 0]), np.array([np.nan, np.inf, -np.inf]))
@example(np.array([0.0, 0, 0]), np.array([1.7e308, -1.7e308, 1e-308]))
@example(np.array([0.6, 0.8, 0]), np.array([1e200, 1.0, 0.0]))
def test_projected_commands_keep_both_limits(limits, v, action):
    world = LIMITS[limits]
    v = v * world.v_max[0, 0]
    a = project(world, v[None], action[None])[0]
    assert np.linalg.norm(a) <= world.a_max[0, 0] * HOLDS
    assert np.linalg.norm(v + a * world.slot) <= world.v_max[0, 0] * HOLDS


@pytest.mark.parametrize("limits", LIMITS)
@settings(max_examples=100, deadline=None)
@given(velocities(), vectors)
def test_feasible_actions_are_flown_as_they_are(limits, v, action):
    world = LIMITS[limits]
    action = action / max(1.0, np.linalg.norm(action))
    v, wanted = v * world.v_max[0, 0], action * world.a_max[0, 0]
    assume(np.linalg.norm(v + wanted * world.slot) <= world.v_max[0, 0])
    a = project(world, v[None], action[None])[0]
    np.testing.assert_allclose(a, wanted, rtol=0, atol=1e-11)


def test_an_infeasible_action_keeps_its_direction():
    world = LIMITS["default"]
    a = project(world, np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]]))
    np.testing.assert_allclose(a, [[12.0, 16.0, 0.0]])
    # At top speed a push ahead does nothing, a push back is granted in full.
    v = np.array([[50.0, 0, 0], [50.0, 0, 0]])
    a = project(world, v, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    np.testing.assert_allclose(a, [[0, 0, 0], [-20.0, 0, 0]], atol=1e-12)


def test_what_is_not_finite_counts_as_no_command():
    a = project(LIMITS["default"], np.zeros((1, 3)), np.array([[np.nan, np.inf, 0.5]]))
    np.testing.assert_array_equal(a, [[0.0, 0.0, 10.0]])
