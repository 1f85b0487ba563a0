"""Measures slots per second of each way to simulate, as a ratio to raw mj_step of the same model.

    OMP_NUM_THREADS=1 python -m benchmarks.simulation --out docs/results/simulation.json

Every way flies random actions from seeded starts all around the way. The batched environment does
all that training asks of it: projection, swept contact test, guidance, reward, observation, resets.
Interleaved rounds; each ratio is the median over the rounds of the ratio within a round. CPU
seconds count all threads; wall-clock ratios compare with raw mj_step on as many threads.
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from torchrl.envs import DMControlWrapper

from benchmarks.common import Output, Row, measure_rates, median_ratio, print_table, save
from mjcollect.envs.batch import BatchedFlightEnv, Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene

RAW, ROLLOUT = "raw mj_step", "mujoco.rollout, N = 256"
SINGLE, WRAPPED = "dm-control environment", "dm-control environment, TorchRL's wrapper"
BATCHED = "batched environment, N = "
LARGE = 256  # batches from which on the targets hold
# Key of a row, least value, what it is, and the number of threads from which on it is judged.
TARGETS = (
    ("of_raw_cpu", 0.6, "of raw mj_step per CPU-second", 1),
    ("over_wrapped_cpu", 6.0, "times TorchRL's wrapper per CPU-second", 1),
    ("of_raw_wall", 0.6, "of raw mj_step per second", 2),
    ("over_wrapped_wall", 10.0, "times TorchRL's wrapper", 2),
)
COLUMNS = (
    ("way", "{way}"),
    ("threads", "{threads}"),
    ("slots per CPU-second", "{slots_per_cpu_second:,.0f}"),
    ("of raw", "{of_raw_cpu:.2f}"),
    ("slots per second", "{slots_per_second:,.0f}"),
    ("of raw", "{of_raw_wall:.2f}"),
)
Way = tuple[str, int]  # name and number of threads
Fly = Callable[[], int]  # flies some slots and says how many


@dataclass(frozen=True)
class Args(Output):
    """Measures how fast each way of simulating is."""

    scene: str = "scenario_1"
    """Scene file, or the name of a bundled scene."""
    segment: int = 0
    """Number of the segment in the scene's tour."""
    counts: tuple[int, ...] = (64, 256, 1024)
    """Numbers of simulations side by side that are measured."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of MuJoCo's threads that are measured."""
    rounds: int = 9
    """Number of rounds, in each of which all ways have a turn."""
    seconds: float = 0.3
    """Seconds for which each way flies in a round, about."""


def raw(scene: Scene, threads: int, slots: int = 512) -> Fly:
    """Flies by plain mj_step, as many simulations as threads, each for so many slots."""
    model = compile_model(scene)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = ThreadPoolExecutor(threads)

    def step(data: mujoco.MjData) -> None:
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 0.01
        mujoco.mj_step(model, data, slots * scene.substeps)

    def fly() -> int:
        list(pool.map(step, datas))
        return slots * threads

    return fly


def rollout(course: Course, count: int, threads: int) -> Fly:
    """Flies by mujoco.rollout alone: the batched environment without what it adds."""
    sims = Simulations([course], count, start="spread", threads=threads)
    sims.reset()

    def fly() -> int:
        sims.roll(np.zeros((count, 3)))
        return count

    return fly


def single(course: Course) -> Fly:
    """Flies in the dm-control environment."""
    environment = make_environment(course, start="spread", random=0)
    rng = np.random.default_rng(0)
    environment.reset()

    def fly(slots: int = 64) -> int:
        for action in rng.uniform(-1, 1, (slots, 3)):
            environment.step(action)
        return slots

    return fly


def through_torchrl(env: Any, count: int, draw: Callable[[], torch.Tensor]) -> Fly:
    """Flies in a TorchRL environment of `count` simulations."""
    state = env.reset()

    def fly() -> int:
        nonlocal state
        state["action"] = draw() * 2 - 1
        _, state = env.step_and_maybe_reset(state)
        return count

    return fly


def make_ways(args: Args) -> dict[Way, Fly]:
    """Returns everything that is measured."""
    scene = Scene.find(args.scene)
    course = Course.segment(scene, plan_order(scene, "lkh"), args.segment)
    env = DMControlWrapper(make_environment(course, start="spread", random=0))
    draw = partial(torch.rand, 3, dtype=torch.float64)
    ways = {(SINGLE, 1): single(course), (WRAPPED, 1): through_torchrl(env, 1, draw)}
    for threads in args.threads:
        ways[RAW, threads] = raw(scene, threads)
        ways[ROLLOUT, threads] = rollout(course, LARGE, threads)
        for count in args.counts:
            sims = Simulations([course], count, start="spread", threads=threads)
            draw = partial(torch.rand, count, 3)
            batched = through_torchrl(BatchedFlightEnv(sims), count, draw)
            ways[f"{BATCHED}{count}", threads] = batched
    return ways


def lasting(fly: Fly, seconds: float) -> Fly:
    """Repeats a way as often as takes about `seconds`, once what it needs is compiled."""
    flown = calls = 0
    while flown < 2048:
        flown += fly()
    begun = time.perf_counter()
    while time.perf_counter() - begun < seconds:
        fly()
        calls += 1
    return lambda: sum(fly() for _ in range(calls))


def measure(args: Args) -> list[Row]:
    """Lets all ways take turns; returns a row for each, those on one thread first."""
    ways = {way: lasting(fly, args.seconds) for way, fly in make_ways(args).items()}
    rates, rows = measure_rates(ways, args.rounds), []
    for (name, threads), own in sorted(rates.items(), key=lambda item: item[0][1]):
        raw_rates, wrapped = rates[RAW, threads], rates[WRAPPED, 1]
        rows.append(
            {
                "way": name,
                "threads": threads,
                "slots_per_cpu_second": statistics.median(own.per_cpu_second),
                "slots_per_second": statistics.median(own.per_second),
                "of_raw_cpu": median_ratio(own.per_cpu_second, raw_rates.per_cpu_second),
                "of_raw_wall": median_ratio(own.per_second, raw_rates.per_second),
                "over_wrapped_cpu": median_ratio(own.per_cpu_second, wrapped.per_cpu_second),
                "over_wrapped_wall": median_ratio(own.per_second, wrapped.per_second),
            }
        )
    return rows


def judged(rows: list[Row], args: Args) -> list[Row]:
    """Returns the targets, and whether the least of the large batches meets each."""
    large = {f"{BATCHED}{count}" for count in args.counts if count >= LARGE}
    targets = []
    for threads in args.threads:
        mine = [row for row in rows if row["threads"] == threads and row["way"] in large]
        for key, least, what, from_threads in TARGETS:
            if threads >= from_threads:
                value = min(row[key] for row in mine)
                name = f"{threads} thread{'s' * (threads > 1)}: at least {least:g} {what}"
                targets.append({"target": name, "value": value, "met": value >= least})
    return targets


def main(args: Args) -> None:
    """Measures, prints the table and the targets, saves."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    rows = measure(args)
    targets = judged(rows, args)
    print_table(rows, COLUMNS)
    print()
    shown = [{**target, "met": "yes" if target["met"] else "no"} for target in targets]
    print_table(
        shown, [("target", "{target}"), ("worst at N >= 256", "{value:.2f}"), ("met", "{met}")]
    )
    save(args.out, {"results": rows, "targets": targets}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
