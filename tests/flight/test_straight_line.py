from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjcollect.flight.straight_line import time_to_go
from mjcollect.flight.world import World
from mjcollect.scene.scene import Scene

A, TOP = 20.0, 50.0
WORLD = World.stack([Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [])])


def reachable(seconds, closing):
    """Least and greatest displacement from `closing` m/s to rest in `seconds`, by quadrature.

    The speed can at no time be above (below) the lower (upper) envelope of what the start, the
    end and the limit allow.
    """
    t = np.linspace(0.0, seconds, 4001)
    fast = np.minimum(np.minimum(closing + A * t, A * (seconds - t)), TOP)
    back = np.maximum(np.maximum(closing - A * t, -A * (seconds - t)), -TOP)
    return np.trapezoid(back, t), np.trapezoid(fast, t)


def least_time(distance, closing, slack=0.0):
    """Bisection on the duration: once reachable, a point stays reachable by waiting there."""
    low, high = abs(closing) / A, 200.0
    for _ in range(50):
        middle = (low + high) / 2
        least, most = reachable(middle, closing)
        there = least <= distance + slack and distance - slack <= most
        low, high = (low, middle) if there else (middle, high)
    return high


def test_time_to_go_is_the_least_time():
    rng = np.random.default_rng(0)
    distance = np.concatenate(
        [rng.uniform(0, 5, 30), rng.uniform(0, 200, 40), rng.uniform(0, 1500, 20)]
    )
    closing = rng.uniform(-TOP, TOP, len(distance))
    closing[::7] = 0.0
    expected = [least_time(d, v) for d, v in zip(distance, closing, strict=True)]
    np.testing.assert_allclose(time_to_go(WORLD, distance, closing), expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("distance", "closing", "seconds"),
    [
        (0.0, 0.0, 0.0),
        (125.0, 0.0, 5.0),  # just reaches 50 m/s
        (1125.0, 0.0, 25.0),
        (62.5, 50.0, 2.5),  # one stop
        (0.0, -20.0, 1.0 + 2**0.5),  # brakes on 10 m, then comes back
        (0.0, 20.0, 1.0 + 2**0.5),  # overshoots by 10 m
        (1e6, 0.0, 60.0),
        (1e6, -50.0, 60.0),
    ],
)
def test_time_to_go_by_hand(distance, closing, seconds):
    found = time_to_go(WORLD, np.array([distance]), np.array([closing]))
    assert found[0] == pytest.approx(seconds, abs=1e-12)


def test_time_to_go_uses_each_simulation_s_own_limits():
    scenes = [
        Scene("t", 0, [[0] * 3, [1000] * 3], [0.0] * 3, [[990.0] * 3], [], a_max=a, v_max=v)
        for a, v in [(20.0, 50.0), (5.0, 50.0), (20.0, 10.0)]
    ]
    time = time_to_go(World.stack(scenes), np.full(3, 100.0), np.zeros(3))
    np.testing.assert_allclose(time, [2 * 5**0.5, 2 * 20**0.5, 10.0 + 0.5])


def test_slack_is_the_least_time_to_any_point_within_it():
    """Against what can be reached; the point itself is never behind the body."""
    rng = np.random.default_rng(4)
    slack = rng.uniform(0.1, 6.0, 120)
    distance = np.concatenate([rng.uniform(0, 12, 60), rng.uniform(0, 400, 60)])
    closing = np.concatenate([rng.uniform(-15, 15, 60), rng.uniform(-TOP, TOP, 60)])
    closing[::7] = 0.0
    # Braking hard enough in the far end, in the near one, too late for both, and none of it.
    closing[30:36] = np.sqrt(2 * A * (distance[30:36] + slack[30:36] * [-0.5, 0, 0.5, 1, 1.2, 3]))
    expected = [least_time(*case) for case in zip(distance, closing, slack, strict=True)]
    found = time_to_go(WORLD, distance, closing, slack)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)


speeds, metres = st.floats(-TOP, TOP), st.floats(0, 1500)


@settings(deadline=None)
@given(metres, metres, speeds, st.floats(0, 8), st.floats(0, 8))
def test_time_to_go_grows_with_the_distance_from_rest_and_shrinks_with_slack(
    one, other, speed, less, more
):
    (near, far), (less, more) = sorted([one, other]), sorted([less, more])

    def time(distance, closing, slack):
        return float(time_to_go(WORLD, np.array([distance]), np.array([closing]), slack)[0])

    assert time(near, 0.0, less) <= time(far, 0.0, less) + 1e-9
    assert time(far, speed, more) <= time(far, speed, less) + 1e-9
    assert time(far, speed, more) >= abs(speed) / A - 1e-9  # it ends at rest
    assert time(min(near, less), 0.0, less) == 0.0  # is there
    # Receding, the way back is longer than from rest.
    assert time(near, -abs(speed), less) >= time(near, 0.0, less) - 1e-9


@settings(deadline=None)
@given(metres, speeds, st.floats(0, 8), st.integers(0, 4))
def test_time_to_go_has_no_jumps(distance, speed, slack, kink):
    """Also not where the cases of its formula meet."""
    if kink == 1:
        distance = speed**2 / (2 * A) + slack
    elif kink == 2:
        distance = max(speed**2 / (2 * A) - slack, 0.0)
    elif kink == 3:
        speed = 0.0
    elif kink == 4:
        distance = slack
    hair = 1e-9
    beside = np.array([[d, v] for d in (-hair, 0.0, hair) for v in (-hair, 0.0, hair)])
    at = np.array([max(distance, hair), np.clip(speed, hair - TOP, TOP - hair)]) + beside
    times = time_to_go(WORLD, at[:, 0], at[:, 1], np.full(9, slack))
    assert np.ptp(times) < 4 * np.sqrt(3 * TOP / A * hair / A)  # it may rise like a square root
