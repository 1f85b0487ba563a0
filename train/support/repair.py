"""Fly a scene that no policy was trained on, and mend what fails.

The policy flies every segment. Where it fails, learning goes on from it for that segment alone, and
the mission is flown again; a mission that fails all the same is flown by the reference planner.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight, Policy, fly, record
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.planners.reference.reference import NoFlight, Reference
from mjcollect.verify import verify
from train import segment
from train.support.command_line import INTERRUPTED
from train.support.run_folder import RunFolder


class Stopped(Exception):
    """Ctrl-C ended a training."""


@dataclass
class RepairedFlight:
    """A flight and how it came about.

    Attributes:
        flight: the last one. planner: who flew it. notes: a sentence for everything mended.
        trained: segment.json of the segments that were trained, else None.
    """

    flight: Flight
    planner: Literal["policy", "reference"]
    trained: list[dict[str, Any] | None]
    notes: list[str] = field(default_factory=list)


def fly_unseen(
    course: Course,
    order: tuple[int, ...],
    policy: TrainedPolicy,
    weights: Path,
    folder: RunFolder,
    finetune: int,
    seed: int,
    shield: bool,
) -> RepairedFlight:
    """Fly a mission by a policy.

    Args:
        weights: the policy's file. folder: where segments that fail are trained.
        finetune: updates of such a training; 0: none. shield: whether policies fly with it.

    Raises:
        Stopped: by Ctrl-C.
    """
    policies: list[Policy] = [policy] * len(course.guidance)
    flight = fly(course, policies, policy.observation, shield=shield)
    made = RepairedFlight(flight, "policy", [None] * len(policies))
    while (failing := first_failure(course, order, made.flight)) is not None:
        if finetune == 0 or made.trained[failing] is not None:
            return _by_reference(course, made, failing)
        result = _train(course, order, weights, folder, finetune, seed, failing, shield)
        made.trained[failing] = result
        at = folder.path / "segments" / str(failing) / "policy.pt"
        policies[failing] = TrainedPolicy.load(at)
        made.notes.append(
            f"The policy failed in segment {failing}; it was trained there with "
            f"{result['updates']} updates."
        )
        made.flight = fly(course, policies, policy.observation, shield=shield)
    return made


def first_failure(course: Course, order: Sequence[int], flight: Flight) -> int | None:
    """The first segment of a flight that failed; None where all succeeded."""
    found = [entry.segment for entry in verify(course.scene, flight.trajectory, order)]
    if flight.success and not found:
        return None
    reached = min(len(flight.arrivals), len(order))  # the segment that was not finished
    return min([reached, *(segment for segment in found if segment is not None)])


def _train(
    course: Course, order: tuple[int, ...], weights: Path, folder: RunFolder, finetune: int,
    seed: int, failing: int, shield: bool,
) -> dict[str, Any]:  # fmt: skip
    """segment.json of a training from `weights`."""
    own = RunFolder(folder.path / "segments" / str(failing))
    learn = LearnConfig(
        updates=finetune, extra_updates=0, eval_every=max(finetune // 10, 1), shield=shield
    )
    with tempfile.TemporaryDirectory() as guidance:
        course.save_guidance(Path(guidance))
        args = segment.Args(
            scene=str(folder.path / "scene.json"), order=",".join(map(str, order)),
            segment=failing, out=own.path, seed=seed, weights=weights, guidance=Path(guidance),
            video=False, overwrite=True, learn=learn,
        )  # fmt: skip
        if segment.train_segment(args) == INTERRUPTED:
            raise Stopped
    result = own.read_json("segment.json")
    assert result is not None
    return result


def _by_reference(course: Course, made: RepairedFlight, failing: int) -> RepairedFlight:
    """The reference's flight of the whole mission, or what there is if it finds none."""
    try:
        reference = Reference(course)
        flight = record(course, lambda _, task: reference.action(task.episodes))
    except NoFlight as error:
        note = f"Segment {failing} failed, and the reference planner finds no flight: {error}."
        return dataclasses.replace(made, notes=[*made.notes, note])
    note = f"Segment {failing} failed, so the whole mission was flown by the reference planner."
    trained: list[dict[str, Any] | None] = [None] * len(made.trained)
    return RepairedFlight(flight, "reference", trained, [*made.notes, note])
