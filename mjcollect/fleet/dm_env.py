"""Defines the dm-control environment of a fleet: M UAVs in one simulation, each on its own course.

`mjcollect.load("fleet", scene=..., uavs=3)` returns it. It steps bit for bit like one fleet of
`Simulations(..., uavs=M)`, and with one UAV it flies bit for bit like the task `mission`.
"""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control.rl import control
from dm_env import specs

from mjcollect.envs.course import Course, StartKind
from mjcollect.envs.dm_env import FlightTask, Physics, environment_of
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import courses, fleet_ends
from mjcollect.geometry.compiled import Array
from mjcollect.scene.scene import Scene


class FleetTask(FlightTask):
    """Defines the task of a fleet: each UAV flies its course, and all of them keep apart.

    One that has finished waits at rest and earns nothing until the last one is home.
    """

    def __init__(
        self,
        courses: Sequence[Course],
        rules: Rules,
        start: StartKind = "point",
        random: int | np.random.RandomState | None = None,
    ) -> None:
        """Sets up the task, with further arguments as in `FlightTask`.

        Args:
            courses: M courses, one for each UAV, as `fleet.episode.courses` makes them.

        Raises:
            ValueError: the kind of start is unknown.
        """
        super().__init__(courses[0], rules, start, random, others=courses[1:])

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Returns the spec of an action (3 M,): accelerations in units of a_max, in [-1, 1].

        They are those of the first UAV, then those of the second one, and so on. Actions are flat,
        as in dm-control's suites: an element for each actuator of the model, in the same order.
        """
        return specs.BoundedArray(
            (3 * len(self.courses),), np.float64, -1.0, 1.0, name="acceleration"
        )

    def get_observation(self, physics: Physics) -> collections.OrderedDict[str, Array]:
        """Returns the observation's named parts, each (M, d), a row for each UAV."""
        return collections.OrderedDict(self.episodes.observe())

    def get_reward(self, physics: Physics) -> float:
        """Returns the sum of all UAVs' rewards of the last slot; `outcome.reward` has each."""
        return float(self._last.reward.sum())

    def get_termination(self, physics: Physics) -> float | None:
        """Returns the final discount: 0 if terminated, 1 if truncated, None to go on.

        `fleet.episode.fleet_ends` says when the episode of a fleet ends.
        """
        terminated, truncated = fleet_ends(self._last, self.episodes, len(self.courses))
        if terminated[0]:
            return 0.0
        return 1.0 if truncated[0] else None


def make_environment(
    scene: Scene,
    tours: Sequence[Sequence[int]],
    *,
    observation: str = "guided",
    reward: str = "time",
    start: StartKind = "point",
    random: int | np.random.RandomState | None = None,
    shield: bool = True,
    environment_kwargs: dict[str, Any] | None = None,
) -> control.Environment:
    """Returns the dm-control environment of a fleet, with further arguments as `load` has them.

    Args:
        tours: each UAV's items in the order of visit, as `fleet.episode.courses` takes them.

    Raises:
        ValueError: a name is unknown. It also raises what `fleet.episode.courses` raises.
    """
    rules = Rules(observation, reward, shield=shield)
    # Built of the whole scene, the model has every item to look at.
    task = FleetTask(courses(scene, tours), rules, start, random)
    return environment_of(task, scene, environment_kwargs)
