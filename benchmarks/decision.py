"""Milliseconds per decision for one UAV on one core: policy, guidance law and MPC.

    python -m benchmarks.decision --out docs/results/decision.json

All decide at the same states, those of a mission that the MPC flies. Every decision starts from
position and velocity: what the guidance fields are asked is part of it. The ways take turns at
every state, the fast ones several times in a row, each call timed.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tensordict import TensorDict

from benchmarks.results import save
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import FlightTask
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.envs.recording import record
from mjcollect.learning.networks import make_actor
from mjcollect.learning.policy import TrainedPolicy
from mjcollect.planners.mpc import HORIZON, Mpc
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene

TARGET = 0.1  # ms, for the network alone and with the observation
NETWORK, TORCH = "policy: network", "policy: network through torch"
OBSERVATION, POLICY = "policy: observation", "policy: observation and network"
LAW, MPC = "guidance law", "MPC"
WAYS = (NETWORK, TORCH, OBSERVATION, POLICY, LAW, MPC)


@dataclass(frozen=True)
class Args:
    """Time the decisions of every way to fly."""

    scene: str = "sweep_8"
    """Scene file or bundled scene."""
    policy: Path | None = None
    """A policy.pt; default: a network of random weights, which takes as long."""
    width: int = 128
    """Width of its hidden layers."""
    horizon: int = HORIZON
    """Slots that the MPC plans."""
    repeats: int = 5
    """Calls in a row of every way but the MPC, which decides once at a state."""
    out: Path | None = None
    """JSON file for the results."""


def through_torch(policy: TrainedPolicy, observation: np.ndarray) -> np.ndarray:
    """A decision by TensorDict and torch."""
    with torch.no_grad():
        batch = TensorDict({"observation": torch.from_numpy(observation[None])}, 1)
        return np.asarray(policy.actor(batch)["action"].numpy()[0])


def measure(args: Args) -> dict[str, list[float]]:
    """Seconds of every call, by way."""
    scene = Scene.find(args.scene)
    course = Course.mission(scene, plan_order(scene, "lkh"))
    mpc, probe = Mpc(course, args.horizon), Episodes([course], 1, Rules())

    def look(episodes: Episodes) -> np.ndarray:
        """The observation from position, velocity and target."""
        probe.load({"truth": episodes.q, "v": episodes.v, "target": episodes.target})
        return np.concatenate(list(probe.observe().values()), axis=1)[0].astype(np.float32)

    def by_law(episodes: Episodes) -> np.ndarray:
        probe.load({"truth": episodes.q, "v": episodes.v, "target": episodes.target})
        return probe.guidance_action()[0]

    policy = (
        TrainedPolicy(make_actor(len(look(probe)), args.width), "guided")
        if args.policy is None
        else TrainedPolicy.load(args.policy)
    )
    seconds: dict[str, list[float]] = {way: [] for way in WAYS}

    def timed(way: str, decide: Callable[[], np.ndarray], repeats: int = args.repeats) -> Any:
        for _ in range(repeats):
            begun = time.perf_counter()
            answer = decide()
            seconds[way].append(time.perf_counter() - begun)
        return answer

    def pilot(observation: np.ndarray, task: FlightTask) -> np.ndarray:
        episodes = task.episodes
        timed(OBSERVATION, lambda: look(episodes))
        timed(NETWORK, lambda: policy(observation[None]))
        timed(POLICY, lambda: policy(look(episodes)[None]))
        timed(TORCH, lambda: through_torch(policy, observation))
        timed(LAW, lambda: by_law(episodes))
        return np.asarray(timed(MPC, lambda: mpc.action(episodes), 1))

    for _ in range(3):  # compile and load what is compiled and loaded at first use
        by_law(probe)
        policy(look(probe)[None])
        through_torch(policy, look(probe))
    flight = record(course, pilot)
    print(f"{mpc.summary()} Flight: {flight.trajectory.duration:.1f} s, success {flight.success}.")
    return seconds


def main(args: Args) -> None:
    """Measure, print, save."""
    torch.set_num_threads(1)
    seconds = measure(args)
    rows = []
    for way in WAYS:
        half, most = (1e3 * float(np.percentile(seconds[way], p)) for p in (50, 95))
        rows.append({"way": way, "calls": len(seconds[way]), "median_ms": half, "p95_ms": most})
    mpc = rows[-1]["median_ms"]
    print("| way | median (ms) | 95th percentile (ms) | MPC's median over it | target |")
    print("|---|---|---|---|---|")
    for row in rows:
        row["faster_than_mpc"] = mpc / row["median_ms"]
        row["met"] = row["median_ms"] < TARGET if row["way"] in (NETWORK, POLICY) else None
        target = {True: f"< {TARGET}: met", False: f"< {TARGET}: missed", None: ""}[row["met"]]
        print(
            f"| {row['way']} | {row['median_ms']:.4f} | {row['p95_ms']:.4f} "
            f"| {row['faster_than_mpc']:.1f} | {target} |"
        )
    arguments = {key: str(value) for key, value in dataclasses.asdict(args).items()}
    save(args.out, {"results": rows}, arguments=arguments)


if __name__ == "__main__":
    main(tyro.cli(Args))
