"""Shares a scene's items among UAVs, and makes the courses and dm-control task of such a fleet."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from dm_control.rl import control

from mjcollect.envs.course import Course
from mjcollect.fleet import dm_env
from mjcollect.fleet.episode import courses
from mjcollect.guidance.travel_times import travel_times
from mjcollect.planners.assignment import Tours, assign
from mjcollect.scene.order import TourError, plan_order
from mjcollect.scene.scene import Scene


def fleet_tours(
    scene: Scene,
    uavs: int,
    tours: Sequence[Sequence[int]] | None = None,
    *,
    order: str = "lkh",
    seed: int = 0,
) -> Tours:
    """Returns the items that each UAV collects, in the order of visit; some may get none.

    UAV m flies from depot m mod D of the scene's D depots.

    Args:
        uavs: M. Several share the items so that the last one is home as early as possible; a single
            one visits them by the method `order`, as `plan_order` takes it.
        tours: M tours to take instead, which must have each item once.
        seed: of the search for tours, or of a random order.

    Raises:
        TourError: there is no UAV, or there is another number of tours, or an item is not in
            exactly one of them, or an order is asked of several UAVs; the message says what to do.
        GuidanceError: an item cannot be reached from another one.
    """
    if tours is not None:
        if len(tours) != uavs:
            raise TourError(f"tours: {len(tours)} of them: must be uavs = {uavs} of them")
        if sorted(item for tour in tours for item in tour) != list(range(len(scene.items))):
            listed = [list(tour) for tour in tours]
            raise TourError(
                f"tours: {listed}: must have each item, 0 to {len(scene.items) - 1}, exactly once"
            )
        return tuple(tuple(tour) for tour in tours)
    if uavs == 1:
        return (plan_order(scene, order, seed=seed),)
    if order != "lkh":
        raise TourError(f"order: {order!r}: is for one UAV; give the order of several by tours")
    depots = len(scene.depots)
    return assign(travel_times(scene, depots), uavs, seed=seed, depots=depots)


def fleet_courses(
    scene: Scene | str | os.PathLike[str],
    uavs: int = 2,
    tours: Sequence[Sequence[int]] | None = None,
    *,
    order: str = "lkh",
    seed: int = 0,
) -> tuple[Course, ...]:
    """Returns the courses of a fleet, for `Simulations` and the fleet's environments.

    There are fewer than `uavs` if some have no items. Arguments are as in `fleet_tours`.

    Args:
        scene: a `Scene`, a scene file, or the name of a bundled scene.

    Raises:
        SceneError: the scene is refused, or so many UAVs find no room at a depot, or two depots are
            too near to each other. It also raises what `fleet_tours` raises.
    """
    if not isinstance(scene, Scene):
        scene = Scene.find(scene)
    return courses(scene, fleet_tours(scene, uavs, tours, order=order, seed=seed))


def fleet_environment(
    scene: Scene,
    *,
    uavs: int = 2,
    tours: Sequence[Sequence[int]] | None = None,
    order: str = "lkh",
    seed: int = 0,
    **options: Any,
) -> control.Environment:
    """Returns the dm-control environment of the task `fleet`, which `load` finds by its name.

    Arguments are as in `fleet_tours`; `options` are those of `fleet.dm_env.make_environment`.
    Raises what both raise.
    """
    found = fleet_tours(scene, uavs, tours, order=order, seed=seed)
    return dm_env.make_environment(scene, found, **options)
