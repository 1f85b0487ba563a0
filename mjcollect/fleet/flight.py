"""Flies a fleet once, all UAVs in one MuJoCo simulation, and records every physics step."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import HOME, Pilot, Track
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import SILENT, Flight

STOPPED = "stopped"  # So ends the flight of one whose fleet cannot go on.


@dataclass(frozen=True)
class FleetFlight:
    """Holds the recorded flights of a fleet.

    Attributes:
        flights: that of each UAV, up to its arrival. ended: how each ended, see `disturbed.ENDS`.
        made_room: share of the slots of each in which it made room for another one.
    """

    flights: tuple[Flight, ...]
    ended: tuple[str, ...]
    made_room: tuple[float, ...]

    @property
    def success(self) -> bool:
        """Returns whether all came home with everything."""
        return all(end == HOME for end in self.ended)

    @property
    def makespan(self) -> float:
        """Returns the time (s) until the last one was home, or until the flight ended."""
        return max(flight.trajectory.duration for flight in self.flights)


def fly_fleet(courses: Sequence[Course], pilot: Pilot, rules: Rules) -> FleetFlight:
    """Flies courses at the same time, each by a UAV of one fleet, the first one with right of way.

    Args:
        pilot: from the simulations to actions (M, 3) in units of a_max, every slot.
        rules: observation, shield and the like.
    """
    count = len(courses)
    sims = Simulations(courses, count, rules=rules, threads=1, uavs=count)
    segments = [len(course.guidance) for course in courses]
    shown = tqdm(
        total=sum(segments), desc="flight", unit="segment", delay=SILENT, leave=False,
        mininterval=0.1 if sys.stderr.isatty() else 10.0,
    )  # fmt: skip
    made_room, slots = np.zeros(count), 0
    try:
        sims.reset()
        tracks = [Track(course, sims, index) for index, course in enumerate(courses)]
        running = list(range(count))
        while running and all(track.ended in ("", HOME) for track in tracks):
            outcome = sims.step(pilot(sims))
            slots += 1
            if sims.episodes.traffic is not None:
                made_room += sims.episodes.traffic.gives_way
            for index in running:
                tracks[index].slot(sims, outcome, None)
            running = [index for index in running if not tracks[index].ended]
            shown.update(sum(track.reached for track in tracks) - shown.n)
        flown = tuple(track.flown(sims, None) for track in tracks)
    finally:
        shown.close()
        sims.close()
    return FleetFlight(
        tuple(each.flight for each in flown),
        tuple(each.ended or STOPPED for each in flown),
        tuple((made_room / max(slots, 1)).tolist()),
    )
