"""Courses of a fleet in the yard, and its environments, closed after each test."""

from __future__ import annotations

import pytest
from fleet_yard import YARD

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import environment_of
from mjcollect.envs.episode import Rules
from mjcollect.fleet.dm_env import FleetTask
from mjcollect.fleet.episode import courses
from mjcollect.fleet.torchrl_env import FleetEnv

TOURS = ((0, 1), (2,), (3,))


@pytest.fixture(scope="session")
def fleet() -> tuple[Course, ...]:
    """Three courses, of which the last is the shortest by far."""
    return courses(YARD, TOURS)


@pytest.fixture(scope="session")
def alone() -> tuple[Course, ...]:
    """The course of a fleet of one."""
    return courses(YARD, [(), (0, 1, 2, 3)])


@pytest.fixture
def closing(request):
    """Closes what it is given after the test."""

    def later(environment):
        request.addfinalizer(environment.close)
        return environment

    return later


@pytest.fixture
def batched(closing):
    """FleetEnv of so many fleets."""

    def make(courses, fleets=1, **kwargs):
        uavs = len(courses)
        sims = Simulations(courses, fleets * uavs, uavs=uavs, threads=1, **kwargs)
        return closing(FleetEnv(sims))

    return make


@pytest.fixture
def single(closing):
    """dm-control environment of a fleet."""

    def make(courses, rules=None, **kwargs):
        return closing(environment_of(FleetTask(courses, rules or Rules(), **kwargs), YARD))

    return make
