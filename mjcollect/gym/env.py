"""Wraps one flight as a Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from mjcollect.geometry.compiled import Array
from mjcollect.gym.flights import RENDER_MODES, Flights, Infos

if TYPE_CHECKING:
    from mjcollect.render.camera import Picture


class FlightEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Wraps a segment or a mission, as `mjcollect/Segment-v0` and `mjcollect/Mission-v0`.

    An observation is float32 (D,), an action float32 (3,) in [-1, 1]: the acceleration in units of
    a_max. An episode terminates where the course is finished or a crash ends it, and is truncated
    at the course's own step limit. Infos are those of `Flights.infos`.

    Attributes:
        flights: what flies, with the course and the simulations.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES]}  # noqa: RUF012

    def __init__(
        self, task: str = "segment", *, render_mode: str | None = None, **options: Any
    ) -> None:
        """Builds the course; the options are those of `Flights`."""
        self.flights = Flights(1, task=task, render_mode=render_mode, **options)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.flights.frames_per_second}
        self.observation_space = self.flights.observation_space
        self.action_space = self.flights.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode; a seed fixes this start and all later ones.

        Args:
            seed: of the starts. options: may set the start, as `Flights.begin` takes it.
        """
        super().reset(seed=seed)
        self.flights.begin(self.np_random, state=options)
        return self.flights.observe()[0], _only(self.flights.infos())

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Flies one slot with an action (3,)."""
        outcome = self.flights.step(np.asarray(action)[None])
        return (
            self.flights.observe()[0],
            float(outcome.reward[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            _only(self.flights.infos(outcome)),
        )

    def law(self) -> Array:
        """Returns the action (3,) of the guidance law, the pilot that learns nothing."""
        return self.flights.simulations.law()[0]

    def render(self) -> Picture | None:
        """Returns a picture (H, W, 3) uint8 from behind the UAV, or None without a render mode.

        Raises:
            RenderError: there is no GL; the message says how to get it.
        """
        return None if self.render_mode is None else self.flights.pictures()[0]

    def close(self) -> None:
        """Closes the simulation and the renderer."""
        self.flights.close()


def _only(infos: Infos) -> dict[str, Any]:
    """Returns the infos of the only flight, as Python's own numbers."""
    return {name: values[0].item() for name, values in infos.items()}
