"""Flies a course once in the dm-control environment and records every physics step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from tqdm import tqdm

from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import FlightTask, Physics, make_environment
from mjcollect.scene.trajectory import Recorder, Trajectory

SILENT = 5.0  # A flight that takes longer than this (s) shows a progress bar.
Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Flight:
    """Holds a recorded flight.

    Attributes:
        trajectory: every physics step, up to the first contact if there was one.
        success: whether the course was finished.
        contacts: number of slots with a contact.
        arrivals: time at which each target was reached, as far as they were (s).
        shielded: whether the shield changed the command of each slot.
        slot: a slot's duration (s).
    """

    trajectory: Trajectory
    success: bool
    contacts: int
    arrivals: tuple[float, ...]
    shielded: tuple[bool, ...]
    slot: float

    @property
    def shield_share(self) -> float:
        """Returns the share of slots in which the shield changed the command; 0 without it."""
        return _share(self.shielded)

    @property
    def shield_shares(self) -> list[float | None]:
        """Returns this share for each segment begun, None for one of which no slot was flown."""
        ends = [round(seconds / self.slot) for seconds in self.arrivals]
        pairs = pairwise([0, *ends, len(self.shielded)])
        segments = [self.shielded[begin:end] for begin, end in pairs]
        return [_share(segment) if segment else None for segment in segments]


def _share(acted: Sequence[bool]) -> float:
    return sum(acted) / max(len(acted), 1)


Pilot = Callable[[np.ndarray, FlightTask], np.ndarray]


def fly(
    course: Course, policies: Sequence[Policy], observation: str = "guided", *, shield: bool = True
) -> Flight:
    """Flies `course` from rest exactly at its start, each segment by its policy, without a break.

    Args:
        policies: policy of each segment, from observations (1, D) float32 to actions (1, 3).
        observation: name of the policies' observation.
        shield: whether to bend commands that leave no way to stop without touching anything.
    """

    def pilot(flat: np.ndarray, task: FlightTask) -> np.ndarray:
        return policies[task.segment_index](flat[None])[0]

    return record(course, pilot, observation, shield=shield)


def fly_law(course: Course, *, shield: bool = True) -> Flight:
    """Flies `course` by the guidance law from rest exactly at its start; `shield` as in `fly`."""
    return record(course, lambda _, task: task.episodes.guidance_action()[0], shield=shield)


def record(
    course: Course, pilot: Pilot, observation: str = "guided", *, shield: bool = False
) -> Flight:
    """Flies `course` from rest exactly at its start with any pilot, and records the flight.

    Args:
        pilot: maps the flat observation (D,) float32 and the task to an action (3,), every slot.
        observation: name of the observation.
        shield: as in `fly`.
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
        # After a contact the body bounces, so the record ends with the row that shows it.
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
