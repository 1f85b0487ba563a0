"""Slots per second of each way to simulate, as a ratio to raw mj_step of the same model.

    OMP_NUM_THREADS=1 python -m benchmarks.simulation --out docs/results/simulation.json

Every way flies random actions from seeded starts all around the way. The batched environment does
all that training asks of it: projection, swept contact test, guidance, reward, observation, resets.
Interleaved rounds; each ratio is the median over the rounds of the ratio within a round. CPU
seconds count all threads; wall-clock ratios compare with raw mj_step on as many threads.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro
from torchrl.envs import DMControlWrapper

from benchmarks.results import save
from mjcollect.envs.batch import BatchedFlightEnv, Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import make_environment
from mjcollect.scene.mjcf import compile_model
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene

RAW, ROLLOUT = "raw mj_step", "mujoco.rollout, N = 256"
SINGLE, WRAPPED = "dm-control environment", "dm-control environment, TorchRL's wrapper"
LARGE = 256  # batches from which on the targets hold
OF_RAW, OVER_WRAPPED, OVER_WRAPPED_WALL = 0.6, 6.0, 10.0
Fly = Callable[[int], int]  # about so many slots; returns how many it flew


@dataclass(frozen=True)
class Args:
    """Measure how fast each way of simulating is."""

    scene: str = "scenario_1"
    """Scene file or bundled scene."""
    segment: int = 0
    """Segment of its tour."""
    counts: tuple[int, ...] = (64, 256, 1024)
    """Simulations side by side."""
    threads: tuple[int, ...] = (1, 2)
    """MuJoCo's threads."""
    rounds: int = 9
    """Interleaved rounds."""
    seconds: float = 0.3
    """About how long each way flies in a round."""
    out: Path | None = None
    """JSON file for the results."""


@dataclass(frozen=True)
class Way:
    """One way to simulate, on a number of threads."""

    name: str
    threads: int


def raw(scene: Scene, threads: int) -> Fly:
    """Plain mj_step, as many simulations as threads."""
    model = compile_model(scene)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = ThreadPoolExecutor(threads)

    def fly(slots: int) -> int:
        each = max(slots // threads, 1)
        for data in datas:
            mujoco.mj_resetData(model, data)
            data.ctrl[:] = 0.01
        steps = each * scene.substeps
        list(pool.map(lambda data: mujoco.mj_step(model, data, steps), datas))
        return each * threads

    return fly


def rollout(course: Course, count: int, threads: int) -> Fly:
    """mujoco.rollout alone: the batched environment without what it adds."""
    sims = Simulations([course], count, start="spread", threads=threads)
    sims.reset()

    def fly(slots: int) -> int:
        for _ in range(max(slots // count, 1)):
            sims.roll(np.zeros((count, 3)))
        return max(slots // count, 1) * count

    return fly


def batched(course: Course, count: int, threads: int) -> Fly:
    """The TorchRL environment of `count` simulations."""
    env = BatchedFlightEnv(Simulations([course], count, start="spread", threads=threads))
    state = env.reset()

    def fly(slots: int) -> int:
        nonlocal state
        for _ in range(max(slots // count, 1)):
            state["action"] = torch.rand(count, 3) * 2 - 1
            _, state = env.step_and_maybe_reset(state)
        return max(slots // count, 1) * count

    return fly


def single(course: Course) -> Fly:
    """The dm-control environment."""
    environment = make_environment(course, start="spread", random=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (4096, 3))
    environment.reset()

    def fly(slots: int) -> int:
        for slot in range(slots):
            environment.step(actions[slot % 4096])
        return slots

    return fly


def wrapped(course: Course) -> Fly:
    """The dm-control environment as TorchRL takes it in."""
    env = DMControlWrapper(make_environment(course, start="spread", random=0))
    state = env.reset()

    def fly(slots: int) -> int:
        nonlocal state
        for _ in range(slots):
            state["action"] = torch.rand(3, dtype=torch.float64) * 2 - 1
            _, state = env.step_and_maybe_reset(state)
        return slots

    return fly


def measure(args: Args) -> dict[Way, tuple[list[float], list[float]]]:
    """Slots per CPU-second and per second of each way, one of each a round."""
    scene = Scene.find(args.scene)
    course = Course.segment(scene, plan_order(scene, "lkh"), args.segment)
    ways: dict[Way, Fly] = {Way(SINGLE, 1): single(course), Way(WRAPPED, 1): wrapped(course)}
    for threads in args.threads:
        ways[Way(RAW, threads)] = raw(scene, threads)
        ways[Way(ROLLOUT, threads)] = rollout(course, LARGE, threads)
        for count in args.counts:
            ways[Way(batched_name(count), threads)] = batched(course, count, threads)
    slots = {}
    for way, fly in ways.items():
        fly(2048)  # warm, compiled
        begun, flown = time.perf_counter(), 0
        while time.perf_counter() - begun < args.seconds:
            flown += fly(256)
        slots[way] = flown
    rates: dict[Way, tuple[list[float], list[float]]] = {way: ([], []) for way in ways}
    for _ in range(args.rounds):
        for way, fly in ways.items():
            before = time.process_time(), time.perf_counter()
            flown = fly(slots[way])
            rates[way][0].append(flown / (time.process_time() - before[0]))
            rates[way][1].append(flown / (time.perf_counter() - before[1]))
    return rates


def batched_name(count: int) -> str:
    """What the batched environment is called in the table."""
    return f"batched environment, N = {count}"


def median_ratio(ours: list[float], theirs: list[float]) -> float:
    """Median over the rounds."""
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))


def main(args: Args) -> None:
    """Measure, print the table and the targets, save."""
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    rates = measure(args)
    rows = []
    for way, (cpu, wall) in sorted(rates.items(), key=lambda item: item[0].threads):
        base, other = rates[Way(RAW, way.threads)], rates[Way(WRAPPED, 1)]
        rows.append(
            {
                "way": way.name,
                "threads": way.threads,
                "slots_per_cpu_second": statistics.median(cpu),
                "slots_per_second": statistics.median(wall),
                "of_raw_cpu": median_ratio(cpu, base[0]),
                "of_raw_wall": median_ratio(wall, base[1]),
                "over_wrapped_cpu": median_ratio(cpu, other[0]),
                "over_wrapped_wall": median_ratio(wall, other[1]),
            }
        )
    print("| way | threads | slots per CPU-second | of raw | slots per second | of raw |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['way']} | {row['threads']} | {row['slots_per_cpu_second']:,.0f} "
            f"| {row['of_raw_cpu']:.2f} | {row['slots_per_second']:,.0f} "
            f"| {row['of_raw_wall']:.2f} |"
        )
    targets = judged(rows, args)
    print("\n| target | worst at N >= 256 | met |\n|---|---|---|")
    for target in targets:
        print(
            f"| {target['target']} | {target['value']:.2f} | {'yes' if target['met'] else 'no'} |"
        )
    content = {"results": rows, "targets": targets}
    save(args.out, content, arguments=dataclasses.asdict(args))


def judged(rows: list[dict], args: Args) -> list[dict]:
    """The targets and whether each is met, by the least of the large batches."""
    large = {batched_name(count) for count in args.counts if count >= LARGE}
    targets = []
    for threads in args.threads:
        mine = [row for row in rows if row["threads"] == threads and row["way"] in large]
        wanted = [("of_raw_cpu", OF_RAW, "of raw mj_step per CPU-second")]
        wanted += [("over_wrapped_cpu", OVER_WRAPPED, "times TorchRL's wrapper per CPU-second")]
        if threads > 1:
            wanted += [("of_raw_wall", OF_RAW, "of raw mj_step per second")]
            wanted += [("over_wrapped_wall", OVER_WRAPPED_WALL, "times TorchRL's wrapper")]
        for key, least, what in wanted:
            value = min(row[key] for row in mine)
            name = f"{threads} thread{'s' * (threads > 1)}: at least {least:g} {what}"
            targets.append({"target": name, "value": value, "met": value >= least})
    return targets


if __name__ == "__main__":
    main(tyro.cli(Args))
