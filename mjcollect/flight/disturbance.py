"""Disturbs flights by wind, gusts, actuator errors, position noise and moving boxes.

Wind, gusts and actuator errors change the acceleration of every physics step, and so MuJoCo's
controls: whether the air or the rotors accelerate the body is the same. The body is that of the
undisturbed task; only its controls and its observed position change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.disturbance_estimate import GUST_SECONDS, Estimate
from mjcollect.flight.moving_boxes import MovingBoxes
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array, Bools

REST_SPEED = 2.0  # m/s; a disturbed body that is slower within the tolerance has come to rest
STRENGTHS = ("wind", "gusts", "gain", "delay", "noise", "mover")  # fields of `Disturbance`
SPARED = 0.3  # chance with which varied disturbances are without a kind


@dataclass(frozen=True)
class Disturbance:
    """Says how strong disturbances are; all zero means that there are none.

    Raises:
        ValueError: a field is negative or not finite, or `gain` is not below 1.
    """

    wind: float = 0.0
    """Wind accelerates the body by this (m/s^2), level, in a direction drawn for each episode."""
    gusts: float = 0.0
    """Gusts accelerate it by this (m/s^2, standard deviation), wandering along each axis."""
    gain: float = 0.0
    """The acceleration flown is this share above or below the command, as each episode draws."""
    delay: float = 0.0
    """Commands come this late (s), in whole physics steps and at most a slot."""
    noise: float = 0.0
    """Each slot's observed position errs by this (m, standard deviation) along each axis."""
    mover: float = 0.0
    """A box moves to and fro across the way at this speed (m/s)."""
    boxes: int = 1
    """So many boxes move, each across a place of its own."""
    turned: float = 0.0
    """Their paths are turned by up to this angle from straight across (degrees)."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < (1.0 if field.name == "gain" else math.inf):
                least = "from 0 to below 1" if field.name == "gain" else "0 or more"
                raise ValueError(f"{field.name}: {value}: must be {least}")
        if self.boxes < 1:
            raise ValueError(f"boxes: {self.boxes}: must be at least 1; mover 0 is none")

    def times(self, share: float) -> Disturbance:
        """Returns the same kinds of disturbance at a share of their strength."""
        return replace(self, **{name: share * getattr(self, name) for name in STRENGTHS})


class Disturbances:
    """Draws and applies the disturbances of N simulations."""

    def __init__(
        self,
        level: Disturbance,
        count: int,
        rng: np.random.Generator,
        *,
        vary: bool = False,
        calm: Bools | None = None,
    ) -> None:
        """Prepares for `count` simulations.

        Args:
            level: how strong disturbances are.
            vary: `level` is the greatest; of every kind, each
                episode draws a share of it, uniform in [0, 1], or with the chance SPARED none.
            calm: (N,) where nothing disturbs.
        """
        self.level, self.count, self.rng, self.vary = level, count, rng, vary
        self.calm = np.zeros(count, dtype=bool) if calm is None else calm
        self._wind, self._gusts = np.zeros((count, 3)), np.zeros((count, 3))
        self._strength, self._gain = np.zeros((count, 1)), np.ones((count, 1))
        self._late, self._noise = np.zeros(count), np.zeros((count, 1))
        self._before = np.zeros((count, 3))  # the commands of the slot before
        self.movers = MovingBoxes(count, level.boxes)

    def begin(self, which: NDArray[np.intp], start: Array, goal: Array) -> None:
        """Draws anew for episodes from `start` to `goal` (n, 3) in the simulations `which` (n,)."""
        level, n = self.level, len(which)
        share = np.ones((6, n)) * ~self.calm[which]
        if self.vary:
            share *= self.rng.random((6, n)) * (self.rng.random((6, n)) >= SPARED)
        angle, sign = 2 * np.pi * self.rng.random(n), self.rng.choice([-1.0, 1.0], n)
        wind = level.wind * share[0]
        self._wind[which] = np.stack([wind * np.cos(angle), wind * np.sin(angle), 0 * wind], axis=1)
        self._strength[which, 0] = level.gusts * share[1]
        self._gusts[which] = self._strength[which] * self.rng.standard_normal((n, 3))
        self._gain[which, 0] = 1.0 + sign * level.gain * share[2]
        self._late[which] = level.delay * share[3]
        self._noise[which, 0] = level.noise * share[4]
        self._before[which] = 0.0
        if level.mover > 0.0:
            speed = np.tile((level.mover * share[5])[:, None], (1, level.boxes))
            if self.vary:  # Each episode has from one box on up to all of them.
                most = self.rng.integers(1, level.boxes + 1, n)
                speed *= np.arange(level.boxes) < most[:, None]
            turned = math.radians(level.turned)
            self.movers.begin(which, start, goal, speed, self.rng, turned)

    def truth(self, world: World) -> Estimate:
        """Returns what an all-knowing pilot would know: all but the gusts to come."""
        fading = math.exp(-world.slot / GUST_SECONDS)
        return Estimate(
            gain=self._gain - 1.0,
            push=self._wind + math.sqrt(fading) * self._gusts,
            late=self.late_steps(world)[:, None] * world.step,
            spread=self._strength * math.sqrt(1.0 - fading**2),
            blur=np.zeros((self.count, 1)),
        )

    def late_steps(self, world: World) -> Array:
        """Returns the whole physics steps (N,) by which commands come late."""
        return np.round(self._late / world.step)

    def controls(self, world: World, command: Array) -> Array:
        """Returns accelerations (N, n, 3) in m/s^2 of a slot's physics steps for commands (N, 3).

        Commands beyond a_max, which a speed beyond v_max may need, are shortened to it.
        """
        n = world.substeps
        size = np.linalg.norm(command, axis=1, keepdims=True)
        command = command * np.minimum(1.0, world.a_max / np.maximum(size, 1e-12))
        late = np.minimum(self.late_steps(world), n)[:, None, None]
        old = np.arange(n)[:, None] < late
        flown = np.where(old, self._before[:, None], command[:, None]) * self._gain[:, None]
        kept = math.exp(-world.step / GUST_SECONDS)
        fresh = self.rng.standard_normal((n, self.count, 3)) * math.sqrt(1.0 - kept**2)
        for k in range(n):
            self._gusts = kept * self._gusts + self._strength * fresh[k]
            flown[:, k] += self._wind + self._gusts
        self._before = command
        return np.asarray(flown)

    def seen(self, q: Array, which: NDArray[np.intp] | None = None) -> Array:
        """Returns observed positions for true ones (n, 3) of the simulations `which`, or of all."""
        noise = self._noise if which is None else self._noise[which]
        return np.asarray(q + noise * self.rng.standard_normal(q.shape))

    @property
    def last(self) -> Array:
        """Returns the commands (N, 3) of the last slot in m/s^2, shortened to a_max."""
        return self._before

    def state_dict(self) -> dict[str, Any]:
        """Returns all of the state but the level."""
        arrays = {name: value.tolist() for name, value in vars(self).items() if name[0] == "_"}
        return {
            **arrays, "movers": self.movers.state_dict(), "rng": self.rng.bit_generator.state,
        }  # fmt: skip

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state of `state_dict`."""
        self.rng.bit_generator.state = state["rng"]
        self.movers.load_state_dict(state["movers"])
        for name, value in state.items():
            if name not in ("rng", "movers"):
                setattr(self, name, np.array(value))
