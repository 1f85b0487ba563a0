"""Has the MPC say what it would do, in flights of its own and of a policy that is to learn from it.

Chunk k of the lessons depends on its number, the seed and the school alone. Flying a policy and
asking the MPC in every slot (DAgger; Ross et al. 2011) shows it states that only the policy meets.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.learning.random_streams import stream
from mjcollect.planners.mpc import Mpc
from train.jobs.processes import importing_pool
from train.jobs.segment_pool import draw_segment

SEGMENTS, FLIGHTS = 5, 2  # A chunk is so many flights on each of so many segments.
POLICY_FLIES = 0.75  # The policy, if there is one, flies in this share of the segments.
POLICY_NOISE = (0.0, 0.0, 0.1, 0.3)  # standard deviations over a_max; one is drawn per segment
TEACHER_NOISE = (0.0, 0.1, 0.3, 0.6)
AT_ONCE = 16  # So many chunks are begun together; whether more are needed is then seen.


@dataclass(frozen=True)
class School:
    """Says who flies where while the MPC is asked.

    Attributes:
        seed, numbers, pool: of the segments, as in `segment_pool`. rules: of the episodes.
        disturbed: share of the segments flown in disturbed air. disturbance: its greatest strength.
        policy: file of a policy that flies, if any.
    """

    seed: int
    numbers: tuple[int, ...]
    pool: Path
    rules: Rules
    disturbed: float
    disturbance: Disturbance
    policy: Path | None


def fly_chunk(school: School, folder: Path, chunk: int) -> int:
    """Writes a chunk of lessons into `folder`, unless it is there; returns their number."""
    file = folder / f"{chunk}.npz"
    if not file.exists():
        torch.set_num_threads(1)
        rng = np.random.default_rng(stream(school.seed, f"lessons {chunk}"))
        observations, actions = (
            np.array(column, dtype=np.float32)
            for column in zip(
                *(lesson for _ in range(SEGMENTS) for lesson in fly_segment(school, rng)),
                strict=True,
            )
        )
        part = file.with_suffix(".part.npz")
        np.savez(part, observations=observations, actions=actions)
        os.replace(part, file)
    with np.load(file) as saved:
        return len(saved["actions"])


def fly_segment(
    school: School, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the observation (D,) and the MPC's raw action (3,) of every slot in which it plans."""
    number = school.numbers[int(rng.integers(len(school.numbers)))]
    course = Course.segment(*draw_segment(school.seed, number), school.pool)
    disturbances = None
    if school.disturbed > 0.0:
        calm = rng.random(1) >= school.disturbed
        disturbances = Disturbances(school.disturbance, 1, rng, vary=True, calm=calm)
    policy = None
    if school.policy is not None and rng.random() < POLICY_FLIES:
        policy = TrainedPolicy.load(school.policy)
    noise = rng.choice(TEACHER_NOISE if policy is None else POLICY_NOISE)
    sims = Simulations(
        [course], 1, rules=school.rules, start="spread", rng=rng, threads=1,
        disturbances=disturbances,
    )  # fmt: skip
    for _ in range(FLIGHTS):
        sims.reset()
        teacher, ended = Mpc(course), False
        while not ended:
            seen = sims.observe().astype(np.float32)
            planned = teacher.planned_action(sims.episodes)
            flown = sims.law()[0] if planned is None else planned
            if policy is not None:
                flown = policy(seen[:, : policy.inputs])[0]
            outcome = sims.step(np.clip(flown + noise * rng.standard_normal(3), -1.0, 1.0)[None])
            ended = bool(outcome.terminated[0] | outcome.truncated[0])
            if planned is not None:
                yield seen[0], planned
    sims.close()


def give_lessons(school: School, folder: Path, wanted: int, workers: int) -> Iterator[int]:
    """Writes chunks in `workers` processes, at least `wanted` lessons; yields how many a chunk has.

    Chunks that are there are kept, so that it goes on where it was stopped.
    """
    folder.mkdir(exist_ok=True)
    with importing_pool(workers) as pool:
        count = chunk = 0
        try:
            while count < wanted:
                chunks = range(chunk, chunk + AT_ONCE)
                for size in pool.map(partial(fly_chunk, school, folder), chunks):
                    count += size
                    yield size
                chunk += AT_ONCE
        finally:
            pool.shutdown(cancel_futures=True)  # after Ctrl-C only what has begun is waited for


def load_lessons(folder: Path, wanted: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the first `wanted` observations (L, D) and actions (L, 3), in the order of chunks."""
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    while sum(len(actions) for _, actions in parts) < wanted:
        with np.load(folder / f"{len(parts)}.npz") as saved:
            parts.append((saved["observations"], saved["actions"]))
    observations, actions = (
        torch.from_numpy(np.concatenate(column)[:wanted]) for column in zip(*parts, strict=True)
    )
    return observations, actions
