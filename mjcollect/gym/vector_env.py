"""Wraps N flights, which MuJoCo steps on its own threads, as a Gymnasium vector environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjcollect.geometry.compiled import Array, Bools
from mjcollect.gym.flights import RENDER_MODES, Flights, Infos

if TYPE_CHECKING:
    from mjcollect.render.camera import Picture


class FlightVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Wraps N flights of a segment or a mission, each as `FlightEnv` has it.

    When an episode ends, then by `autoreset_mode`, as in Gymnasium's own vector environments:

    - `SAME_STEP` (default): the next one begins in the same step. The observation is that of the
      new start; the last one is in `infos["final_obs"]`, its infos in `infos["final_info"]`.
    - `NEXT_STEP`: the next step begins it, whatever the action, with reward 0.
    - `DISABLED`: the caller begins it, by `reset(options={"reset_mask": mask})`.

    One generator draws the starts of all flights.

    Attributes:
        flights: what flies, with the course and the simulations.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES]}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "segment",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        threads: int = 2,
        **options: Any,
    ) -> None:
        """Builds the course, once for all; further options are those of `Flights`.

        Args:
            num_envs: N.
            autoreset_mode: one of Gymnasium's modes, its name, or its value such as `SameStep`.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs: {num_envs}: must be at least 1")
        self.num_envs, self.render_mode = num_envs, render_mode
        named = AutoresetMode.__members__.get(str(autoreset_mode))
        try:
            self.autoreset_mode = named or AutoresetMode(autoreset_mode)
        except ValueError:
            names = ", ".join(AutoresetMode.__members__)
            raise ValueError(f"autoreset_mode: {autoreset_mode}: must be one of {names}") from None
        self.flights = Flights(
            num_envs, task=task, render_mode=render_mode, threads=threads, **options
        )
        self.metadata = {
            **self.metadata,
            "render_fps": self.flights.frames_per_second,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.flights.observation_space
        self.single_action_space = self.flights.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)  # and has not begun anew

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins episodes in all flights, or those of a mask; a seed fixes all starts from now on.

        Args:
            seed: of the starts.
            options: `reset_mask` (N,) says which flights begin anew; the rest may set the starts,
                as `Flights.begin` takes it.

        Raises:
            ValueError: the mask is not Boolean (N,), or a start is not as `Flights.begin` takes it.
        """
        super().reset(seed=seed)
        state = dict(options or {})
        mask = np.asarray(state.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask: {mask}: must be Boolean of shape ({self.num_envs},)")
        self.flights.begin(self.np_random, np.flatnonzero(mask), state)
        self._ended[mask] = False
        return self.flights.observe(), _masked(self.flights.infos(), mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Flies one slot with actions (N, 3).

        Raises:
            RuntimeError: an episode has ended, and autoreset is disabled.
        """
        waiting = self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise RuntimeError(
                f"flights {np.flatnonzero(waiting).tolist()} have ended: "
                "call reset(options={'reset_mask': mask}) to begin them anew"
            )
        outcome = self.flights.step(actions)
        reward, terminated, truncated = outcome.reward, outcome.terminated, outcome.truncated
        observations, infos = self.flights.observe(), self.flights.infos(outcome)
        if waiting.any():  # They wait for this step to begin anew.
            self._begin(waiting, observations, infos)
            going = ~waiting
            reward, terminated, truncated = reward * going, terminated & going, truncated & going
        ended, final = terminated | truncated, {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
        elif ended.any():
            final = _final(ended, observations, infos)
            self._begin(ended, observations, infos)
        everyone = np.ones(self.num_envs, dtype=bool)
        all_infos = {**final, **_masked(infos, everyone)}
        return observations, reward.copy(), terminated.copy(), truncated.copy(), all_infos

    def _begin(self, which: Bools, observations: np.ndarray, infos: Infos) -> None:
        """Begins the flights `which` (N,) anew, and writes that into their rows."""
        rows = np.flatnonzero(which)
        self.flights.begin(self.np_random, rows)
        observations[rows] = self.flights.observe(rows)
        for values in infos.values():
            values[rows] = 0

    def law(self) -> Array:
        """Returns the actions (N, 3) of the guidance law, the pilot that learns nothing."""
        return self.flights.simulations.law()

    def render(self) -> tuple[Picture, ...] | None:
        """Returns a picture (H, W, 3) uint8 of each flight, or None without a render mode.

        Raises:
            RenderError: there is no GL; the message says how to get it.
        """
        return None if self.render_mode is None else tuple(self.flights.pictures())

    def close_extras(self, **kwargs: Any) -> None:
        """Stops MuJoCo's threads and closes the renderer."""
        self.flights.close()


def _masked(infos: Infos, which: Bools) -> dict[str, Any]:
    """Returns infos with Gymnasium's masks, which say of whom each of them is."""
    return infos | {f"_{name}": which.copy() for name in infos}


def _final(ended: Bools, observations: np.ndarray, infos: Infos) -> dict[str, Any]:
    """Returns the last observations and infos of the episodes that `ended` (N,)."""
    last = np.full(len(ended), None, dtype=object)
    for row in np.flatnonzero(ended):
        last[row] = observations[row].copy()
    theirs = {name: np.where(ended, value, value.dtype.type()) for name, value in infos.items()}
    final = {"final_obs": last, "final_info": _masked(theirs, ended)}
    return final | {"_final_obs": ended.copy(), "_final_info": ended.copy()}
