"""Flies a scene with several UAVs at once: items shared, one simulation, one verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjcollect.envs.batch import Simulations
from mjcollect.envs.disturbed import HOME, Pilot, by_policies
from mjcollect.envs.episode import Rules
from mjcollect.fleet.episode import courses
from mjcollect.fleet.flight import FleetFlight, fly_fleet
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.planners.assignment import Tours
from mjcollect.planners.fleet_pilot import by_planners
from mjcollect.planners.fleets import fleet_tours
from mjcollect.planners.mpc import Mpc
from mjcollect.scene.depots import depot_of
from mjcollect.scene.scene import Scene
from mjcollect.verify import verify
from train.fleets.report import Sharing
from train.support.run_folder import RunError, RunFolder, as_written

# Trains UAV number so and so in a segment; returns the policy and segment.json.
TrainPart = Callable[[int, int], tuple[TrainedPolicy, dict[str, Any]]]
Trained = list[list[dict[str, Any] | None]]


def check_fleet(uavs: int, scene: Scene, given: dict[str, object], order: str | None) -> None:
    """Refuses what cannot be flown by several UAVs.

    Args:
        given: values by flag of what several UAVs cannot have; those that are not false count.

    Raises:
        RunError: there is something of it; the message names flag, value and fix.
    """
    for flag, value in given.items():
        if value:
            raise RunError(f"{flag}: {value}: is for one UAV; leave it or --uavs {uavs} out")
    if scene.moving:
        raise RunError(
            f"--uavs: {uavs}: moving: {len(scene.moving)} boxes: several UAVs fly in calm air, "
            "among boxes that stand; leave the key or the flag out"
        )
    if order not in (None, "lkh"):
        raise RunError(
            f"--order: {order}: several UAVs share the items by the least time; leave it out"
        )


def share_scene(scene: Scene, uavs: int, seed: int) -> Sharing:
    """Shares a scene's items among UAVs, so that the last one is home as early as possible.

    Raises:
        TourError, SceneError, GuidanceError: the items cannot be shared, or so many UAVs find no
            room at a depot, or an item cannot be reached.
    """
    shared = fleet_tours(scene, uavs, seed=seed)
    flying = [uav for uav, tour in enumerate(shared) if tour]
    tours: Tours = tuple(shared[uav] for uav in flying)
    depots = tuple(depot_of(uav, len(scene.depots)) for uav in flying)
    return Sharing(scene, uavs, tours, courses(scene, tours, depots), depots)


def finished_fleet(run: Path, scene: Scene) -> tuple[Sharing, int]:
    """Returns who flew what in a run's folder, and its seed.

    Raises:
        RunError: the run is not a fleet's.
    """
    result = RunFolder(run).read_json("fleet.json")
    if result is None:
        raise RunError(
            f"--run: {run}: holds no fleet.json; leave --uavs out to fly a mission again"
        )
    with as_written(run / "fleet.json"):
        tours = tuple(tuple(map(int, mission["items"])) for mission in result["missions"])
        depots = tuple(int(mission.get("depot", 0)) for mission in result["missions"])
        uavs, seed = int(result["uavs"]), int(result["seed"])
        items = sorted(item for tour in tours for item in tour)
        if items != list(range(len(scene.items))) or not set(depots) <= set(
            range(len(scene.depots))
        ):
            raise ValueError("other items or depots than the scene's")
    return Sharing(scene, uavs, tours, courses(scene, tours, depots), depots), seed


def fleet_policies(run: Path, sharing: Sharing) -> list[TrainedPolicy]:
    """Returns the policies of a finished run of train.mission, for each segment of each UAV.

    Raises:
        RunError: one is missing.
    """
    policies = []
    for uav, course in enumerate(sharing.courses):
        for index in range(len(course.guidance)):
            own = sharing.folder(RunFolder(run), uav).segment(index).path / "policy.pt"
            if not own.is_file():
                raise RunError(f"--run: {own}: is missing; fly its scene with --scene instead")
            policies.append(TrainedPolicy.load(own))
    return policies


def pilot_of(
    planner: str, sharing: Sharing, policies: Sequence[TrainedPolicy], explore: bool
) -> tuple[Pilot, str]:
    """Returns what flies a fleet, and the name of its observation.

    Args:
        planner: policy, mpc or guidance. policies: one for all, or one for each segment of each
            UAV in turn.
    """
    if planner == "mpc":
        return by_planners([Mpc(course) for course in sharing.courses]), "guided"
    if planner == "policy":
        return by_policies(policies, explore=explore), policies[0].observation
    return Simulations.law, "guided"


def fly_by_policies(
    sharing: Sharing, policies: list[TrainedPolicy], train: TrainPart | None, *, shield: bool,
    explore: bool,
) -> tuple[FleetFlight, Trained, list[str]]:  # fmt: skip
    """Flies a fleet by policies, and repairs what fails: learning goes on in that segment alone.

    Args:
        policies: one for each segment of each UAV in turn; those trained are put in their places.
        train: None: nothing is trained.

    Returns:
        The last flight, the segment.json of what was trained, and a sentence for every repair.
    """
    trained: Trained = [[None] * len(course.guidance) for course in sharing.courses]
    notes: list[str] = []
    while True:
        pilot, observation = pilot_of("policy", sharing, policies, explore)
        flown = fly_fleet(sharing.courses, pilot, Rules(observation, shield=shield))
        failing = _first_failure(sharing, flown)
        if failing is None or train is None or trained[failing[0]][failing[1]] is not None:
            return flown, trained, notes
        uav, segment = failing
        policy, result = train(uav, segment)
        policies[sum(map(len, trained[:uav])) + segment] = policy
        trained[uav][segment] = result
        notes.append(
            f"The policy failed in segment {segment} of UAV {uav}; it was trained there with "
            f"{result['updates']} updates."
        )


def _first_failure(sharing: Sharing, flown: FleetFlight) -> tuple[int, int] | None:
    """Returns UAV and segment of a flight that failed by itself; None where there is none."""
    for uav, (course, flight) in enumerate(zip(sharing.courses, flown.flights, strict=True)):
        count = len(course.scene.items)
        reached = min(len(flight.arrivals), count)
        if flown.ended[uav] not in (HOME, "stopped"):
            return uav, reached
        if flown.ended[uav] == HOME:
            found = verify(course.scene, flight.trajectory, range(count))
            if found:
                return uav, min(each.segment for each in found)
    return None
