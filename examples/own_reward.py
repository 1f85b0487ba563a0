"""A reward of your own: pay for progress along the shortest free path, and learn a segment with it.

`docs/add-a-reward.md` puts the same function into the package. Here it is registered from outside.
Policies are compared by arrivals and seconds, never by what a reward paid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro

import mjcollect
from mjcollect.envs.reward import CRASH, PRESETS, Preset
from mjcollect.flight.contact import Slot
from mjcollect.flight.world import World
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.approach import Approach
from mjcollect.learning.evaluation import Evaluation


def progress_reward(
    world: World, before: Approach, after: Approach, slot: Slot, gamma: float
) -> Array:
    """Seconds at v_max that the way got shorter by, minus the slot's; 1 for an arrival. (N,)."""
    gained = (before.distance - after.distance) / world.v_max[..., 0]
    reward = gained - world.slot + np.where(slot.arrived, 1.0, 0.0)
    return np.where(slot.crashed, CRASH, reward)


@dataclass
class Args:
    """Learns one segment with the reward `progress` and with the package's own, `lost`."""

    scene: str = "scenario_1"
    """Names a scene file or a bundled scene."""
    segment: int = 3
    """Selects the segment of the tour."""
    updates: int = 1_000
    """Sets the number of updates with each reward."""
    seed: int = 0
    """Sets the seed."""
    quick: bool = False
    """Makes a few updates only, to see that it works."""


def main(args: Args) -> dict[str, Evaluation]:
    """Learns with both rewards, prints a line for each, and returns what was evaluated."""
    PRESETS["progress"] = Preset(progress_reward, crash_ends=True)
    scene = mjcollect.Scene.find(args.scene)
    course = mjcollect.Course.segment(scene, mjcollect.plan_order(scene, "lkh"), args.segment)
    best = {}
    for reward in ("progress", "lost"):
        updates = 100 if args.quick else args.updates
        config = mjcollect.LearnConfig(
            reward=reward,
            updates=updates,
            eval_every=100 if args.quick else 250,
            demonstrations=1_000 if args.quick else 10_000,
            extra_updates=0,
        )
        trainer = mjcollect.segment_trainer(course, config, args.seed)
        for _ in trainer.run():
            pass  # one round of updates each; trainer.rows holds the evaluations so far
        law, best[reward] = trainer.evaluator.law(), trainer.best
        print(
            f"{reward:>9}: {best[reward].success_rate:4.0%} of {config.eval_episodes} starts "
            f"arrive after {trainer.learner.updates} updates, in {best[reward].mean_time:.2f} s "
            f"(guidance law: {law.mean_time:.2f} s)"
        )
        trainer.close()
    return best


if __name__ == "__main__":
    main(tyro.cli(Args))
