"""Moves boxes to and fro along paths, some in each of N simulations.

They are no part of a scene's MuJoCo model. Whatever decides knows where they are and how fast, and
the sweep of `contact.contacts` in the box's frame judges who touches one. Guidance does not know of
them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjcollect.flight.contact import contacts
from mjcollect.flight.world import World
from mjcollect.geometry.boxes import FAR, nearest_point_offset
from mjcollect.geometry.compiled import Array, Bools

SIDE = 40.0  # metres; each box that is drawn is a cube with sides of this length
SWING = 60.0  # metres; its centre moves this far to both sides of the way
LEAST_WAY = 200.0  # metres; shorter segments are given no box
SIGHT = 150.0  # metres from its surface within which a box is seen
SHOWN = 2  # So many boxes are shown to a policy, the nearest ones.
STEPS = np.arange(48) / 8  # A box's motion is foretold for these seconds.
MET = 20.0  # metres; a box that a body passes at this distance shows half as much.
SOON = (0.5, 1.5)  # A policy is shown where a box will be in so many seconds.


class MovingBoxes:
    """Knows where the boxes are, B in each simulation; a speed of 0 means that there is none.

    Attributes:
        speed: (N, B) m/s. half: (N, B, 3) half the size (m). told: whether decisions know the
            paths, turns and all; else they take a box's velocity for constant.
    """

    def __init__(self, count: int, boxes: int = 1, corners: int = 2) -> None:
        """Prepares for `count` simulations of `boxes` each, on paths of `corners`, none yet."""
        self.path, self.half = np.zeros((count, boxes, corners, 3)), np.zeros((count, boxes, 3))
        self.phase, self.speed = np.zeros((count, boxes)), np.zeros((count, boxes))
        self.time, self.told = np.zeros(count), False

    def begin(
        self, which: NDArray[np.intp], start: Array, goal: Array, speed: Array,
        rng: np.random.Generator, turned: float = 0.0,
    ) -> None:  # fmt: skip
        """Draws cubes anew for episodes from `start` to `goal` (n, 3) in `which` (n,).

        Args:
            speed: (n, B) in m/s. turned: greatest angle of their paths to straight across (rad).
        """
        n, boxes = speed.shape
        along = (goal - start)[:, None]
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        side = np.cross(along, [0.0, 0.0, 1.0]) + np.array([1e-6, 0.0, 0.0])  # vertical: along x
        side = side / np.linalg.norm(side, axis=-1, keepdims=True)
        middle = start[:, None] + (0.35 + 0.3 * rng.random((n, boxes, 1))) * along
        angle = turned * (2 * rng.random((n, boxes, 1)) - 1)
        across = np.cos(angle) * side + np.sin(angle) * along / np.maximum(length, 1e-9)
        self.path[which] = np.stack([middle - SWING * across, middle + SWING * across], axis=2)
        self.half[which] = SIDE / 2
        self.phase[which] = rng.random((n, boxes))
        self.speed[which] = speed * (length[:, :, 0] >= LEAST_WAY)
        self.time[which] = 0.0

    def centres(self, seconds: Any = 0.0) -> Array:
        """Returns the centres (N, B, ..., 3) of the boxes `seconds` (...) after the slot's start.

        A box starts at its phase, a share of its whole way there and back.
        """
        seconds = np.asarray(seconds)
        more = (...,) + (None,) * seconds.ndim
        piece = np.diff(self.path, axis=2)
        size = np.linalg.norm(piece, axis=3)
        marks = np.concatenate([np.zeros_like(size[:, :, :1]), np.cumsum(size, axis=2)], axis=2)
        length = np.maximum(marks[:, :, -1], 1e-9)[more]
        gone = self.phase[more] * 2 * length
        gone = gone + self.speed[more] * (self.time[:, None][more] + seconds)
        at = length - np.abs(gone % (2 * length) - length)
        where = self.path[:, :, 0][(slice(None), slice(None), *(None,) * seconds.ndim)]
        for k in range(piece.shape[2]):
            part = np.clip(at - marks[:, :, k][more], 0.0, size[:, :, k][more])
            share = part / np.maximum(size[:, :, k], 1e-9)[more]
            step = piece[:, :, k][(slice(None), slice(None), *(None,) * seconds.ndim)]
            where = where + share[..., None] * step
        return np.asarray(where)

    @property
    def boxes(self) -> Array:
        """Returns the boxes (N, B, 2, 3) at the slot's start, `EMPTY_BOX` where there is none."""
        centre = self.centres()
        there = self.speed[:, :, None, None] > 0.0
        both = np.stack([centre - self.half, centre + self.half], axis=2)
        return np.asarray(np.where(there, both, FAR))

    @property
    def velocities(self) -> Array:
        """Returns the velocities (N, B, 3) in m/s at the slot's start."""
        return (self.centres(1e-3) - self.centres()) / 1e-3

    def ahead(self) -> Array:
        """Returns how far (N, B, T, 3) in m each box is believed to be after each of STEPS."""
        if self.told:
            return self.centres(STEPS) - self.centres()[:, :, None]
        return np.asarray(self.velocities[:, :, None] * STEPS[:, None])

    def seen(self, q: Array, v: Array, v_max: Array) -> Array:
        """Returns (N, SHOWN, 4, 3) of the nearest boxes, as seen from q, v (N, 3).

        They are the way to a box as nearness times a unit vector, the same in the seconds SOON if
        both go on as they do, and the box's velocity in units of v_max. Nearness is 1 at a surface
        and 0 from SIGHT on; a box out of sight is all zero.
        """
        boxes, velocity, shown = self.boxes, self.velocities, min(SHOWN, self.speed.shape[1])
        out = np.zeros((len(q), SHOWN, 2 + len(SOON), 3))
        now = self._near(q[:, None], boxes)
        nearness = np.linalg.norm(now, axis=2) * (self.speed > 0.0)
        first = np.argsort(-nearness, axis=1, kind="stable")[:, :shown, None]

        def chosen(values: Array) -> Array:
            return np.take_along_axis(values, first, axis=1)

        there = chosen(nearness[:, :, None]) > 0.0
        for k, seconds in enumerate((0.0, *SOON)):
            moved = q[:, None] + seconds * (v[:, None] - velocity)
            out[:, :shown, k] = np.where(there, chosen(self._near(moved, boxes)), 0.0)
        out[:, :shown, -1] = np.where(there, chosen(velocity) / v_max[:, None], 0.0)
        return out

    def met(self, places: Array) -> Array:
        """Returns (N, SHOWN, H, 4) of where bodies would come nearest to boxes, nearest box first.

        It holds the direction of the box's centre then, times a closeness, and e^(-t / SOON[-1]) at
        that time t. Closeness is 1 inside of a box and at its surface, and 1/2 at MET from it.
        Without a box all is zero.

        Args:
            places: (N, H, T, 3) m, where bodies would be after each of STEPS, in H manners.
        """
        shown = min(SHOWN, self.speed.shape[1])
        out = np.zeros((len(places), SHOWN, places.shape[1], 4))
        centre = (self.centres()[:, :, None] + self.ahead())[:, :, None]
        seen, half = places[:, None] - centre, self.half[:, :, None, None]
        scaled = seen / np.maximum(half, 1e-9)  # of a box that is not there half is 0
        first = np.linalg.norm(scaled, axis=4).argmin(axis=3)[..., None]
        seen = np.take_along_axis(seen, first[..., None], axis=3)[..., 0, :]
        half = half[..., 0, :]
        gap = np.linalg.norm(np.clip(seen, -half, half) - seen, axis=3, keepdims=True)
        size = np.maximum(np.linalg.norm(seen, axis=3, keepdims=True), 1e-9)
        way = -seen / size / (1.0 + gap / MET)
        found = np.concatenate([way, np.exp(-STEPS[first] / SOON[-1])], axis=3)
        found = found * (self.speed > 0.0)[:, :, None, None]
        gap = np.where(self.speed > 0.0, gap.min(axis=(2, 3)), np.inf)
        order = np.argsort(gap, axis=1, kind="stable")[:, :shown]
        out[:, :shown] = np.take_along_axis(found, order[..., None, None], axis=1)
        return out

    @staticmethod
    def _near(q: Array, boxes: Array) -> Array:
        """Returns the nearness (N, B, 3) of boxes (N, B, 2, 3) to points (N, B or 1, 3)."""
        offset = nearest_point_offset(q, boxes)
        distance = np.maximum(np.linalg.norm(offset, axis=2, keepdims=True), 1e-9)
        return np.asarray(offset / distance * np.maximum(1.0 - distance / SIGHT, 0.0))

    def touched(self, world: World, whole: Array) -> Bools:
        """Returns which physics steps (N, n) of a slot's path (N, n + 1, 3) touch a box."""
        here, seconds = self.boxes, world.step * np.arange(whole.shape[1])
        drift = self.centres(seconds) - self.centres()[:, :, None]
        touch = np.zeros((len(whole), whole.shape[1] - 1), dtype=bool)
        for b in range(here.shape[1]):
            one = world.with_boxes(here[:, b : b + 1])
            touch = contacts(one, whole - drift[:, b], touch)
        return touch

    def move(self, seconds: float) -> None:
        """Lets a slot of `seconds` pass."""
        self.time += seconds

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole state."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state of `state_dict`."""
        for name, value in state.items():
            setattr(self, name, value if name == "told" else np.array(value))
