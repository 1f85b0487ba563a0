"""Holds what a teacher would do in many states; an actor learns from it beside its critic."""

from __future__ import annotations

from typing import Any

import torch


class Lessons:
    """Draws states and the teacher's actions there, from a random stream of its own.

    The actor's loss is then -q(S, pi(S)) + weight |pi(S') - A'|^2, each a mean over a batch, with
    states S' and actions A' of the teacher (Nair et al. 2018, without their filter).

    Attributes:
        observations: (L, D). actions: (L, 3) in units of a_max, in the frame of the observation.
        weight: of the distance in the actor's loss. batch: lessons for one update.
    """

    def __init__(
        self,
        observations: torch.Tensor,
        actions: torch.Tensor,
        *,
        weight: float,
        batch: int,
        seed: int,
    ) -> None:
        """Holds the lessons; `seed` starts the random stream."""
        self.observations, self.actions = observations, actions
        self.weight, self.batch = weight, batch
        self._generator = torch.Generator().manual_seed(seed)

    def sample(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the observations and actions for `count` updates, (count * batch, ...)."""
        size = (count * self.batch,)
        index = torch.randint(len(self.observations), size, generator=self._generator)
        index = index.to(self.observations.device)
        return self.observations[index], self.actions[index]

    def batches(self, count: int) -> list[tuple[torch.Tensor, ...]]:
        """Returns the same as `count` pairs (batch, D) and (batch, 3)."""
        return list(zip(*(column.chunk(count) for column in self.sample(count)), strict=True))

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the random stream."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state of `state_dict`."""
        self._generator.set_state(state["generator"])
