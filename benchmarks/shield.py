"""Which backup manoeuvre of the shield costs least time.

    python -m benchmarks.shield --out docs/results/shield.json

A command is allowed if a way to stop is left after it; which ways are tried decides how often the
shield acts. Each set of manoeuvres flies the same generated segments, by the same policy, in a
process of its own. Times are compared on the segments in which all of them arrive.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.results import save
from mjcollect.generate import LAYOUTS
from mjcollect.learning.policy import SHIPPED, policy_digest, weights_file
from train.generalist import HELD_OUT
from train.jobs.segment_pool import draw_segment

FIRST = HELD_OUT + 60_000
# Slots for which a command is held before braking, and shares of it beside full braking; 1 is the
# command itself, which is not allowed by then, and stands for none.
MANOEUVRES: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {
    "full braking": ((0,), (1.0,)),
    "and partial braking": ((0,), (0.75, 0.5, 0.25)),
    "and the command held on, as round a corner": ((0, 2, 4, 8), (1.0,)),
    "all of these (ours)": ((0, 2, 4, 8), (0.75, 0.5, 0.25)),
}


@dataclass(frozen=True)
class Args:
    """Compare backup manoeuvres."""

    policy: Path = SHIPPED
    """The policy that flies."""
    segments: int = 60
    """Segments of each layout."""
    seed: int = 0
    """Seed of the segments."""
    out: Path | None = None
    """JSON file to write."""
    child: str | None = None
    """Fly by this set of manoeuvres alone, and print the flights; for the program itself."""


def flights(args: Args, name: str) -> dict[str, list[Any]]:
    """Seconds of each segment, None where it did not arrive; slots, and those bent."""
    # The module; the package's attribute of that name is the function.
    rule: Any = importlib.import_module("mjcollect.flight.shield")
    rule.HELD, rule.BENT = MANOEUVRES[name]  # before the first call compiles it
    from mjcollect.envs.batch import Simulations
    from mjcollect.envs.episode import Rules
    from mjcollect.learning.policy import TrainedPolicy

    policy = TrainedPolicy.load(weights_file(args.policy))
    found: dict[str, list[Any]] = {"seconds": [], "slots": [], "shielded": [], "contacts": []}
    for layout in LAYOUTS:
        for number in range(FIRST, FIRST + args.segments):
            course = draw_segment(args.seed, number, layout).course(Path("nowhere"))
            sims = Simulations([course], 1, rules=Rules(policy.observation), threads=1)
            sims.place(np.array([0]), *course.starts("point", 1, np.random.default_rng(0)))
            slots = shielded = contacts = 0
            ended = success = False
            while not ended:
                outcome = sims.step(policy(sims.observe().astype(np.float32)))
                slots += 1
                shielded += int(outcome.shielded[0])
                contacts += int(outcome.slot.crashed[0])
                success = bool(outcome.success[0])
                ended = bool(outcome.terminated[0] | outcome.truncated[0])
            sims.close()
            found["seconds"].append(slots * course.scene.slot if success else None)
            found["slots"].append(slots)
            found["shielded"].append(shielded)
            found["contacts"].append(contacts)
    return found


def fly_apart(args: Args, name: str) -> dict[str, list[Any]]:
    """`flights` in a process with a cache of its own, since its kernels are compiled otherwise."""
    words = ["--policy", str(args.policy), "--segments", str(args.segments)]
    command = [sys.executable, "-m", "benchmarks.shield", *words, "--seed", str(args.seed)]
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        done = subprocess.run(
            [*command, "--child", name], env=environment, check=True, capture_output=True, text=True
        )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main(args: Args) -> int:
    """Fly by every set of manoeuvres, compare, save."""
    if args.child is not None:
        print(json.dumps(flights(args, args.child)))
        return 0
    flown = {name: fly_apart(args, name) for name in MANOEUVRES}
    all_arrive = [
        None not in seconds
        for seconds in zip(*(one["seconds"] for one in flown.values()), strict=True)
    ]
    rows = []
    for name, one in flown.items():
        both = [s for s, yes in zip(one["seconds"], all_arrive, strict=True) if yes]
        rows.append(
            {
                "manoeuvres": name,
                "segments": len(one["seconds"]),
                "arrived": sum(s is not None for s in one["seconds"]),
                "contacts": sum(one["contacts"]),
                "mean_time": float(np.mean(both)),
                "shield_share": sum(one["shielded"]) / sum(one["slots"]),
            }
        )
    found = {"policy": policy_digest(args.policy), "compared": sum(all_arrive), "rows": rows}
    save(args.out, found, arguments=json.loads(json.dumps(asdict(args), default=str)))
    for row in rows:
        print(
            f"{row['manoeuvres']:>44}: {row['arrived']} of {row['segments']} arrive, "
            f"{row['contacts']} contacts, {row['mean_time']:.2f} s where all do "
            f"({found['compared']}), bent in {row['shield_share']:.2%} of slots"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
