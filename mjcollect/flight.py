"""The rules of flight, written once and vectorised over a leading batch axis of N simulations.

The single dm-control task (N = 1) and the batched environment call the same functions, so that
both fly by the same rules bit for bit. Accelerations are commands held for one slot. The rules
themselves are compiled, see `kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjcollect import kernels
from mjcollect.compiled import Indices, plain
from mjcollect.geometry import EMPTY_BOX, Array
from mjcollect.scene import Scene

Bools = NDArray[np.bool_]

BOUNDS_TOLERANCE = 1e-6  # metres; the body's centre may lie on the bounds


class World(NamedTuple):
    """Scene constants stacked over simulations. The leading axis is N, or 1 where all share one.

    Attributes:
        bounds: (N, 2, 3) m. boxes: (N, M, 2, 3) m, padded with boxes infinitely far away.
        v_max, a_max, radius: (N, 1) in m/s, m/s^2, m.
        slot, step: seconds of a slot and of a physics step, the same for all simulations.
        substeps: physics steps in a slot, n.
    """

    bounds: Array
    boxes: Array
    v_max: Array
    a_max: Array
    radius: Array
    slot: float
    step: float
    substeps: int

    @classmethod
    def stack(cls, scenes: Sequence[Scene]) -> World:
        """Stack one scene per simulation, or a single one shared by all.

        Raises:
            ValueError: scenes disagree on `slot` or `physics_step`.
        """
        first = scenes[0]
        for scene in scenes:
            if (scene.slot, scene.physics_step) != (first.slot, first.physics_step):
                raise ValueError(
                    f"scenes {first.name!r}, {scene.name!r}: slot {first.slot} and {scene.slot}, "
                    f"physics_step {first.physics_step} and {scene.physics_step}: simulations that "
                    "run side by side need the same slot and physics step"
                )
        most = max(len(scene.obstacles) for scene in scenes)
        boxes = np.broadcast_to(EMPTY_BOX, (len(scenes), max(most, 1), 2, 3)).copy()
        for index, scene in enumerate(scenes):
            boxes[index, : len(scene.obstacles)] = scene.obstacles

        def column(field: str) -> Array:
            return np.array([[getattr(scene, field)] for scene in scenes])

        return cls(
            bounds=np.stack([scene.bounds for scene in scenes]),
            boxes=boxes,
            v_max=column("v_max"),
            a_max=column("a_max"),
            radius=column("uav_radius"),
            slot=first.slot,
            step=first.physics_step,
            substeps=first.substeps,
        )

    def rows(self, which: NDArray[np.intp]) -> World:
        """The constants of the simulations `which` (n,) only."""
        if len(self.bounds) == 1:
            return self
        return self._replace(
            bounds=self.bounds[which],
            boxes=self.boxes[which],
            v_max=self.v_max[which],
            a_max=self.a_max[which],
            radius=self.radius[which],
        )


def project(world: World, v: Array, action: Array) -> Array:
    """Feasible acceleration nearest in spirit to a raw action, eq. (2)-(3).

    The action is scaled into the a_max ball, then v + a slot into the v_max ball. Because
    |v| <= v_max, the second step only shortens the change of velocity: both limits hold.

    Args:
        v: (N, 3) m/s, |v| <= v_max. action: (N, 3), 1 = a_max along an axis; not finite counts 0.

    Returns:
        (N, 3) accelerations in m/s^2.
    """
    a = np.empty(v.shape)
    kernels.project(world, plain(v), plain(action), a)
    return a


def resting_point(world: World, q: Array, v: Array) -> Array:
    """Where the body (N, 3) rests after one slot of a = -v / slot in n semi-implicit steps."""
    n = world.substeps
    return q + v * (world.slot * (n - 1) / (2 * n))


def slot_path(world: World, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Positions (N, n + 1, 3), the first is q, and last velocities (N, 3) of a slot.

    MuJoCo's semi-implicit Euler, eq. (2)-(3), for a body that touches nothing.

    Args:
        q, v, a: (N, 3) position, velocity and the acceleration held.
    """
    speeds = v[:, None] + a[:, None] * world.step * np.arange(1, world.substeps + 1)[:, None]
    path = q[:, None] + np.cumsum(speeds * world.step, axis=1)
    return np.concatenate([q[:, None], path], axis=1), speeds[:, -1]


def arrests(world: World, q: Array, v: Array, goal: Array, tolerance: Array) -> Bools:
    """Collection rule, eq. (5): whether this slot is flown as a = -v / slot to stop at the goal.

    True where one slot can stop the body and the stop lies within `tolerance` of the goal.

    Args:
        q, v, goal: (N, 3). tolerance: (N,) m.

    Returns:
        (N,) booleans.
    """
    return command(world, q, v, np.zeros_like(v), goal, tolerance)[1]


def command(
    world: World, q: Array, v: Array, action: Array, goal: Array, tolerance: Array
) -> tuple[Array, Bools]:
    """Acceleration (N, 3) for the next slot, and where (N,) it is the stop that collects."""
    a, stop = np.empty(v.shape), np.empty(len(v), dtype=bool)
    kernels.command(
        world, plain(q), plain(v), plain(action), plain(goal), plain(tolerance), a, stop
    )
    return a, stop


def shield(
    world: World, q: Array, v: Array, a: Array, stop: Bools, held: Array, left: Indices,
    acted: Bools,
) -> None:  # fmt: skip
    """Bend commands that leave no way to stop without touching anything, see `kernels.shield`.

    Args:
        q, v: (N, 3). a: (N, 3) m/s^2, feasible commands; changed where the shield acts.
        stop: (N,) whether they are the stop that collects; cleared where the shield acts.
        held, left: (N, 3), (N,) the backup of the slot before, and that of this one afterwards.
        acted: (N,) set to whether the command was changed.
    """
    kernels.shield(world, plain(q), plain(v), a, stop, held, left, acted)


def contacts(world: World, path: Array, sensed: Bools) -> Bools:
    """Which physics steps touch an obstacle: sensed by MuJoCo, or swept over by the body.

    The sensor describes the state before a step and can miss a graze between two states; the
    sweep is the exact distance of the straight piece between two states to every box.

    Args:
        path: (N, n + 1, 3), positions at the slot's start and after each physics step.
        sensed: (N, n), the contact sensor after each step.

    Returns:
        (N, n) booleans.
    """
    return _events(world, path, sensed)[0]


def leaves_bounds(world: World, path: Array) -> Bools:
    """Which positions (N, n, 3) lie outside the bounds, inclusive with 1e-6 m. Shape (N, n)."""
    whole = np.concatenate([path[:, :1], path], axis=1)
    return _events(world, whole, np.zeros(path.shape[:2], dtype=bool))[1]


def _events(
    world: World, path: Array, sensed: Bools, margin: float = BOUNDS_TOLERANCE
) -> tuple[Bools, Bools]:
    """`contacts` and `leaves_bounds` of a path (N, n + 1, 3)."""
    touch, outside = sensed.copy(), np.empty(sensed.shape, dtype=bool)
    kernels.events(world, plain(path), margin, touch, outside)
    return touch, outside


@dataclass(frozen=True)
class Slot:
    """What happened in one slot, each (N,); `first_event` is n where nothing ended the flight.

    Attributes:
        contact, outside: the body touched a box; its centre left the bounds.
        arrived: it came to rest at its target without either.
        first_event: index of the first physics step with a contact or out of bounds.
    """

    contact: Bools
    outside: Bools
    arrived: Bools
    first_event: NDArray[np.int64]

    @property
    def crashed(self) -> Bools:
        """Contact or out of bounds."""
        return self.contact | self.outside


def judge(
    world: World, start: Array, path: Array, sensed: Bools, stop: Bools,
    margin: float = BOUNDS_TOLERANCE,
) -> Slot:  # fmt: skip
    """Judge a slot from its physics steps.

    Args:
        start: (N, 3) position at the slot's start. path: (N, n, 3) positions after each step.
        sensed: (N, n) contact sensor after each step. stop: (N,) whether it flew the stop.
        margin: metres beyond the bounds that are still inside.
    """
    whole = np.concatenate([start[:, None], path], axis=1)
    touch, out = _events(world, whole, sensed, margin)
    event = touch | out
    first = np.where(event.any(axis=1), event.argmax(axis=1), path.shape[1])
    contact, outside = np.any(touch, axis=1), np.any(out, axis=1)
    return Slot(contact, outside, stop & ~contact & ~outside, first)
