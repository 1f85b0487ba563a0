"""What a flight finds out of its disturbances, against the truth and against NumPy's own fits."""

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.flight.disturbance_estimate import (
    AT,
    DOUBT,
    KEPT,
    SUMS,
    Estimate,
    estimate,
    gather,
)
from mjcollect.flight.world import World
from mjcollect.scene.scene import Scene

COUNT, SLOTS = 64, 40


@pytest.fixture(scope="module")
def course():
    """An item far ahead in a large empty room."""
    room = Scene("room", 0, [[0, 0, 0], [4000] * 3], [2000] * 3, [[3500, 2000, 2000]], [])
    return Course.segment(room, (0,), 0)


def flown(course, level, slots=SLOTS, estimates="flight"):
    """Flights with commands that turn now and then, as a pilot's do."""
    disturbances = Disturbances(level, COUNT, np.random.default_rng(3))
    rules = Rules("robust", shield=False, estimate=estimates)
    sims = Simulations([course], COUNT, rules=rules, threads=1, disturbances=disturbances)
    sims.place(np.arange(COUNT), np.full((COUNT, 3), 2000.0), np.zeros((COUNT, 3)))
    rng, action = np.random.default_rng(5), np.zeros((COUNT, 3))
    for slot in range(slots):
        if slot % 3 == 0:
            action = 0.5 * rng.standard_normal((COUNT, 3))
        sims.step(action)
    return sims, sims.episodes.known, disturbances.truth(sims.episodes.world)


def rms(error):
    return float(np.sqrt(np.mean(error**2)))


def test_nothing_is_known_before_the_first_slot(course):
    sims, known, _ = flown(course, Disturbance(wind=3.0, noise=0.5), slots=0)
    for field in known:
        np.testing.assert_array_equal(field, 0.0)
    seen = sims.episodes.observe()
    np.testing.assert_array_equal(seen["push"], 0.0)
    np.testing.assert_array_equal(seen["doubts"][:, :4], 0.0)


def test_steady_wind_is_found_in_a_slot(course):
    sims, known, truth = flown(course, Disturbance(wind=2.0), slots=1)
    np.testing.assert_allclose(known.push, truth.push, atol=0.15)
    _, known, truth = flown(course, Disturbance(wind=2.0))
    np.testing.assert_allclose(known.push, truth.push, atol=1e-6)
    np.testing.assert_allclose(known.gain, 0.0, atol=1e-6)
    np.testing.assert_allclose(known.late, 0.0, atol=1e-6)
    world = sims.episodes.world
    shown = sims.episodes.observe()["push"] * sims.episodes.seen_world.a_max
    frame = sims.episodes.approach.frame
    back = np.einsum("nk,nkj->nj", shown, frame)
    np.testing.assert_allclose(back, sims.episodes.known.push, atol=1e-9)
    assert (sims.episodes.seen_world.a_max < world.a_max).all()


@pytest.mark.parametrize(
    ("level", "field", "error"),
    [
        (Disturbance(gain=0.3), "gain", 0.04),
        (Disturbance(delay=0.1), "late", 0.02),
        (Disturbance(gain=0.2, delay=0.06), "late", 0.02),
        (Disturbance(gusts=2.0), "push", 0.9),
        (Disturbance(wind=4.0, gusts=2.0, gain=0.2, delay=0.08), "gain", 0.12),
    ],
)
def test_each_kind_is_found(course, level, field, error):
    """Far better than not knowing, which is the greatness of the disturbance itself."""
    _, known, truth = flown(course, level)
    missed = rms(getattr(known, field) - getattr(truth, field))
    assert missed < error
    assert missed < 0.6 * rms(getattr(truth, field))


def test_the_spread_is_that_of_gusts_to_come(course):
    """What the next slot's mean acceleration differs from what is foretold, along one axis."""
    sims, known, _ = flown(course, Disturbance(gusts=2.0), 60)
    world, v = sims.episodes.world, sims.episodes.v.copy()
    sims.step(np.zeros((COUNT, 3)))
    foretold = known.flown(sims.episodes.disturbances.last)
    missed = (sims.episodes.v - v) / world.slot - foretold
    assert rms(known.spread) == pytest.approx(rms(missed), rel=0.25)


def test_noise_is_filtered_from_positions(course):
    noise = 0.5
    sims, known, _ = flown(course, Disturbance(noise=noise), 60)
    episodes = sims.episodes
    assert rms(episodes.observed - episodes.truth) == pytest.approx(noise, rel=0.1)
    error = rms(episodes.sums[:, AT.position] - episodes.truth)
    assert error < noise / 3
    assert rms(known.blur) == pytest.approx(error, rel=0.5)


def test_decisions_see_the_state_when_their_command_takes_effect(course):
    """With everything told, the state foretold is where the delayed command finds the body."""
    level = Disturbance(wind=3.0, gain=0.2, delay=0.1)
    sims, _, truth = flown(course, level, estimates="truth")
    episodes = sims.episodes
    q, v = episodes.q.copy(), episodes.seen_v.copy()
    step = round(float(truth.late[0, 0]) / episodes.world.step)
    sims.step(np.zeros((COUNT, 3)))
    np.testing.assert_allclose(sims.speeds[:, step - 1], v, atol=1e-9)
    np.testing.assert_allclose(sims.path[:, step - 1], q, atol=0.05)  # semi-implicit steps


def test_countered_commands_fly_as_what_was_meant():
    rng = np.random.default_rng(0)
    known = Estimate.calm(50)._replace(
        gain=rng.uniform(-0.4, 0.4, (50, 1)), push=2.0 * rng.standard_normal((50, 3))
    )
    a, a_max = 3.0 * rng.standard_normal((50, 3)), np.full((1, 1), 20.0)
    np.testing.assert_allclose(known.flown(known.counter(a, a_max)), a)
    size = np.linalg.norm(known.counter(100.0 * a, a_max), axis=1)
    np.testing.assert_allclose(size, 20.0)


def test_braking_counts_on_what_the_actuators_leave():
    """Against the greatest deceleration among many commands."""
    rng = np.random.default_rng(2)
    known = Estimate.calm(20)._replace(
        gain=rng.uniform(-0.3, 0.0, (20, 1)), push=2.0 * rng.standard_normal((20, 3))
    )
    v, a_max = rng.standard_normal((20, 3)), np.full((1, 1), 20.0)
    ahead = -v / np.linalg.norm(v, axis=1, keepdims=True)
    commands = rng.standard_normal((20000, 1, 3))
    commands *= 20.0 / np.linalg.norm(commands, axis=2, keepdims=True)
    flown = (1.0 + known.gain) * commands + known.push
    along = np.sum(flown * ahead, axis=2)
    straight = np.linalg.norm(flown - along[:, :, None] * ahead, axis=2) < 0.8
    most = np.where(straight, along, 0.0).max(axis=0)
    most = np.minimum(most, known.usable(a_max)[:, 0])  # No more is asked for.
    np.testing.assert_allclose(known.braking(a_max, v)[:, 0], most, atol=0.3)


def test_estimates_are_a_weighted_regression():
    """Against NumPy's least squares with the same weights; the doubt is two slots of its own."""
    rng = np.random.default_rng(1)
    room = Scene("room", 0, [[0, 0, 0], [100] * 3], [50] * 3, [[60, 50, 50]], [])
    world, slots = World.stack([room]), 30
    command = rng.standard_normal((slots, 3))
    before = np.concatenate([np.zeros((1, 3)), command[:-1]])
    flown = 0.8 * command + 0.4 * before + [0.1, -0.05, 0.02]
    flown = flown + 0.01 * rng.standard_normal((slots, 3))
    sums, v = np.zeros((1, SUMS)), np.zeros((1, 3))
    for c, a in zip(command * room.a_max, flown * room.a_max, strict=True):
        after = v + a * room.slot
        gather(world, sums, v, after, c[None], np.zeros((1, 3)))
        v = after
    weight = np.repeat(np.sqrt(KEPT ** np.arange(slots - 1, -1, -1)), 3)[:, None]
    columns = np.column_stack([command.ravel(), before.ravel(), np.tile(np.eye(3), (slots, 1))])
    doubt = np.sqrt(DOUBT) * np.eye(2, 5)
    right = np.concatenate([flown.ravel() * weight[:, 0], np.sqrt(DOUBT) * np.array([1.0, 0.0])])
    found = np.linalg.lstsq(np.vstack([columns * weight, doubt]), right, rcond=None)[0]
    known = estimate(world, sums)
    np.testing.assert_allclose(known.gain[0, 0], found[0] + found[1] - 1.0, rtol=1e-9)
    late = found[1] / (found[0] + found[1]) * room.slot
    np.testing.assert_allclose(known.late[0, 0], late, rtol=1e-9)
    steady = (sums[:, AT.acceleration] - found[0] * sums[:, AT.command] - found[1]
              * sums[:, AT.before]) / sums[:, AT.slots]  # fmt: skip
    np.testing.assert_allclose(steady[0], found[2:], rtol=1e-9)
