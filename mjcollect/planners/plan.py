"""Defines planners, their plans for the next slots, and which plans can be flown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes
from mjcollect.envs.recording import Flight, record
from mjcollect.flight.contact import contacts, leaves_bounds
from mjcollect.flight.straight_line import roll_out
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array
from mjcollect.planners.foresight import Foresight


class Planner(Protocol):
    """Is a pilot that plans, for one episode."""

    def action(self, episodes: Episodes) -> Array:
        """Returns the action (3,) in units of a_max, of norm <= 1, for the next slot."""

    def summary(self) -> str:
        """Returns a sentence that says how the decisions were made."""


def fly_planner(course: Course, planner: Planner) -> Flight:
    """Flies `course` from rest exactly at its start by a planner, without the shield."""
    return record(course, lambda _, task: planner.action(task.episodes))


@dataclass(frozen=True)
class Plan:
    """Holds the states at the starts of M slots, from the present state to rest.

    Attributes:
        q, v: (M + 1, 3) positions in m and velocities in m/s; the last velocity is zero.
        slot: duration of a slot (s). arrives: whether the plan ends in the target's ball.
    """

    q: Array
    v: Array
    slot: float
    arrives: bool

    @property
    def slots(self) -> int:
        """Returns the number of slots M."""
        return len(self.q) - 1

    @property
    def a(self) -> Array:
        """Returns the accelerations (M, 3) in m/s^2, each held for one slot."""
        return np.asarray(np.diff(self.v, axis=0) / self.slot)

    def later(self, q: Array, v: Array) -> Plan:
        """Returns the plan without its first slot, which led to the state q, v (3,).

        A plan that does not arrive gets one more slot at rest at its end, so it never runs out.
        """
        held = [] if self.arrives else [-1]
        index = [*range(2, self.slots + 1), *held]
        return Plan(
            np.concatenate([q[None], self.q[index]]),
            np.concatenate([v[None], self.v[index]]),
            self.slot,
            self.arrives,
        )


def is_flyable(world: World, plan: Plan, foresight: Foresight | None = None) -> bool:
    """Returns whether a plan keeps both limits, touches no box and stays in the bounds.

    Args:
        world: world of one scene. plan: the plan to check. foresight: what knows of moving boxes.
    """
    a = plan.a
    path, speeds = roll_out(world, plan.q[0], plan.v[0], a)
    if np.any(np.linalg.norm(a, axis=1) > world.a_max[0]):
        return False
    if np.any(np.linalg.norm(speeds[:, -1], axis=1) > world.v_max[0]):
        return False
    sensed = np.zeros(path[:, 1:].shape[:2], dtype=bool)
    if contacts(world, path, sensed).any() or leaves_bounds(world, path).any():
        return False
    return foresight is None or not foresight.touches(world, path)
