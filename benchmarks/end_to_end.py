"""Times simulating and learning until every start arrives: ours and Stable-Baselines3's DDPG.

    OMP_NUM_THREADS=1 python -m benchmarks.end_to_end --out docs/results/end_to_end.json

One segment, the first blocked one of the scene; same observation, reward, networks, batch, Adam,
learning rates, soft update and demonstrations of the guidance law. SB3 learns in its usual loop:
one environment (the single dm-control one behind Gymnasium), one update per transition. Ours has
its usual simulations side by side. They run in turn from evaluation to evaluation, one thread
each, so that a busy machine slows both. Each stops at the first evaluation in which all starts
arrive (same starts, about every 500 updates, counted in the times). If SB3 never gets there
within its budget of updates, its best evaluation is reported and the ratio is a lower bound.
Needs `pip install .[bench]`.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.common import Output, Row, save
from benchmarks.sb3 import FlightGym, make_sb3, peer_versions
from mjcollect.envs.course import Course
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.evaluation import Evaluator
from mjcollect.learning.trainer import segment_trainer
from mjcollect.scene.order import first_blocked, plan_order
from mjcollect.scene.scene import Scene

TARGET = 3.0
SB3_NOISE = 0.1  # standard deviation of SB3's Gaussian action noise, as a share of a_max


@dataclass(frozen=True)
class Args(Output):
    """Times both learners until they arrive from every start."""

    scene: str = "scenario_1"
    """Scene file, or the name of a bundled scene."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, with each of which both learners run once."""
    sb3_updates: int = 10_000
    """Most updates that SB3 may make, and as many transitions beyond the demonstrations."""


def ours(course: Course, config: LearnConfig, seed: int) -> Iterator[Row]:
    """Trains ours and yields each evaluation."""
    trainer = segment_trainer(course, config, seed)
    seen = 0
    try:
        for updates in trainer.run():
            if len(trainer.rows) > seen:
                seen, last = len(trainer.rows), trainer.rows[-1]
                yield {
                    "updates": updates,
                    "transitions": trainer.env_steps,
                    "success_rate": last["eval_success_rate"],
                    "mean_time": last["eval_mean_time"],
                }
    finally:
        trainer.close()


def sb3(course: Course, config: LearnConfig, seed: int, budget: int) -> Iterator[Row]:
    """Trains SB3's in its own loop, from evaluation to evaluation, and yields each."""
    env, evaluator = FlightGym(course, config, seed), Evaluator([course], config, seed)
    share = 0.0  # of the way down to the final learning rates
    model = make_sb3(
        env,
        config.width,
        learning_rate=lambda _: config.alpha_critic * (1.0 + (config.final_rate - 1.0) * share),
        gamma=config.gamma,
        tau=config.alpha_target,
        batch_size=config.batch,
        buffer_size=config.buffer,
        learning_starts=0,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, SB3_NOISE)),
        seed=seed,
    )

    def act(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return model.actor(torch.from_numpy(observation)).numpy()

    demonstrate(env, model.replay_buffer, config, seed)
    try:
        while model.num_timesteps < budget:
            share = min(model.num_timesteps / config.updates, 1.0)
            model.learn(config.eval_every, reset_num_timesteps=False)
            found = evaluator(act)
            yield {
                "updates": model.num_timesteps,
                "transitions": config.demonstrations + model.num_timesteps,
                "success_rate": found.success_rate,
                "mean_time": found.mean_time,
            }
    finally:
        evaluator.close()


def demonstrate(env: FlightGym, buffer: Any, config: LearnConfig, seed: int) -> None:
    """Flies the demonstrations by the law with the noises of our training, into SB3's buffer."""
    rng = np.random.default_rng(seed)
    scales = np.linspace(config.noise_min, config.noise_max, config.envs)
    observation, _ = env.reset()
    scale = rng.choice(scales)
    for _ in range(config.demonstrations):
        noise = rng.normal(0.0, scale, 3)
        action = np.clip(env.guidance_action() + noise, -1.0, 1.0).astype(np.float32)
        after, reward, ended, truncated, _ = env.step(action)
        info = {"TimeLimit.truncated": truncated}
        done = np.array([ended or truncated])
        buffer.add(observation[None], after[None], action[None], np.array([reward]), done, [info])
        observation = after
        if done[0]:
            observation, _ = env.reset()
            scale = rng.choice(scales)


def warm_up(course: Course, config: LearnConfig) -> None:
    """Lets numba compile, or load, what both sides use before any clock runs."""
    trainer = segment_trainer(course, config, seed=0)
    next(iter(trainer.run()))
    trainer.close()
    env = FlightGym(course, config, seed=0)
    env.step(env.guidance_action())


def race(sides: dict[str, Iterator[Row]]) -> dict[str, Row]:
    """Runs the sides in turn from evaluation to evaluation, each until all its starts arrive."""
    logs: dict[str, list[Row]] = {name: [] for name in sides}
    active = dict(sides)
    while active:
        for name, side in list(active.items()):
            log = logs[name]
            wall, cpu = time.perf_counter(), time.process_time()
            found = next(side, None)
            if found is None:
                del active[name]
                continue
            last = log[-1] if log else {"seconds": 0.0, "cpu_seconds": 0.0}
            found["seconds"] = last["seconds"] + time.perf_counter() - wall
            found["cpu_seconds"] = last["cpu_seconds"] + time.process_time() - cpu
            log.append(found)
            if found["success_rate"] == 1.0:
                del active[name]
                side.close()
    return {name: summary(log) for name, log in logs.items()}


def summary(log: list[Row]) -> Row:
    """Returns what a run reached, and its rates."""
    last, best = log[-1], max(found["success_rate"] for found in log)
    return {
        "all_arrived": best == 1.0,
        "best_success_rate": best,
        **{name: last[name] for name in ("seconds", "cpu_seconds", "updates", "transitions")},
        "updates_per_second": last["updates"] / last["seconds"],
        "transitions_per_second": last["transitions"] / last["seconds"],
        "evaluations": log,
    }


def main(args: Args) -> None:
    """Runs, prints, saves."""
    torch.set_num_threads(1)
    scene = Scene.find(args.scene)
    order = plan_order(scene, "lkh")
    course = Course.segment(scene, order, first_blocked(scene, order))
    config = LearnConfig(actor_delay=0)  # the actor learns from the first update on, as SB3's does
    warm_up(course, config)
    results = {}
    for seed in args.seeds:
        sides = {
            "ours": ours(course, config, seed),
            "SB3": sb3(course, config, seed, args.sb3_updates),
        }
        results[seed] = race(sides)
        for name, run in results[seed].items():
            report(f"{name}, seed {seed}", run)
    pairs = [(each["ours"], each["SB3"]) for each in results.values()]
    ratios = {
        clock: statistics.median(peer[clock] / own[clock] for own, peer in pairs)
        for clock in ("seconds", "cpu_seconds", "updates")
    }
    bound = not all(peer["all_arrived"] for _, peer in pairs)
    met = all(own["all_arrived"] for own, _ in pairs) and ratios["seconds"] >= TARGET
    least = "at least " if bound else ""
    print(
        f"\ntransitions per update: ours {config.envs * config.u1 / config.u2:g}, SB3 1\n"
        f"to all starts, SB3 over ours, medians: time {least}{ratios['seconds']:.2f}, "
        f"CPU time {least}{ratios['cpu_seconds']:.2f}, updates {least}{ratios['updates']:.2f}\n"
        f"target {TARGET:g} in time: {'met' if met else 'MISSED'}"
    )
    content = {
        "config": dataclasses.asdict(config),
        "target": TARGET,
        "met": met,
        "ratios": ratios,
        "ratio_is_lower_bound": bound,
        "results": results,
    }
    save(args.out, content, args, peer_versions())


def report(name: str, run: Row) -> None:
    """Prints one run."""
    print(
        f"{name}: {'all starts' if run['all_arrived'] else 'NOT all starts'} arrived "
        f"(best evaluation {run['best_success_rate']:.0%}) after {run['seconds']:.1f} s, "
        f"{run['updates']:.0f} updates, {run['transitions']} transitions: "
        f"{run['updates_per_second']:.0f} updates/s, "
        f"{run['transitions_per_second']:.0f} transitions/s",
        flush=True,
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
