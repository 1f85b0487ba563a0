"""A plan: commands for the slots to come, and whether the rules of flight let it be flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjcollect.flight.contact import contacts, leaves_bounds
from mjcollect.flight.straight_line import roll_out
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array


@dataclass(frozen=True)
class Plan:
    """States at slot starts, ending at rest.

    Attributes:
        q, v: (M + 1, 3) m and m/s, the present state first; v ends with zeros.
        slot: seconds. arrives: it ends in the target's ball.
    """

    q: Array
    v: Array
    slot: float
    arrives: bool

    @property
    def slots(self) -> int:
        """Slots to fly, M."""
        return len(self.q) - 1

    @property
    def a(self) -> Array:
        """Accelerations (M, 3) in m/s^2, each held for a slot."""
        return np.asarray(np.diff(self.v, axis=0) / self.slot)

    def later(self, q: Array, v: Array) -> Plan:
        """What is left after its first slot, from the state (3,), (3,) it led to.

        A plan that does not arrive stays where it ends for a slot more, so that it never runs out.
        """
        held = [] if self.arrives else [-1]
        index = [*range(2, self.slots + 1), *held]
        return Plan(
            np.concatenate([q[None], self.q[index]]),
            np.concatenate([v[None], self.v[index]]),
            self.slot,
            self.arrives,
        )


def is_flyable(world: World, plan: Plan) -> bool:
    """Whether the plan keeps all limits and its path neither touches a box nor leaves the bounds.

    Args:
        world: of the one scene.
    """
    a = plan.a
    path, speeds = roll_out(world, plan.q[0], plan.v[0], a)
    if np.any(np.linalg.norm(a, axis=1) > world.a_max[0]):
        return False
    if np.any(np.linalg.norm(speeds[:, -1], axis=1) > world.v_max[0]):
        return False
    sensed = np.zeros(path[:, 1:].shape[:2], dtype=bool)
    return not (contacts(world, path, sensed).any() or leaves_bounds(world, path).any())
