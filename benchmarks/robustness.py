"""How flights stand disturbances: success and time against wind, gusts, gain, delay and noise.

    python -m benchmarks.robustness --out docs/results/robustness.json \
        --figure docs/images/robustness.png

Flies segments of generated scenes that no policy was trained on, from rest at the segment's start,
by the guidance law, by the law with the last slot's drift taken away (the base of the observation
`robust`), by policies (`--policies`), by the MPC and by the reference flown open loop. All but the
MPC, which flies one by one, meet the same draws.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.results import save
from mjcollect.batch import Simulations
from mjcollect.bounds import detour_bound
from mjcollect.charts import BLACK, BLUE, GREEN, LABEL, ORANGE, PURPLE, RED, figure
from mjcollect.charts import save as save_figure
from mjcollect.course import Course
from mjcollect.disturbance import Disturbance, Disturbances
from mjcollect.episode import Rules
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference import NoFlight, Reference
from train.generalist import HELD_OUT
from train.policies import TrainedPolicy
from train.pool import build_all, draw_leg

LEVELS: dict[str, tuple[float, ...]] = {
    "wind": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
    "gusts": (0.0, 1.0, 2.0, 3.0, 4.0),
    "gain": (0.0, 0.1, 0.2, 0.3),
    "delay": (0.0, 0.04, 0.08, 0.12, 0.16),
    "noise": (0.0, 0.25, 0.5, 1.0, 2.0),
}
UNITS = {"wind": "m/s²", "gusts": "m/s², standard deviation", "gain": "share", "delay": "s",
         "noise": "m, standard deviation"}  # fmt: skip
COLOURS = {"law": BLUE, "law against drift": PURPLE, "mpc": ORANGE, "reference, open loop": RED}
FIRST = HELD_OUT + 10_000  # no policy was chosen by these segments either
Pilot = Callable[[Simulations], np.ndarray]


@dataclass(frozen=True)
class Args:
    """Fly every pilot through every disturbance."""

    policies: tuple[Path, ...] = ()
    """Files of policies that fly too."""
    segments: int = 40
    """Segments, each of a generated scene of its own."""
    draws: int = 8
    """Flights on each segment at each level; of the slower MPC and the reference a quarter."""
    seed: int = 0
    """Seed of scenes and disturbances."""
    workers: int = 2
    """Processes that build the guidance."""
    out: Path | None = None
    """JSON file for the results."""
    figure: Path | None = None
    """PNG file for the curves."""


def law(sims: Simulations) -> np.ndarray:
    """The guidance law."""
    return sims.episodes.guidance_action()


def against_drift(sims: Simulations) -> np.ndarray:
    """The law, and what the last slot was off its command taken away."""
    episodes = sims.episodes
    return episodes.guidance_action() - episodes.drift / episodes.world.a_max


def learned(policy: TrainedPolicy) -> Pilot:
    """A policy."""
    return lambda sims: policy(sims.observe().astype(np.float32))


def planned(commands: np.ndarray) -> Pilot:
    """Commands (n, 3) in m/s^2 as they were planned, whatever happens; then none."""

    def pilot(sims: Simulations) -> np.ndarray:
        slot = int(sims.episodes.steps[0])
        a = commands[slot] if slot < len(commands) else np.zeros(3)
        return np.tile(a / sims.episodes.world.a_max[0], (sims.count, 1))

    return pilot


def fly(
    course: Course, pilot: Pilot, level: Disturbance, count: int, rng: np.random.Generator,
    observation: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Success, contact (count,) and seconds (count,) of flights from rest at the start."""
    disturbances = Disturbances(level, count, rng)
    rules = Rules(observation)
    sims = Simulations([course], count, rules=rules, threads=1, disturbances=disturbances)
    sims.place(np.arange(count), *course.starts("point", count, np.random.default_rng(0)))
    running, success, contact = np.ones(count, bool), np.zeros(count, bool), np.zeros(count, bool)
    slots = np.zeros(count)
    while running.any():
        outcome = sims.step(pilot(sims))
        slots += running
        success |= running & outcome.success
        contact |= running & outcome.slot.contact
        running &= ~(outcome.terminated | outcome.truncated)
    sims.close()
    return success, contact, slots * course.scene.slot


def mpc(course: Course) -> Pilot:
    """A new MPC, for a single flight."""
    planner = Mpc(course)
    return lambda sims: planner.action(sims.episodes)[None]


def flights(
    course: Course, number: int, args: Args, policies: dict[str, TrainedPolicy]
) -> list[dict[str, Any]]:
    """Every pilot through every level on one segment."""
    rows = []
    commands = None
    try:
        commands = Reference(course).plan()
    except NoFlight:
        print(f"segment {number}: the reference finds no flight", file=sys.stderr)
    frm, to = course.nodes
    detour = detour_bound(course.scene, frm, to, course.guidance[0].length)
    for kind, levels in LEVELS.items():
        for value in levels:
            level = Disturbance(**{kind: value})

            def one(
                name: str, pilot: Pilot, draws: range, observation: str = "guided",
                level: Disturbance = level, kind: str = kind, value: float = value,
            ) -> None:  # fmt: skip
                rng = np.random.default_rng(
                    [args.seed, number, list(LEVELS).index(kind), draws.start]
                )
                success, contact, seconds = fly(course, pilot, level, len(draws), rng, observation)
                rows.append(
                    {
                        "pilot": name, "kind": kind, "level": value, "segment": number,
                        "flights": len(draws), "success": int(success.sum()),
                        "contacts": int(contact.sum()),
                        "times": (seconds[success] / detour).round(4).tolist(),
                    }
                )  # fmt: skip

            everyone, few = range(args.draws), range(max(args.draws // 4, 1))
            one("law", law, everyone)
            one("law against drift", against_drift, everyone)
            for name, policy in policies.items():
                one(name, learned(policy), everyone, policy.observation)
            for draw in few:
                one("mpc", mpc(course), range(draw, draw + 1))
            if commands is not None:
                one("reference, open loop", planned(commands), everyone)
    return rows


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By pilot, kind and level: success rate, contacts, and mean time over detour time."""
    found = []
    for key in dict.fromkeys((row["pilot"], row["kind"], row["level"]) for row in rows):
        these = [row for row in rows if (row["pilot"], row["kind"], row["level"]) == key]
        count = sum(row["flights"] for row in these)
        # Each segment counts once, whatever the number of its arrivals.
        times = [float(np.mean(row["times"])) for row in these if row["times"]]
        found.append(
            {
                "pilot": key[0], "kind": key[1], "level": key[2], "flights": count,
                "success_rate": sum(row["success"] for row in these) / count,
                "contact_rate": sum(row["contacts"] for row in these) / count,
                "time": float(np.mean(times)) if times else None,
            }
        )  # fmt: skip
    return found


def draw(path: Path, found: list[dict[str, Any]]) -> None:
    """Success above, time below, a column for each disturbance."""
    made = figure(3.2 * len(LEVELS), 6.6)
    axes: Any = made.subplots(2, len(LEVELS), sharey="row")
    names = list(dict.fromkeys(row["pilot"] for row in found))
    spare = iter((GREEN, BLACK, "#56B4E9", "#F0E442"))
    for name in names:
        colour = COLOURS.get(name) or next(spare)
        for column, kind in enumerate(LEVELS):
            these = [row for row in found if row["pilot"] == name and row["kind"] == kind]
            x = [row["level"] for row in these]
            style = {"color": colour, "marker": "o", "markersize": 3.5, "label": name}
            axes[0, column].plot(x, [row["success_rate"] for row in these], **style)
            axes[1, column].plot(x, [row["time"] for row in these], **style)
    for column, kind in enumerate(LEVELS):
        axes[0, column].set_title(kind, **LABEL)
        axes[1, column].set_xlabel(UNITS[kind], **LABEL)
        for line in axes[:, column]:
            line.grid(color="#E0E0E0", linewidth=0.6)
    axes[0, 0].set_ylim(-0.04, 1.04)
    axes[0, 0].set_ylabel("success rate", **LABEL)
    axes[1, 0].set_ylabel("mean time / detour time", **LABEL)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    made.legend(handles, labels, loc="lower center", ncols=len(names), frameon=False)
    made.tight_layout(rect=(0, 0.06, 1, 1))
    save_figure(made, path)


def main(args: Args) -> int:
    """Build, fly, count, draw."""
    torch.set_num_threads(1)
    policies = {path.stem: TrainedPolicy.load(path) for path in args.policies}
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        numbers = range(FIRST, FIRST + args.segments)
        built = build_all(args.seed, numbers, Path(folder), args.workers)
        for number, ok in tqdm(built, total=args.segments):
            if ok:
                course = draw_leg(args.seed, number).course(Path(folder))
                rows += flights(course, number, args, policies)
    found = summary(rows)
    save(
        args.out,
        {"summary": found, "flights": rows},
        arguments=json.loads(json.dumps(asdict(args), default=str)),
    )
    if args.figure is not None:
        draw(args.figure, found)
    for row in found:
        time = "-" if row["time"] is None else f"{row['time']:.3f}"
        print(
            f"{row['pilot']:>22} {row['kind']:>6} {row['level']:5.2f}  "
            f"success {row['success_rate']:6.1%}  contact {row['contact_rate']:6.1%}  time {time}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
