"""A policy that gets no nearer tries something else for a while, and only then."""

import numpy as np
import pytest

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import by_policies, fly_disturbed
from mjcollect.envs.episode import Rules
from mjcollect.envs.exploration import BURST, PATIENCE, Exploration
from mjcollect.flight.disturbance import Disturbance
from mjcollect.scene.scene import Scene


class Lazy:
    """Hovers where it is: it never arrives by itself."""

    observation = "guided"

    def __call__(self, observation):
        return np.zeros((len(observation), 3))


def simulations(course, count=2):
    sims = Simulations([course], count, rules=Rules("guided"), threads=1)
    sims.reset()
    return sims


def test_who_gets_nearer_is_left_alone(free_course):
    sims = simulations(free_course)
    exploration, done = Exploration(2), np.zeros(2, dtype=bool)
    while not done.any():
        law = sims.law()
        assert (exploration(sims.episodes, law) == law).all()
        outcome = sims.step(law)
        done = outcome.terminated | outcome.truncated
    assert outcome.success.all()
    assert (exploration.slots == 0).all()
    sims.close()


def test_who_hovers_explores_after_its_patience_for_a_burst(free_course):
    sims, slot = simulations(free_course), free_course.scene.slot
    exploration = Exploration(2, seed=1)
    changed = []
    for _ in range(round((PATIENCE + BURST) / slot) + 3):
        action = exploration(sims.episodes, np.zeros((2, 3)))
        assert (np.abs(action) <= 1.0).all()
        changed.append(np.abs(action).max(axis=1) > 0)
        sims.step(np.zeros((2, 3)))
    first, count = round(PATIENCE / slot), round(BURST / slot)
    wanted = [first <= k < first + count for k in range(len(changed))]
    assert [list(both) for both in changed] == [[each, each] for each in wanted]
    assert list(exploration.slots) == [count, count]
    sims.reset(np.array([1]))
    exploration(sims.episodes, np.zeros((2, 3)))
    assert list(exploration.slots) == [count, 0]
    sims.close()


def test_a_new_target_is_no_step_back():
    """Its way is longer than what was left of the old one; patience begins anew."""
    scene = Scene(
        name="two", seed=0, bounds=[[0, 0, 0], [400, 60, 60]], depot=[5, 30, 30],
        items=[[60, 30, 30], [380, 30, 30]], obstacles=[],
    )  # fmt: skip
    course = Course.mission(scene, (0, 1))
    sims = simulations(course, 1)
    exploration, targets, done = Exploration(1), set(), False
    while not done:
        law = sims.law()
        targets.add(int(sims.episodes.target[0]))
        assert (exploration(sims.episodes, law) == law).all()
        outcome = sims.step(law)
        done = bool(outcome.terminated[0] | outcome.truncated[0])
    assert targets == {0, 1, 2}
    sims.close()


@pytest.mark.parametrize("explore", [False, True])
def test_a_policy_that_is_stuck_arrives_by_exploring(free_course, explore):
    """It flies by the law, but near its start it would hover for ever."""

    class Stuck:
        observation = "guided"

        def __init__(self):
            self.sims = None

        def __call__(self, observation):
            action = self.sims.law()
            x, start = self.sims.episodes.truth, self.sims.episodes.course(0).scene.depot
            gone = np.linalg.norm(x - start, axis=1)
            action[gone < 8] = 0.0
            return action

    stuck = Stuck()
    sims = simulations(free_course, 8)
    stuck.sims = sims
    pilot = by_policies([stuck], explore=explore)
    success, running = np.zeros(8, dtype=bool), np.ones(8, dtype=bool)
    while running.any():
        outcome = sims.step(pilot(sims))
        success |= running & outcome.success
        running &= ~(outcome.terminated | outcome.truncated)
    sims.close()
    assert success.mean() >= 0.75 if explore else not success.any()


def test_the_same_seed_explores_the_same_way(free_course):
    air = Disturbance(wind=2.0)
    flown = [fly_disturbed(free_course, Lazy(), air, flights=2, seed=3) for _ in range(2)]
    for one, other in zip(*(each.flights for each in flown), strict=True):
        assert (one.flight.trajectory.x == other.flight.trajectory.x).all()
    still = fly_disturbed(free_course, Lazy(), air, flights=2, seed=3, explore=False)
    assert (still.flights[0].flight.trajectory.x[-1] != one.flight.trajectory.x[-1]).any()
