"""Wraps one fleet as a PettingZoo environment in which all UAVs act at once.

This is the only file that needs PettingZoo and Gymnasium.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course, StartKind
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import at_home, fleet_ends, uav_names
from mjcollect.geometry.compiled import Bools

try:
    from gymnasium.spaces import Box
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        "FleetParallelEnv needs PettingZoo and Gymnasium: pip install 'mjcollect[fleet]'"
    ) from error

Observations = dict[str, np.ndarray]
Infos = dict[str, dict[str, bool]]


class FleetParallelEnv(ParallelEnv):
    """Wraps one fleet of M UAVs as a `ParallelEnv` with the agents uav_0 to uav_{M-1}.

    An observation is float32 (D,), an action float32 (3,) in [-1, 1]. A UAV that has finished its
    course is terminated and leaves `agents`; it waits at rest while the others fly on. A crash
    terminates all, and a step limit truncates all, as `fleet.episode.fleet_ends` has it. Infos hold
    `success` (the course is finished), `crashed` and `shielded` (the shield changed the command).

    Attributes:
        possible_agents, agents: names of all UAVs, and of those that still fly.
        simulations: the simulation of the fleet.
    """

    metadata = {"name": "mjcollect_fleet_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(
        self,
        courses: Sequence[Course],
        *,
        rules: Rules | None = None,
        start: StartKind = "point",
        seed: int = 0,
    ) -> None:
        """Prepares the simulation of a fleet.

        Args:
            courses: M courses, one for each UAV, as `fleet.episode.courses` makes them.
            rules: observation, reward and shield.
            start: kind of start states, as `Course.starts`
                takes it. seed: of the start states.
        """
        m = len(courses)
        rng = np.random.default_rng(seed)
        self.simulations = Simulations(
            courses, m, rules=rules, start=start, rng=rng, threads=1, uavs=m
        )
        self.possible_agents = uav_names(m)
        self.agents: list[str] = []
        size = self.simulations.observe(np.arange(1)).shape[1]
        self.observation_spaces = {
            agent: Box(-np.inf, np.inf, (size,), np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: Box(-1.0, 1.0, (3,), np.float32) for agent in self.possible_agents
        }

    def observation_space(self, agent: str) -> Box:
        """Returns the space of an agent's observations, the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Returns the space of an agent's actions, the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Begins a new episode of all UAVs; a seed fixes this start and all later ones."""
        if seed is not None:
            self.simulations.seed(seed)
        self.simulations.reset()
        self.agents = list(self.possible_agents)
        no = np.zeros(len(self.agents), dtype=bool)
        return self._observations(), self._infos(success=no, crashed=no, shielded=no)

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Flies one slot; what it returns is of the UAVs that were in `agents` before.

        Args:
            actions: (3,) of each UAV in `agents`; others are ignored.

        Raises:
            RuntimeError: the episode has ended or not begun.
            ValueError: an action is missing.
        """
        if not self.agents:
            raise RuntimeError("agents: none is flying: call reset() to begin an episode")
        raw = np.zeros((len(self.possible_agents), 3))
        for row, agent in enumerate(self.possible_agents):
            if agent in self.agents:
                if agent not in actions:
                    raise ValueError(f"actions: {agent!r}: is missing; give each of agents one")
                raw[row] = actions[agent]
        outcome, episodes = self.simulations.step(raw), self.simulations.episodes
        home = at_home(outcome, episodes)
        terminated, truncated = fleet_ends(outcome, episodes, len(raw))
        terminations = self._flying((home | terminated).tolist())
        truncations = self._flying((~home & truncated).tolist())
        rewards, observations = self._flying(outcome.reward.tolist()), self._observations()
        crashed = outcome.slot.crashed
        infos = self._infos(success=outcome.success, crashed=crashed, shielded=outcome.shielded)
        ended = {agent for agent in self.agents if terminations[agent] or truncations[agent]}
        self.agents = [agent for agent in self.agents if agent not in ended]
        return observations, rewards, terminations, truncations, infos

    def close(self) -> None:
        """Stops MuJoCo's threads."""
        self.simulations.close()

    def _flying(self, values: Iterable[Any]) -> dict[str, Any]:
        """Returns those of M values, one for each UAV, that are of the UAVs in `agents`."""
        named = zip(self.possible_agents, values, strict=True)
        return {agent: value for agent, value in named if agent in self.agents}

    def _observations(self) -> Observations:
        return self._flying(self.simulations.observe().astype(np.float32))

    def _infos(self, **flags: Bools) -> Infos:
        rows = zip(*(values.tolist() for values in flags.values()), strict=True)
        return self._flying(dict(zip(flags, row, strict=True)) for row in rows)
