"""Trains one policy for all UAVs of a fleet among the others, and compares it with others.

    OMP_NUM_THREADS=1 python -m benchmarks.fleet_learning --out docs/results/fleet_learning.json

A crowd is a passage of 160 x 30 x 30 m with a wall, through whose one gap, 4 to 8 m wide, six UAVs
fly, three from each side: far more traffic than in any mission. Learning goes on from the shipped
policy in some crowds, once with the other UAVs in the observation (fleet) and once without (path),
and the policies fly other crowds. All fly with the shield, the law and the shipped policy too.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.common import Output, Row, grouped, print_table, save
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import Pilot, by_policies
from mjcollect.envs.episode import Rules
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.evaluation import Evaluator
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, weights_file
from mjcollect.learning.trainer import Trainer, make_simulations
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.scene import Scene

PASSAGE = np.array([[0.0, 0.0, 0.0], [160.0, 30.0, 30.0]])
UAVS = 6
ENDS = 9.0  # metres of the passage at each side in which flights begin and end
GAP = 3.0  # metres between nodes
GAP_SIZES, WALLS = (4.0, 8.0), (2.0, 30.0)  # metres, of the gap and of the wall's thickness
FIRST_UNSEEN = 1_000_000  # Crowds from this seed on are for the comparison, not for learning.
COLUMNS = (
    ("pilot", "{pilot}"),
    ("training", "{training}"),
    ("fleets", "{fleets}"),
    ("all arrive", "{arrive:.1%}"),
    ("mean time (s)", "{mean_time:.2f}"),
    ("over alone", "{of_alone:.4f}"),
    ("last (s)", "{last:.2f}"),
    ("shield", "{shielded:.2%}"),
    ("made room", "{made_room:.2%}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Trains policies in crowds and compares them."""

    updates: int = 8_000
    """Number of updates of each training."""
    crowds: int = 8
    """Number of crowds to learn in."""
    unseen: int = 24
    """Number of other crowds to fly."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the trainings."""
    keep: Path | None = None
    """Writes the policies of the trainings to this folder."""


def crowd(seed: int) -> list[Course] | None:
    """Returns the courses of a crowd of UAVs; None where the scene is refused or has no way."""
    rng = np.random.default_rng(seed)
    size, thickness = rng.uniform(*GAP_SIZES, 2), rng.uniform(*WALLS)
    gap = rng.uniform(2.0, 28.0 - size)
    begin, end = 80.0 - thickness / 2, 80.0 + thickness / 2
    (y, z), (right, top) = gap, gap + size
    obstacles = np.array(
        [
            [[begin, 0.0, 0.0], [end, 30.0, z]],
            [[begin, 0.0, top], [end, 30.0, 30.0]],
            [[begin, 0.0, z], [end, y, top]],
            [[begin, right, z], [end, 30.0, top]],
        ]
    )
    nodes: list[Array] = []
    for side in (0.0, PASSAGE[1, 0] - ENDS):
        count = len(nodes) + UAVS
        while len(nodes) < count:
            node = np.array([side, 0.0, 0.0]) + rng.uniform(1.0, [ENDS - 1.0, 29.0, 29.0])
            if all(np.linalg.norm(node - other) > GAP for other in nodes):
                nodes.append(node)
    to = UAVS + rng.permutation(UAVS)
    ways = [(k, int(to[k])) if k % 2 == 0 else (int(to[k]), k) for k in range(UAVS)]
    try:
        scene = Scene(f"crowd {seed}", seed % 2**31, PASSAGE, nodes[0], np.array(nodes), obstacles,
                      epsilon=1.0, return_tolerance=1.0)  # fmt: skip
        return [Course(scene, way) for way in ways]
    except (SceneError, GuidanceError):
        return None


def crowds(first: int, count: int) -> list[list[Course]]:
    """Returns the first `count` crowds that can be flown, from seed `first` on."""
    found: list[list[Course]] = []
    seed = first
    while len(found) < count:
        courses = crowd(seed)
        found += [] if courses is None else [courses]
        seed += 1
    return found


def fly(courses: Sequence[Course], pilot: Pilot, rules: Rules, uavs: int) -> tuple[Array, ...]:
    """Flies many courses at once, in fleets of `uavs`.

    Returns:
        For each flight (N,): its time in s, NaN if it does not arrive or its fleet has a crash; and
        the shares of its slots in which the shield changed its command and in which it made room.
    """
    sims = Simulations(courses, len(courses), rules=rules, threads=1, uavs=uavs)
    sims.reset()
    times, slots = np.full(sims.count, np.nan), np.zeros(sims.count)
    acted, room, crashed = np.zeros(sims.count), np.zeros(sims.count), np.zeros(sims.count, bool)
    for slot in range(1, max(course.step_limit for course in courses) + 1):
        running = np.isnan(times) & ~crashed
        if not running.any():
            break
        outcome = sims.step(pilot(sims))
        slots += running
        acted += running & outcome.shielded
        if sims.episodes.traffic is not None:
            room += running & (sims.episodes.traffic.asked_by >= 0)
        times[running & outcome.success] = slot * sims.episodes.world.slot
        crashed |= np.repeat(outcome.slot.crashed.reshape(-1, uavs).any(axis=1), uavs)
    sims.close()
    times[crashed] = np.nan
    return times, acted / slots, room / slots


def flown(
    name: str, training: str, unseen: Sequence[Sequence[Course]], policy: TrainedPolicy | None
) -> list[Row]:
    """Returns how a pilot flies every crowd, with the others and alone."""
    rules = Rules("guided" if policy is None else policy.observation)
    courses = [course for crowd in unseen for course in crowd]

    def pilot() -> Pilot:
        return Simulations.law if policy is None else by_policies([policy], explore=False)

    together = fly(courses, pilot(), rules, UAVS)
    alone = fly(courses, pilot(), rules, 1)[0].reshape(-1, UAVS)
    times, acted, room = (values.reshape(-1, UAVS) for values in together)
    return [
        {
            "pilot": name,
            "training": training,
            "crowd": number,
            "times": times[number].tolist(),
            "alone": alone[number].tolist(),
            "shielded": float(acted[number].mean()),
            "made_room": float(room[number].mean()),
        }
        for number in range(len(unseen))
    ]


def train(
    observation: str,
    seed: int,
    args: Args,
    pool: Sequence[Sequence[Course]],
    held: Sequence[Sequence[Course]],
) -> TrainedPolicy:
    """Returns the best policy of a training in crowds, from the shipped policy on."""
    shipped = TrainedPolicy.load(weights_file(SHIPPED))
    config = LearnConfig(
        observation=observation, width=shipped.width, updates=args.updates, envs=len(pool) * UAVS,
        extra_updates=0, patience=args.updates, eval_episodes=1, eval_every=1_000, gap=0.0,
        alpha_actor=3e-4, alpha_critic=1e-3, guided_share=0.0, demonstrations=20_000,
    )  # fmt: skip
    sims = make_simulations([c for crowd in pool for c in crowd], config, seed, uavs=UAVS)
    evaluator = Evaluator(
        [c for crowd in held for c in crowd], config, seed, failure_seconds=30.0, uavs=UAVS
    )
    weights = shipped.widened(evaluator.sims.observe().shape[1])
    trainer = Trainer(sims, evaluator, config, seed, weights=weights)
    try:
        with tqdm(total=args.updates, desc=f"{observation}, seed {seed}") as bar:
            for updates in trainer.run():
                bar.update(updates - bar.n)
        assert trainer.best_policy is not None
        actor = make_actor(len(weights[next(iter(weights))][0]), config.width)
        actor.load_state_dict(trainer.best_policy)
        return TrainedPolicy(actor, observation)
    finally:
        trainer.close()


def summary(rows: Sequence[Row]) -> list[Row]:
    """Returns a row for each pilot and training; times are those of fleets that all arrive."""
    table = []
    for (name, training), mine in grouped(rows, "pilot", "training").items():
        good = [row for row in mine if np.isfinite(row["times"] + row["alone"]).all()]

        def mean(of: Callable[[Row], float], over: Sequence[Row] = good) -> float | None:
            return statistics.mean(map(of, over)) if over else None

        table.append(
            {
                "pilot": name,
                "training": training,
                "fleets": len(mine),
                "arrive": sum(bool(np.isfinite(row["times"]).all()) for row in mine) / len(mine),
                "mean_time": mean(lambda row: statistics.mean(row["times"])),
                "of_alone": mean(lambda row: sum(row["times"]) / sum(row["alone"])),
                "last": mean(lambda row: max(row["times"])),
                "shielded": mean(lambda row: row["shielded"], mine),
                "made_room": mean(lambda row: row["made_room"], mine),
            }
        )
    return table


def main(args: Args) -> None:
    """Trains, flies, prints, saves."""
    torch.set_num_threads(1)
    pool, held = crowds(0, args.crowds), crowds(500_000, 4)
    unseen = crowds(FIRST_UNSEEN, args.unseen)
    shipped = TrainedPolicy.load(weights_file(SHIPPED))
    rows = flown("law", "-", unseen, None) + flown("policy", "shipped", unseen, shipped)
    for observation in ("path", "fleet"):
        for seed in args.seeds:
            policy = train(observation, seed, args, pool, held)
            if args.keep is not None:
                args.keep.mkdir(parents=True, exist_ok=True)
                policy.save(args.keep / f"{observation}-{seed}.safetensors")
            rows += flown(f"policy, {observation}", f"in crowds, seed {seed}", unseen, policy)
            save(args.out, {"results": rows, "summary": summary(rows)}, replace(args, keep=None))
    print_table(summary(rows), COLUMNS)


if __name__ == "__main__":
    main(tyro.cli(Args))
