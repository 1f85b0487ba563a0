"""Flies a scene that no policy was trained on, and repairs what fails.

The policy flies every segment. Where it fails, learning goes on from it for that segment alone, and
the mission is flown again; a mission that fails all the same is flown by the reference planner.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight, Policy, fly
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.planners.plan import fly_planner
from mjcollect.planners.reference.reference import NoFlight, Reference
from mjcollect.verify import verify

# Trains in a segment, given by its number; returns the policy and segment.json.
Train = Callable[[int], tuple[Policy, dict[str, Any]]]


@dataclass
class RepairedFlight:
    """Holds a flight and how it came about.

    Attributes:
        flight: The last flight.
        planner: Who flew it.
        trained: For each segment, its segment.json if it was trained, else None.
        notes: A sentence for every repair.
    """

    flight: Flight
    planner: Literal["policy", "reference"]
    trained: list[dict[str, Any] | None]
    notes: list[str] = field(default_factory=list)


def fly_and_repair(
    course: Course, order: tuple[int, ...], policy: TrainedPolicy, train: Train | None, shield: bool
) -> RepairedFlight:
    """Flies a mission by a policy, and repairs what fails.

    Args:
        train: goes on learning from the policy in a segment; None: nothing is trained.
        shield: whether policies fly with the shield.
    """
    policies: list[Policy] = [policy] * len(course.guidance)
    flight = fly(course, policies, policy.observation, shield=shield)
    repaired = RepairedFlight(flight, "policy", [None] * len(policies))
    while (failing := first_failure(course, order, repaired.flight)) is not None:
        if train is None or repaired.trained[failing] is not None:
            return _by_reference(course, repaired, failing)
        policies[failing], result = train(failing)
        repaired.trained[failing] = result
        repaired.notes.append(
            f"The policy failed in segment {failing}; it was trained there with "
            f"{result['updates']} updates."
        )
        repaired.flight = fly(course, policies, policy.observation, shield=shield)
    return repaired


def first_failure(course: Course, order: Sequence[int], flight: Flight) -> int | None:
    """Returns the first segment of a flight that failed; None where all succeeded."""
    found = [entry.segment for entry in verify(course.scene, flight.trajectory, order)]
    if flight.success and not found:
        return None
    reached = min(len(flight.arrivals), len(order))  # the segment that was not finished
    return min([reached, *(segment for segment in found if segment is not None)])


def _by_reference(course: Course, repaired: RepairedFlight, failing: int) -> RepairedFlight:
    """Returns the reference's flight of the whole mission, or what there is if it finds none."""
    try:
        flight = fly_planner(course, Reference(course))
    except NoFlight as error:
        note = f"Segment {failing} failed, and the reference planner finds no flight: {error}."
        return dataclasses.replace(repaired, notes=[*repaired.notes, note])
    note = f"Segment {failing} failed, so the whole mission was flown by the reference planner."
    trained: list[dict[str, Any] | None] = [None] * len(repaired.trained)
    return RepairedFlight(flight, "reference", trained, [*repaired.notes, note])
