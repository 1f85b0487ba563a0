"""Says what each UAV of a fleet flies, and when the episode of a fleet ends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjcollect.envs.course import Course
from mjcollect.envs.episode import Episodes
from mjcollect.envs.outcome import Outcome
from mjcollect.envs.reward import PRESETS
from mjcollect.fleet.share import parts
from mjcollect.geometry.compiled import Bools
from mjcollect.scene.depots import depot_of
from mjcollect.scene.order import TourError
from mjcollect.scene.scene import Scene


def uav_names(uavs: int) -> list[str]:
    """Returns what the UAVs of a fleet are called in its environments: uav_0, uav_1 and so on."""
    return [f"uav_{number}" for number in range(uavs)]


def courses(
    scene: Scene, tours: Sequence[Sequence[int]], depots: Sequence[int] | None = None
) -> tuple[Course, ...]:
    """Returns the course of each UAV, from its own place at its depot through its tour and back.

    Args:
        tours: each UAV's items in the order of visit. A UAV without items stays out of the fleet,
            which is that much smaller. Items in no tour are left where they are.
        depots: the number of each UAV's depot; None for m mod D, where UAV m has tour m of all
            these `tours`. Who has left out empty tours before must say whose depot is which.

    Raises:
        TourError: a tour has an item that is not there, or that another one has, or none has any,
            or there is another number of depots, or there is no such depot.
        SceneError: so many UAVs find no room at a depot, or two depots are too near to each other.
        GuidanceError: an item cannot be reached.
    """
    known = len(scene.depots)
    homes = [depot_of(uav, known) for uav in range(len(tours))] if depots is None else depots
    if len(homes) != len(tours) or not set(homes) <= set(range(known)):
        fix = f"must be {len(tours)}, one for each tour, from 0 to {known - 1}"
        raise TourError(f"depots: {list(homes)}: {fix}")
    flown = [tuple(int(item) for item in tour) for tour in tours if len(tour) > 0]
    homes = [home for home, tour in zip(homes, tours, strict=True) if len(tour) > 0]
    if not flown:
        raise TourError(f"tours: {list(tours)}: must have at least one item; add one to a tour")
    visited = [item for tour in flown for item in tour]
    for item in visited:
        if not 0 <= item < len(scene.items):
            raise TourError(f"tours: {item}: must be an item, 0 to {len(scene.items) - 1}")
        if visited.count(item) > 1:
            raise TourError(f"tours: {item}: is visited more than once; leave it in one tour only")
    return tuple(
        Course.mission(part, tuple(range(len(tour))))
        for part, tour in zip(parts(scene, flown, homes), flown, strict=True)
    )


def at_home(outcome: Outcome, episodes: Episodes) -> Bools:
    """Returns whether each UAV (N M,) has finished its course, in this slot or before."""
    # Episodes of a single UAV do not keep `home`, since they end with the course.
    return np.asarray(episodes.home | outcome.success)


def fleet_ends(outcome: Outcome, episodes: Episodes, uavs: int) -> tuple[Bools, Bools]:
    """Returns whether the episode of each fleet is terminated, and whether truncated, (N,) each.

    It is terminated when all UAVs are home or, if crashes end episodes under the reward preset, any
    of them has crashed. It is truncated when any that is not home has reached its step limit.

    Args:
        outcome: of the slot just flown by N M UAVs, those of a fleet one after the other.
        episodes: their episodes after that slot. uavs: M, number of UAVs in a fleet.
    """
    shape = -1, uavs
    home = at_home(outcome, episodes).reshape(shape)
    crashed = outcome.slot.crashed.reshape(shape) & PRESETS[episodes.rules.reward].crash_ends
    late = (episodes.steps >= episodes.targets.step_limit).reshape(shape) & ~home
    terminated = np.asarray(home.all(axis=1) | crashed.any(axis=1))
    return terminated, np.asarray(~terminated & late.any(axis=1))
