"""Lessons of the MPC: they depend on their number alone, say what it would do, and go on."""

import numpy as np
import pytest

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.observation import FRAMED
from mjcollect.flight.disturbance import Disturbance
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import TrainedPolicy
from train.jobs import lessons
from train.jobs.lessons import School, fly_chunk, give_lessons, load_lessons


@pytest.fixture
def school(corridor, tmp_path, monkeypatch):
    """Its segments are those of the corridor, its flights few."""
    monkeypatch.setattr(lessons, "draw_segment", lambda _, number: (corridor, (0, 1), number))
    monkeypatch.setattr(lessons, "SEGMENTS", 2)
    monkeypatch.setattr(lessons, "FLIGHTS", 1)
    for number in range(2):
        Course.segment(corridor, (0, 1), number, tmp_path).save_guidance(tmp_path)
    rules, air = Rules("robust", "careful", 0.97), Disturbance(wind=3.0, gain=0.2, delay=0.1)
    return School(0, (0, 1), tmp_path, rules, 0.5, air, None)


def test_a_chunk_depends_on_its_number_alone(school, tmp_path):
    folders = [tmp_path / name for name in ("one", "other")]
    for folder in folders:
        folder.mkdir()
    counts = [fly_chunk(school, folders[0], chunk) for chunk in (0, 1)]
    assert [fly_chunk(school, folders[1], chunk) for chunk in (1, 0)] == counts[::-1]
    loaded = [load_lessons(folder, sum(counts) - 3) for folder in folders]
    for one, other in zip(*loaded, strict=True):
        assert len(one) == sum(counts) - 3
        assert (one == other).all()
    (folders[0] / "0.npz").write_bytes((folders[0] / "1.npz").read_bytes())
    assert fly_chunk(school, folders[0], 0) == counts[1], "what is there is kept"


def test_the_teacher_that_flies_alone_does_what_it_says(school, monkeypatch):
    """Without noise the flights arrive, so the actions are raw ones, in the observation's frame."""
    monkeypatch.setattr(lessons, "TEACHER_NOISE", (0.0,))
    ended = []

    class Watched(lessons.Simulations):
        def step(self, action):
            outcome = super().step(action)
            if outcome.terminated[0] or outcome.truncated[0]:
                ended.append(bool(outcome.success[0]))
            return outcome

    monkeypatch.setattr(lessons, "Simulations", Watched)
    assert school.rules.observation in FRAMED
    rng = np.random.default_rng(0)
    for _ in range(4):
        for seen, action in lessons.fly_segment(school, rng):
            assert seen.dtype == np.float32
            assert np.linalg.norm(action) <= 1.0 + 1e-6
    assert ended == [True] * 4


def test_a_policy_flies_and_the_mpc_says_what_it_would_do(school, tmp_path, monkeypatch):
    file = tmp_path / "policy.safetensors"
    TrainedPolicy(make_actor(62, 8), "path").save(file)
    monkeypatch.setattr(lessons, "POLICY_FLIES", 1.0)
    monkeypatch.setattr(lessons, "POLICY_NOISE", (0.0,))
    object.__setattr__(school, "policy", file)
    policy, flown = TrainedPolicy.load(file), []

    class Watched(lessons.Simulations):
        def step(self, action):
            wanted = policy(self.observe().astype(np.float32)[:, :62])
            flown.append(np.allclose(action, wanted, atol=1e-6))
            return super().step(action)

    monkeypatch.setattr(lessons, "Simulations", Watched)
    given = [action for _, action in lessons.fly_segment(school, np.random.default_rng(0))]
    assert flown
    assert all(flown)
    assert np.linalg.norm(given, axis=1).max() > 0.9


def test_a_stopped_school_goes_on(school, tmp_path, monkeypatch):
    """Processes of their own do not see this test's scenes, so threads stand in for them."""
    from concurrent.futures import ThreadPoolExecutor

    monkeypatch.setattr(lessons, "importing_pool", lambda _: ThreadPoolExecutor(1))
    monkeypatch.setattr(lessons, "AT_ONCE", 2)
    folder = tmp_path / "lessons"
    flights = give_lessons(school, folder, 150, workers=1)
    first = next(flights)
    flights.close()
    times = {file: file.stat().st_mtime_ns for file in folder.iterdir()}
    counts = list(give_lessons(school, folder, 150, workers=1))
    assert counts[0] == first
    assert sum(counts) >= 150
    assert all(file.stat().st_mtime_ns == time for file, time in times.items())
    assert len(load_lessons(folder, 150)[1]) == 150
