"""Flies a course by the rules of flight without MuJoCo, to see where a planner's commands lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.flight.straight_line import roll_out
from mjcollect.geometry.compiled import Array

Pilot = Callable[[Episodes], Array]


@dataclass(frozen=True)
class Rehearsal:
    """Holds the flight of a finished course.

    Attributes:
        commands: (N, 3) accelerations in m/s^2, as the rules of flight let them be flown.
        q: (N + 1, 3) positions in m at slot starts. ends: number of slots flown at each arrival.
    """

    commands: Array
    q: Array
    ends: tuple[int, ...]

    @property
    def slots(self) -> tuple[int, ...]:
        """Returns the number of slots of each segment."""
        return tuple(int(slots) for slots in np.diff([0, *self.ends]))

    @property
    def segments(self) -> list[Array]:
        """Returns the positions (M + 1, 3) in m of each segment, both stops included."""
        return [
            self.q[end - slots : end + 1] for end, slots in zip(self.ends, self.slots, strict=True)
        ]


def rehearse(course: Course, pilot: Pilot) -> Rehearsal | None:
    """Flies `course` from rest exactly at its start; returns None if it is not finished.

    Args:
        pilot: maps the episode to an action (3,) in units of a_max.
    """
    episodes = Episodes([course], 1, Rules(shield=False))
    episodes.reset(np.array([0]), course.scene.point(course.nodes[0])[None], np.zeros((1, 3)))
    sensed = np.zeros((1, course.scene.substeps), dtype=bool)
    commands, q, ends = [], [episodes.q[0].copy()], list[int]()
    while True:
        a = episodes.begin_slot(pilot(episodes)[None])
        path, speeds = roll_out(episodes.world, episodes.q[0], episodes.v[0], a)
        outcome = episodes.end_slot(path[:, 1:], speeds[:, -1], sensed)
        commands.append(a[0].copy())
        q.append(episodes.q[0].copy())
        if outcome.slot.arrived[0]:
            ends.append(len(commands))
        if outcome.success[0]:
            return Rehearsal(np.array(commands), np.array(q), tuple(ends))
        if outcome.terminated[0] or outcome.truncated[0]:
            return None
