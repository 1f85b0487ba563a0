"""Learns one segment by Stable-Baselines3's SAC, on the vector environment of Gymnasium.

The last policy flies without noise from starts in the ball of the segment's start, and is compared
with the guidance law from the same starts and with the lower bound; see `docs/gymnasium.md`.
Needs `pip install 'mjcollect[gym]' stable-baselines3==2.9.2`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
import tyro
from stable_baselines3 import SAC

from mjcollect import Course, Scene, plan_order
from mjcollect.gym.sb3 import FlightVecEnv
from mjcollect.scene.bounds import segment_bound

GAMMA = 0.95  # of the learner and of the environment, per slot of 0.2 s
STARTS_SEED = 1000  # All flights that are compared begin at the same starts.
VectorEnv = gymnasium.vector.VectorEnv
Found = tuple[float, float, int]
Pilot = Callable[[VectorEnv, np.ndarray], np.ndarray]


@dataclass
class Args:
    """Learns a segment with Stable-Baselines3, once with each seed."""

    scene: str = "scenario_1"
    """Names a scene file or a bundled scene."""
    segment: int = 3
    """Selects the segment of the tour."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Sets the seeds."""
    slots: int = 30_000
    """Sets the number of slots flown in all simulations together."""
    envs: int = 16
    """Sets the number of simulations; a quarter as many updates follow each step of all."""
    starts: int = 64
    """Sets the number of starts from which the learned policy flies in the end."""
    quick: bool = False
    """Flies a few slots with one seed only, to see that it works."""


def make(course: Course, count: int, start: str) -> VectorEnv:
    """Returns the vector environment, with observations and actions in the frame of the path."""
    rules = {"observation": "path", "reward": "lost", "gamma": GAMMA}
    name = "mjcollect.gym:mjcollect/Segment-v0"
    return gymnasium.make_vec(name, count, course=course, start=start, threads=1, **rules)


def learn(course: Course, args: Args, seed: int) -> SAC:
    """Returns SAC after learning from starts all over the way."""
    env = FlightVecEnv(make(course, args.envs, "spread").unwrapped)
    model = SAC(
        "MlpPolicy",
        env,
        learning_rate=lambda left: 1e-3 * (0.1 + 0.9 * left),
        gamma=GAMMA,
        tau=0.01,
        gradient_steps=max(1, args.envs // 4),
        learning_starts=min(2_000, args.slots // 2),
        policy_kwargs={"net_arch": [128, 128]},
        seed=seed,
        device="cpu",
    )
    model.learn(args.slots)
    env.close()
    return model


def fly(course: Course, count: int, decide: Pilot) -> Found:
    """Returns the share of flights that arrive, their mean time in s, and the number of crashes."""
    env = make(course, count, "ball")
    seen, _ = env.reset(seed=STARTS_SEED)
    flying, times, crashes = np.ones(count, dtype=bool), [], 0
    while flying.any():
        seen, *_, infos = env.step(decide(env.unwrapped, seen))
        if "final_info" in infos:  # Later episodes of a simulation do not count.
            final, ended = infos["final_info"], infos["_final_info"] & flying
            times += final["time"][ended & final["success"]].tolist()
            crashes += int(np.sum(ended & final["crashed"]))
            flying &= ~ended
    env.close()
    return len(times) / count, float(np.mean(times)) if times else np.nan, crashes


def main(args: Args) -> None:
    """Learns, flies, prints."""
    torch.set_num_threads(1)
    if args.quick:
        args = replace(args, seeds=args.seeds[:1], slots=64, envs=4, starts=4)
    scene = Scene.find(args.scene)
    course = Course.segment(scene, plan_order(scene, "lkh"), args.segment)
    print(f"lower bound: {segment_bound(scene, *course.nodes):.2f} s")
    report("guidance law", fly(course, args.starts, lambda env, _: env.law()))
    for seed in args.seeds:
        wall, cpu = time.perf_counter(), time.process_time()
        model = learn(course, args, seed)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        found = fly(
            course, args.starts, lambda _, seen, m=model: m.predict(seen, deterministic=True)[0]
        )
        report(f"SAC, seed {seed}", found, f", learned in {cpu:.0f} s of one core ({wall:.0f} s)")


def report(who: str, found: Found, more: str = "") -> None:
    """Prints what the flights reached."""
    print("{}: {:.0%} arrive, in {:.2f} s, {} crashes".format(who, *found) + more, flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
