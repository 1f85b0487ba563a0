"""Fly policies once in the single dm-control environment and record every physics step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from tqdm import tqdm

from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import FlightTask, Physics, make_environment
from mjcollect.trajectory import Recorder, Trajectory

SILENT = 5.0  # seconds that a flight may take without a progress bar
Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Flight:
    """A recorded flight.

    Attributes:
        trajectory: every physics step, to the first contact if there was one.
        success: the course was finished. contacts: physics steps in contact.
        arrivals: seconds at which each leg's target was reached, as far as they were.
        shielded: for each slot flown, whether the shield changed the command. slot: its seconds.
    """

    trajectory: Trajectory
    success: bool
    contacts: int
    arrivals: tuple[float, ...]
    shielded: tuple[bool, ...]
    slot: float

    @property
    def shield_share(self) -> float:
        """Share of the slots in which the shield changed the command; 0 without a shield."""
        return _share(self.shielded)

    @property
    def shield_shares(self) -> list[float | None]:
        """The same for each leg reached, and that which was begun last; None: no slot of it."""
        ends = [round(seconds / self.slot) for seconds in self.arrivals]
        pairs = pairwise([0, *ends, len(self.shielded)])
        legs = [self.shielded[begin:end] for begin, end in pairs]
        return [_share(leg) if leg else None for leg in legs]


def _share(acted: Sequence[bool]) -> float:
    return sum(acted) / max(len(acted), 1)


Pilot = Callable[[np.ndarray, FlightTask], np.ndarray]


def fly(
    course: Course, policies: Sequence[Policy], observation: str = "guided", *, shield: bool = True
) -> Flight:
    """Fly `course` from rest exactly at its start, each leg by its policy, without a break.

    Args:
        policies: one per leg: observations (1, D) float32 -> actions (1, 3). shield: as `record`.
    """

    def pilot(flat: np.ndarray, task: FlightTask) -> np.ndarray:
        return policies[task.leg](flat[None])[0]

    return record(course, pilot, observation, shield=shield)


def fly_law(course: Course, *, shield: bool = True) -> Flight:
    """Fly `course` by the guidance law; `shield` as in `record`."""
    return record(course, lambda _, task: task.episodes.guidance_action()[0], shield=shield)


def record(
    course: Course, pilot: Pilot, observation: str = "guided", *, shield: bool = False
) -> Flight:
    """Fly `course` from rest exactly at its start, each slot's action (3,) by `pilot`.

    Args:
        pilot: flat observation (D,) float32 and task -> action (3,).
        shield: bend commands that leave no way to stop without touching anything.
    """
    environment = make_environment(course, observation=observation, shield=shield)
    task: FlightTask = environment.task
    physics: Physics = environment.physics
    scene = course.scene
    step = environment.reset()
    recorder = Recorder(physics.position(), physics.velocity(), scene.physics_step)
    success, contacts, slots = False, 0, 0
    arrivals: list[float] = []
    shielded: list[bool] = []
    bar = tqdm(
        total=course.step_limit, desc="flight, at most", unit="slot", delay=SILENT, leave=False
    )
    while not step.last():
        flat = np.concatenate([np.atleast_1d(part) for part in step.observation.values()])
        step = environment.step(pilot(flat.astype(np.float32), task))
        slots += 1
        bar.update()
        outcome = task.outcome
        assert outcome is not None
        shielded.append(bool(outcome.shielded[0]))
        slot = outcome.slot
        # After a contact the body bounces: the record ends with the row where it is seen.
        rows = int(slot.first_event[0]) + 1
        recorder.slot(physics.path[:rows], physics.speeds[:rows], task.acceleration)
        contacts += int(slot.contact[0])
        if slot.arrived[0]:
            arrivals.append(slots * scene.substeps * scene.physics_step)
        success = bool(outcome.success[0])
    bar.close()
    physics.free()
    return Flight(
        recorder.trajectory(), success, contacts, tuple(arrivals), tuple(shielded), scene.slot
    )
