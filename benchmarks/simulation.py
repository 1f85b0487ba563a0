"""Slots per CPU-second of each way to fly, as a ratio to raw mj_step of the same model.

    python -m benchmarks.simulation

Interleaved repeats, medians; every way flies the guidance law's scene with random actions. The
batched environment includes projection, swept contact test, guidance, reward, observation, reset.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
import tyro

from mjcollect.batch import BatchedFlightEnv, Simulations
from mjcollect.course import Course
from mjcollect.mjcf import compile_model
from mjcollect.scene import Scene
from mjcollect.task import make_environment
from mjcollect.tour import plan_order


@dataclass(frozen=True)
class Args:
    """Measure how fast each way of simulating is."""

    scene: str = "scenario_1"
    """Scene file or bundled scene."""
    repeats: int = 5
    """Interleaved repeats of each way."""
    slots: int = 4096
    """Slots flown in a repeat."""
    threads: int = 1
    """MuJoCo's threads in the batched ways."""


def raw(scene: Scene) -> Callable[[int], None]:
    """Plain mj_step, one slot after another."""
    model = compile_model(scene)
    data = mujoco.MjData(model)

    def fly(slots: int) -> None:
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 0.01
        for _ in range(slots):
            mujoco.mj_step(model, data, scene.substeps)

    return fly


def single(course: Course) -> Callable[[int], None]:
    """The dm-control environment."""
    environment = make_environment(course, start="spread", random=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (4096, 3))
    environment.reset()

    def fly(slots: int) -> None:
        for slot in range(slots):
            environment.step(actions[slot % 4096])

    return fly


def batched(course: Course, count: int, threads: int) -> Callable[[int], None]:
    """The TorchRL environment of `count` simulations."""
    sims = Simulations([course], count, start="spread", threads=threads)
    env = BatchedFlightEnv(sims)
    state = env.reset()

    def fly(slots: int) -> None:
        nonlocal state
        for _ in range(max(slots // count, 1)):
            state["action"] = torch.rand(count, 3) * 2 - 1
            _, state = env.step_and_maybe_reset(state)

    return fly


def main(args: Args) -> None:
    """Measure and print the table."""
    torch.set_num_threads(1)
    scene = Scene.find(args.scene)
    course = Course.segment(scene, plan_order(scene, "lkh"), 0)
    ways = {"raw mj_step, one thread": raw(scene), "dm-control environment": single(course)}
    for count in (64, 256, 1024):
        ways[f"batched TorchRL, N = {count}"] = batched(course, count, args.threads)
    cpu: dict[str, list[float]] = {way: [] for way in ways}
    wall: dict[str, list[float]] = {way: [] for way in ways}
    for fly in ways.values():
        fly(args.slots // 8)
    for _ in range(args.repeats):
        for way, fly in ways.items():
            before = time.process_time(), time.perf_counter()
            fly(args.slots)
            cpu[way].append(args.slots / (time.process_time() - before[0]))
            wall[way].append(args.slots / (time.perf_counter() - before[1]))
    base = next(iter(ways))
    print(f"| way ({args.threads} threads) | slots per CPU-second | of raw | of raw, wall time |")
    print("|---|---|---|---|")
    for way in ways:
        of_cpu = statistics.median(a / b for a, b in zip(cpu[way], cpu[base], strict=True))
        of_wall = statistics.median(a / b for a, b in zip(wall[way], wall[base], strict=True))
        print(f"| {way} | {statistics.median(cpu[way]):,.0f} | {of_cpu:.2f} | {of_wall:.2f} |")


if __name__ == "__main__":
    main(tyro.cli(Args))
