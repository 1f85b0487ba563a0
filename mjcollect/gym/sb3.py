"""Hands a vector environment to Stable-Baselines3, which has a vector interface of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from mjcollect.gym.vector_env import FlightVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError(
        "FlightVecEnv needs Stable-Baselines3: pip install stable-baselines3"
    ) from error

Row = dict[str, Any]


class FlightVecEnv(VecEnv):
    """Wraps a `FlightVectorEnv` that resets in the same step, as Stable-Baselines3 expects.

    Infos of an episode's last slot also hold `terminal_observation`, `TimeLimit.truncated` and
    `is_success`, whose mean Stable-Baselines3 logs.
    """

    def __init__(self, env: FlightVectorEnv) -> None:
        """Wraps `env`.

        Raises:
            TypeError: it is anything else, as Gymnasium's wrappers are.
            ValueError: it does not reset in the same step.
        """
        if not isinstance(env, FlightVectorEnv):
            raise TypeError(
                f"env: {env}: must be a FlightVectorEnv, as gymnasium.make_vec returns it; wrap it "
                "in wrappers of Stable-Baselines3, such as VecMonitor"
            )
        if env.autoreset_mode is not env.autoreset_mode.SAME_STEP:
            raise ValueError(f"autoreset_mode: {env.autoreset_mode}: must be SAME_STEP")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begins all episodes; what `seed` and `set_options` were given is used once.

        Raises:
            ValueError: only some flights were given an option.
        """
        names = sorted({name for options in self._options for name in options})
        if any(sorted(options) != names for options in self._options):
            raise ValueError(f"options: {names}: must be given to all flights or to none")
        starts = {name: np.array([each[name] for each in self._options]) for name in names}
        observations, infos = self.env.reset(seed=self._seeds[0], options=starts)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = in_rows(infos)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions (N, 3) of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Row]]:
        """Flies one slot and returns observations, rewards, dones and a dictionary each."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        rows, done = in_rows(infos), terminated | truncated
        for index in np.flatnonzero(done).tolist():
            self.reset_infos[index] = rows[index]
            last = {name: values[index].item() for name, values in named(infos["final_info"])}
            rows[index] = last | {
                "terminal_observation": infos["final_obs"][index],
                "is_success": last["success"],
            }
        for row, cut_off in zip(rows, truncated.tolist(), strict=True):
            row["TimeLimit.truncated"] = cut_off
        return observations, rewards.astype(np.float32), done, rows

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns a picture (H, W, 3) uint8 of each flight."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of the environment, once for each flight asked for."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the environment, which all flights share."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of the environment once, and returns its answer for each flight asked for.

        An answer that is no array (N, ...) is the same for all.
        """
        answer = getattr(self.env, method_name)(*method_args, **method_kwargs)
        each = isinstance(answer, np.ndarray) and answer.shape[:1] == (self.num_envs,)
        return [answer[k] if each else answer for k in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """Returns that no flight is wrapped."""
        return [False for _ in self._get_indices(indices)]


def named(infos: Row) -> list[tuple[str, np.ndarray]]:
    """Returns the infos of all flights, without masks and what only ended episodes have."""
    return [(key, value) for key, value in infos.items() if not key.startswith(("_", "final_"))]


def in_rows(infos: Row) -> list[Row]:
    """Returns infos as a dictionary of each flight."""
    names, columns = zip(*named(infos), strict=True)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [dict(zip(names, row, strict=True)) for row in rows]
