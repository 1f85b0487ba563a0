"""Times one decision of policy, guidance law and MPC, for one UAV on one core.

    python -m benchmarks.decision --out docs/results/decision.json

All decide at the same states, those of a mission that the MPC flies. Every decision starts from
position and velocity: what the guidance fields are asked is part of it. The ways take turns at
every state, the fast ones several times in a row, each call timed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tensordict import TensorDict

from benchmarks.common import Output, Row, print_table, save
from mjcollect.envs.course import Course
from mjcollect.envs.dm_env import FlightTask
from mjcollect.envs.episode import Episodes, Rules
from mjcollect.envs.recording import record
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.ddpg import make_actor
from mjcollect.learning.policy import NO_POLICY, TrainedPolicy, weights_file
from mjcollect.planners.mpc import Mpc
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene

TARGET = 0.1  # ms, for the network alone and with the observation
NETWORK, TORCH = "policy: network", "policy: network through torch"
OBSERVATION, POLICY = "policy: observation", "policy: observation and network"
LAW, MPC = "guidance law", "MPC"
WAYS = (NETWORK, TORCH, OBSERVATION, POLICY, LAW, MPC)
COLUMNS = (
    ("way", "{way}"),
    ("median (ms)", "{median_ms:.4f}"),
    ("95th percentile (ms)", "{p95_ms:.4f}"),
    ("MPC's median over it", "{faster_than_mpc:.1f}"),
    ("target", "{target}"),
)


@dataclass(frozen=True)
class Args(Output):
    """Times the decisions of every way to fly."""

    scene: str = "sweep_8"
    """Scene file, or the name of a bundled scene."""
    policy: Path = NO_POLICY
    """Policy: shipped, none (a network of random weights, which takes as long), or a file."""
    repeats: int = 5
    """Calls in a row of every way but the MPC, which decides once in each state."""


def through_torch(policy: TrainedPolicy, observation: np.ndarray) -> np.ndarray:
    """Returns a decision (3,) that is made by TensorDict and torch."""
    with torch.no_grad():
        batch = TensorDict({"observation": torch.from_numpy(observation[None])}, 1)
        return np.asarray(policy.actor(batch)["action"].numpy()[0])


def measure(args: Args) -> dict[str, list[float]]:
    """Returns the seconds of every call, by the way in which it decides."""
    scene = Scene.find(args.scene)
    course = Course.mission(scene, plan_order(scene, "lkh"))
    loaded = None if args.policy == NO_POLICY else TrainedPolicy.load(weights_file(args.policy))
    rules = Rules("guided" if loaded is None else loaded.observation)
    mpc, probe = Mpc(course), Episodes([course], 1, rules)

    def look(episodes: Episodes) -> np.ndarray:
        """Returns the observation (D,) from position, velocity and target."""
        probe.load({"truth": episodes.q, "v": episodes.v, "target": episodes.target})
        return np.concatenate(list(probe.observe().values()), axis=1)[0].astype(np.float32)

    def by_law(episodes: Episodes) -> np.ndarray:
        probe.load({"truth": episodes.q, "v": episodes.v, "target": episodes.target})
        return probe.guidance_action()[0]

    policy = loaded or TrainedPolicy(
        make_actor(len(look(probe)), LearnConfig().width), rules.observation
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
    flight = record(course, pilot, rules.observation)
    print(f"{mpc.summary()} Flight: {flight.trajectory.duration:.1f} s, success {flight.success}.")
    return seconds


def main(args: Args) -> None:
    """Measures, prints, saves."""
    torch.set_num_threads(1)
    seconds = measure(args)
    mpc, rows, shown = float(np.median(seconds[MPC])), [], []
    for way in WAYS:
        half, most = (1e3 * float(np.percentile(seconds[way], p)) for p in (50, 95))
        row: Row = {"way": way, "calls": len(seconds[way]), "median_ms": half, "p95_ms": most}
        row["faster_than_mpc"] = 1e3 * mpc / half
        row["met"] = half < TARGET if way in (NETWORK, POLICY) else None
        target = {True: f"< {TARGET}: met", False: f"< {TARGET}: missed", None: ""}[row["met"]]
        rows.append(row)
        shown.append(row | {"target": target})
    print_table(shown, COLUMNS)
    save(args.out, {"results": rows}, args)


if __name__ == "__main__":
    main(tyro.cli(Args))
