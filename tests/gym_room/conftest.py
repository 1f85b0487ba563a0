"""Environments of Gymnasium, closed after each test."""

from __future__ import annotations

import gymnasium
import pytest

import mjcollect.gym  # noqa: F401  (registers the ids)


@pytest.fixture
def closing(request):
    """Closes what it is given after the test."""

    def later(environment):
        request.addfinalizer(environment.close)
        return environment

    return later


@pytest.fixture
def make(closing, blocked_course):
    """`gymnasium.make` on the blocked segment of the corridor, whose guidance is built once."""

    def one(name="mjcollect/Segment-v0", course=None, **options):
        options.setdefault("course", blocked_course if course is None else course)
        return closing(gymnasium.make(name, **options))

    return one


@pytest.fixture
def make_vec(closing, blocked_course):
    """`gymnasium.make_vec` on the same segment, by default on the batched simulation."""

    def many(num_envs, mode="vector_entry_point", **options):
        options.setdefault("course", blocked_course)
        return closing(
            gymnasium.make_vec(
                "mjcollect/Segment-v0", num_envs=num_envs, vectorization_mode=mode, **options
            )
        )

    return many
