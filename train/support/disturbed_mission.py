"""Flies a mission many times in disturbed air, and says in mission.json how the flights went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import (
    HOME,
    CourseAir,
    DisturbedFlights,
    Pilot,
    by_policies,
    fly_batch,
    is_disturbed,
)
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.planners.mpc import Mpc
from mjcollect.render.track_figures import plot_tracks
from mjcollect.scene.air import AIR_FILE
from mjcollect.verify import verify
from train.support.run_folder import RunError, RunFolder

CALM = Disturbance()
FLIGHTS = 100  # A mission is flown so often where the air is disturbed.
REFUSED = "refused by the verifier"


@dataclass(frozen=True)
class Weather:
    """Says in which air a mission is flown, and how often."""

    disturbance: Disturbance
    flights: int

    @classmethod
    def of(cls, disturbance: Disturbance, flights: int | None) -> Weather:
        """Returns it for the flags; without --flights a calm mission is flown once."""
        usual = FLIGHTS if is_disturbed(disturbance) else 1
        return cls(disturbance, usual if flights is None else flights)

    @property
    def disturbed(self) -> bool:
        """Returns whether anything disturbs the flights."""
        return is_disturbed(self.disturbance)

    def config(self) -> dict[str, Any]:
        """Returns what config.json holds of it."""
        return {"flights": self.flights, "disturbance": asdict(self.disturbance)}

    def check(self, course: Course) -> None:
        """Refuses disturbances that a mission cannot have.

        Raises:
            RunError: boxes are to move, but every segment is too short for one.
        """
        try:
            CourseAir(course, self.disturbance, 1, np.random.default_rng(0))
        except ValueError as error:
            raise RunError(f"--{error}") from None

    def name(self) -> list[str]:
        """Returns a part of a folder's name: each kind with its strength, and the flights."""
        usual = asdict(CALM)
        level = {key: v for key, v in asdict(self.disturbance).items() if v != usual[key]}
        return [*(f"{key}{value:g}" for key, value in level.items()), f"{self.flights}flights"]


def fly_mpc(course: Course, weather: Weather, seed: int, shield: bool) -> DisturbedFlights:
    """Flies by model predictive control, one flight after the other, each with a new planner."""
    flown = []
    for number in tqdm(range(weather.flights), desc="flights", unit="flight", leave=False):
        planner = Mpc(course)

        def pilot(sims: Simulations, planner: Mpc = planner) -> np.ndarray:
            return planner.action(sims.episodes)[None]

        rules = Rules(shield=shield)
        one = fly_batch(course, pilot, rules, weather.disturbance, 1, [seed, number], bar=False)
        met = one.flights[0].air
        met = None if met is None else replace(met, flight=number)
        flown.append(replace(one.flights[0], air=met))
    return DisturbedFlights(tuple(flown))


def fly_all(
    course: Course, weather: Weather, planner: str, policies: Sequence[TrainedPolicy], seed: int,
    shield: bool, explore: bool,
) -> DisturbedFlights:  # fmt: skip
    """Flies a mission as often as is asked for.

    Args:
        planner: policy, mpc or guidance. policies: one for all segments, or one each.
        shield: whether they fly with the shield. explore: whether policies explore where they get
            no nearer.
    """
    if planner == "mpc":
        return fly_mpc(course, weather, seed, shield)
    pilot: Pilot = Simulations.law
    if planner == "policy":
        pilot = by_policies(policies, explore=explore)
    observation = policies[0].observation if planner == "policy" else "guided"
    rules = Rules(observation, shield=shield)
    return fly_batch(course, pilot, rules, weather.disturbance, weather.flights, seed)


def judged(course: Course, order: Sequence[int], flown: DisturbedFlights) -> DisturbedFlights:
    """Returns the flights, those at home marked as REFUSED in which the verifier finds anything."""
    found = []
    for each in flown.flights:
        moving = None if each.air is None else each.air.moving
        if each.ended == HOME and verify(
            course.scene, each.flight.trajectory, order, disturbed=moving is not None, moving=moving
        ):
            each = replace(each, ended=REFUSED)
        found.append(each)
    return DisturbedFlights(tuple(found))


def flights_result(weather: Weather, flown: DisturbedFlights) -> dict[str, Any]:
    """Returns what mission.json holds of all flights beside what it holds of the one shown."""
    ended = flown.ended
    refused = len(flown.flights) - sum(ended.values())
    return {
        "flights": len(flown.flights),
        "shown_flight": flown.shown,
        "disturbance": asdict(weather.disturbance),
        "success_rate": flown.success_rate._asdict(),
        "contact_rate": flown.contact_rate._asdict(),
        "mean_time": flown.mean_time._asdict(),
        "gave_way": flown.gave_way._asdict(),
        "ended": ended | ({REFUSED: refused} if refused else {}),
    }


def write_air(
    folder: RunFolder, course: Course, order: Sequence[int], flown: DisturbedFlights, plots: bool
) -> None:
    """Writes air.json, which says what disturbed the flight shown, and tracks.png if wanted."""
    air = flown.flights[flown.shown].air
    if air is not None:
        folder.write(AIR_FILE, air.save)
    if plots:

        def draw(part: Path) -> None:
            plot_tracks(part, course.scene, order, flown)

        folder.write("tracks.png", draw)
