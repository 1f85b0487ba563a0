"""Digests of what must not change when code is moved: flights, slots of a batch, a trained policy.

    python -m tests.fingerprint --out before.json
    python -m tests.fingerprint --against before.json

The digests are of every bit, so both runs must be on one machine. `tests/test_fingerprint.py`
compares the figures beside the digests, which rounding does not change, with those of
`tests/fingerprint.json`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.envs.recording import Flight, fly, fly_law
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.learning.config import LearnConfig
from mjcollect.learning.policy import SHIPPED
from mjcollect.learning.trainer import segment_trainer
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.plan import fly_planner
from mjcollect.planners.reference.reference import Reference
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.support.starting_policy import start_from

SCENES = ("scenario_1", "scenario_2", "sweep_8", "city_6")
PILOTS = ("law", "mpc", "reference", "policy")
SLOTS = 64
UPDATES = 300
DISTURBED = Disturbance(wind=5.0, gusts=2.5, gain=0.25, delay=0.1, noise=0.5, mover=10.0)
Entry = dict[str, Any]


def digest(*arrays: np.ndarray) -> str:
    """Of every bit of some arrays."""
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()[:16]


def flight(name: str, pilot: str) -> Entry:
    """A mission in a bundled scene."""
    course = Course.mission(Scene.find(name), plan_order(Scene.find(name), "lkh"))
    flown = {
        "law": fly_law,
        "mpc": lambda course: fly_planner(course, Mpc(course)),
        "reference": lambda course: fly_planner(course, Reference(course)),
        "policy": _shipped,
    }
    made: Flight = flown[pilot](course)
    return {
        "digest": digest(made.trajectory.x, made.trajectory.v),
        "arrivals": list(made.arrivals),
        "success": made.success,
    }


def _shipped(course: Course) -> Flight:
    policy, _ = start_from(SHIPPED, LearnConfig())
    return fly(course, [policy] * len(course.guidance), policy.observation)


def slots(observation: str, disturbed: bool) -> Entry:
    """Random slots of a batch in two scenes, the second one's missions begun anew as they end."""
    courses = [
        Course.mission(scene, plan_order(scene, "lkh"))
        for scene in map(Scene.find, ("scenario_1", "city_6"))
    ]
    rng = np.random.default_rng(7)
    level = Disturbances(DISTURBED, 16, np.random.default_rng(5)) if disturbed else None
    simulations = Simulations(
        [courses[i % 2] for i in range(16)], 16, rules=Rules(observation, "lost"), start="spread",
        rng=np.random.default_rng(3), threads=1, disturbances=level,
    )  # fmt: skip
    simulations.reset()
    seen, rewards = [simulations.observe()], []
    for _ in range(SLOTS):
        outcome = simulations.step(rng.uniform(-1.0, 1.0, (16, 3)) * 0.6 + 0.4 * simulations.law())
        rewards.append(outcome.reward)
        simulations.reset(np.flatnonzero(outcome.terminated | outcome.truncated))
        seen.append(simulations.observe())
    simulations.close()
    return {
        "digest": digest(*seen, *rewards, simulations.state),
        "reward": float(np.sum(rewards)),
        "speed": float(np.linalg.norm(simulations.state[:, 4:7], axis=1).mean()),
    }


def trained(learner: str) -> Entry:
    """A policy after a few updates in the first segment of a bundled scene."""
    scene = Scene.find("scenario_1")
    course = Course.segment(scene, plan_order(scene, "lkh"), 3)
    settings = LearnConfig(updates=UPDATES, learner=learner, demonstrations=2000, actor_delay=50)
    trainer = segment_trainer(course, settings, 0)
    for _ in trainer.run():
        pass
    trainer.close()
    weights = [value.numpy() for value in trainer.learner.actor.state_dict().values()]
    return {"digest": digest(*weights), "size": float(sum(np.abs(w).sum() for w in weights))}


def parts() -> Iterator[tuple[str, Callable[[], Entry]]]:
    """All that is compared, by name."""
    for scene in SCENES:
        for pilot in PILOTS:
            yield f"{scene} {pilot}", lambda s=scene, p=pilot: flight(s, p)
    for observation in ("guided", "path", "paper", "robust"):
        yield f"slots {observation}", lambda o=observation: slots(o, False)
    yield "slots robust disturbed", lambda: slots("robust", True)
    yield "slots path disturbed", lambda: slots("path", True)
    for learner in ("lean", "torchrl"):
        yield f"trained {learner}", lambda name=learner: trained(name)


def main() -> int:
    """Write or compare; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", default="", help="parts whose name holds this")
    args = parser.parse_args()
    before = json.loads(args.against.read_text()) if args.against else {}
    found, differs = {}, 0
    for name, make in parts():
        if args.only in name:
            found[name] = make()
            if name in before and before[name] != found[name]:
                differs += 1
                print(f"{name}: {before[name]} before, now {found[name]}", flush=True)
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{len(found)} parts, {differs} differ")
    return 1 if differs else 0


if __name__ == "__main__":
    sys.exit(main())
