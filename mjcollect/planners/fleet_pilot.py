"""Lets planners, which each know one episode, fly the UAVs of a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.disturbed import Pilot
from mjcollect.envs.episode import Episodes
from mjcollect.geometry.compiled import Array, Indices
from mjcollect.planners.plan import Planner


class EpisodeRow:
    """Shows one of N calm episodes as if it were the only one, which is what planners look at.

    Its target is counted from the first one of its own course.
    """

    disturbances = None

    def __init__(self, episodes: Episodes, row: int) -> None:
        """Shows episode `row`."""
        self._episodes, self._rows = episodes, slice(row, row + 1)

    @property
    def q(self) -> Array:
        """Returns the position (1, 3) in m."""
        return self._episodes.q[self._rows]

    @property
    def seen_v(self) -> Array:
        """Returns the velocity (1, 3) in m/s."""
        return self._episodes.seen_v[self._rows]

    @property
    def target(self) -> Indices:
        """Returns the index (1,) of the current target in the course."""
        episodes = self._episodes
        return np.asarray(episodes.target[self._rows] - episodes.targets.first[self._rows])

    def guidance_action(self) -> Array:
        """Returns the guidance law's action (1, 3) in units of a_max."""
        return self._episodes.guidance_action()[self._rows]

    def raw(self, action: Array) -> Array:
        """Returns an action (1, 3) in world axes as it is: planners fly no framed observation."""
        return action


def by_planners(planners: Sequence[Planner]) -> Pilot:
    """Returns a pilot of a fleet from the planner of each UAV."""

    def pilot(sims: Simulations) -> Array:
        action = np.zeros((sims.count, 3))
        for row, planner in enumerate(planners):
            if not sims.episodes.home[row]:
                action[row] = planner.action(cast(Episodes, EpisodeRow(sims.episodes, row)))
        return action

    return pilot
