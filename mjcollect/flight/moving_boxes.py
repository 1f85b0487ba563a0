"""Moves boxes to and fro across the way, one in each of N simulations.

They are no part of a scene's MuJoCo model. Whatever decides knows where they are, and the sweep of
`contact.contacts` in the box's frame judges who touches one. Guidance does not know of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.contact import contacts
from mjcollect.flight.world import World
from mjcollect.geometry.boxes import EMPTY_BOX, nearest_point_offset
from mjcollect.geometry.compiled import Array, Bools

SIDE = 40.0  # metres; each box is a cube with sides of this length
SWING = 60.0  # metres; its centre moves this far to both sides of the way
LEAST_WAY = 200.0  # metres; shorter segments are given no box
SIGHT = 150.0  # metres from its surface within which a box is seen


class MovingBoxes:
    """Knows where the boxes are; a speed of 0 means that there is none.

    Attributes:
        speed: (N,) m/s.
    """

    def __init__(self, count: int) -> None:
        """Prepares for `count` simulations, none of which has a box yet."""
        self._middle, self._across = np.zeros((count, 3)), np.zeros((count, 3))
        self._phase, self.speed, self._time = np.zeros(count), np.zeros(count), np.zeros(count)

    def begin(
        self, which: NDArray[np.intp], start: Array, goal: Array, speed: Array,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Draws boxes anew for episodes from `start` to `goal` (n, 3) in `which` (n,).

        Args:
            speed: (n,) in m/s.
        """
        along = goal - start
        length = np.linalg.norm(along, axis=1, keepdims=True)
        side = np.cross(along, [0.0, 0.0, 1.0]) + np.array([1e-6, 0.0, 0.0])  # vertical: along x
        self._middle[which] = start + (0.35 + 0.3 * rng.random((len(which), 1))) * along
        self._across[which] = side / np.linalg.norm(side, axis=1, keepdims=True)
        self._phase[which] = rng.random(len(which))
        self.speed[which] = speed * (length[:, 0] >= LEAST_WAY)
        self._time[which] = 0.0

    def centres(self, seconds: float = 0.0) -> Array:
        """Returns the centres (N, 3) of the boxes `seconds` after the present slot's start."""
        turns = self._phase + self.speed * (self._time + seconds) / (4 * SWING)
        swing = SWING * (4 * np.abs((turns + 0.25) % 1.0 - 0.5) - 1.0)
        return self._middle + swing[:, None] * self._across

    @property
    def boxes(self) -> Array:
        """Returns the boxes (N, 1, 2, 3) at the slot's start, `EMPTY_BOX` where there is none."""
        centre, half = self.centres()[:, None, None], np.array([[-SIDE / 2], [SIDE / 2]])
        there = self.speed[:, None, None, None] > 0.0
        return np.asarray(np.where(there, centre + half, EMPTY_BOX))

    def seen(self, q: Array, v_max: Array) -> Array:
        """Returns (N, 6) the nearness of boxes to q (N, 3), a vector towards each, and velocities.

        Nearness is 1 at a surface and 0 from SIGHT on; velocity is in units of v_max (N, 1).
        """
        offset = nearest_point_offset(q[:, None], self.boxes)[:, 0]
        distance = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
        there = (self.speed[:, None] > 0.0) & (distance < SIGHT)
        near = np.where(there, offset / distance * (1.0 - distance / SIGHT), 0.0)
        velocity = (self.centres(1e-3) - self.centres()) / 1e-3 / v_max
        return np.concatenate([near, np.where(there, velocity, 0.0)], axis=1)

    def touched(self, world: World, whole: Array) -> Bools:
        """Returns which physics steps (N, n) of a slot's path (N, n + 1, 3) touch a box."""
        here = self.boxes
        drift = [self.centres(k * world.step) - self.centres() for k in range(whole.shape[1])]
        still = np.zeros((len(whole), whole.shape[1] - 1), dtype=bool)
        return contacts(world._replace(boxes=here), whole - np.stack(drift, axis=1), still)

    def move(self, seconds: float) -> None:
        """Lets a slot of `seconds` pass."""
        self._time += seconds

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole state."""
        return {name: value.tolist() for name, value in vars(self).items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state of `state_dict`."""
        for name, value in state.items():
            setattr(self, name, np.array(value))
