"""Measures how flights stand disturbances: success and time against each kind, and against all.

    python -m benchmarks.robustness --out docs/results/robustness.json \
        --figure docs/images/robustness.png

Flies segments of generated scenes that no policy was trained on, from rest at the segment's start,
by the guidance law, by the law that adapts (the base of the observation `robust`), by policies, by
the MPC and by the reference flown open loop. The MPC is told of no disturbance, but sees every
slot's position, velocity and boxes. All but the MPC, which flies one by one, meet the same draws.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from benchmarks.common import Row, grouped, in_processes, save, segment_course
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference.reference import NoFlight, Reference
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, ORANGE, PURPLE, RED, figure
from mjcollect.render.time_figures import save as save_figure
from mjcollect.scene.bounds import detour_bound
from train.generalist import DISTURBANCE, HELD_OUT
from train.reproduction.tables import summary as mean_and_interval

# Title and unit of each kind of disturbance in the figure, and the levels that are flown.
KINDS: dict[str, tuple[str, str, tuple[float, ...]]] = {
    "wind": ("steady wind", "m/s²", (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)),
    "gusts": ("gusts", "m/s², standard deviation", (0.0, 1.0, 2.0, 3.0, 4.0)),
    "gain": ("actuator gain", "share", (0.0, 0.1, 0.2, 0.3)),
    "delay": ("actuator delay", "s", (0.0, 0.04, 0.08, 0.12, 0.16)),
    "noise": ("position noise", "m, standard deviation", (0.0, 0.25, 0.5, 1.0, 2.0)),
    "mover": ("moving box", "m/s", (0.0, 2.5, 5.0, 10.0, 20.0)),
    "all": ("all at once", "share of the greatest", (0.0, 0.25, 0.5, 0.75, 1.0)),
}
LEVEL = ("pilot", "kind", "level")
# Colour and name in the figure of the pilots that there are without a file.
STYLES = {
    "reference": (RED, "reference, open loop"),
    "law": (BLUE, "law"),
    "adaptive law": (PURPLE, "adaptive law"),
    "mpc": (ORANGE, "MPC"),
    "policy": (GREEN, "shipped policy"),
}
NOT_LEARNED = ("reference", "law", "adaptive law", "mpc")
FIRST = HELD_OUT + 10_000  # no policy was chosen by these segments either
Pilot = Callable[[Simulations], np.ndarray]  # actions (count, 3), |a| <= 1


@dataclass(frozen=True)
class Args:
    """Flies every pilot through every disturbance."""

    pilots: tuple[str, ...] = tuple(STYLES)
    """Pilots that fly: any of these, of which `policy` is the one shipped, and files of others."""
    segments: int = 40
    """Number of segments, each of a generated scene of its own."""
    draws: int = 16
    """Flights on each segment at each level; of the slower MPC an eighth."""
    seed: int = 0
    """Seed of scenes and disturbances."""
    workers: int = 2
    """Processes that fly side by side."""
    out: Path | None = None
    """JSON file for the results. Every flight goes into a `.flights.json` beside it, segment by
    segment; what this already holds of the same pilots is not flown again."""
    figure: Path | None = None
    """PNG file for the curves."""


def open_loop(commands: np.ndarray) -> Pilot:
    """Returns a pilot of commands (n, 3) in m/s^2, whatever happens; of none after them."""

    def pilot(sims: Simulations) -> np.ndarray:
        slot = int(sims.episodes.steps[0])
        a = commands[slot] if slot < len(commands) else np.zeros(3)
        return np.tile(a / sims.episodes.world.a_max[0], (sims.count, 1))

    return pilot


def mpc(course: Course) -> Pilot:
    """Returns a pilot of a single simulation that plans each flight from nothing."""
    planner = Mpc(course)

    def pilot(sims: Simulations) -> np.ndarray:
        nonlocal planner
        if sims.episodes.steps[0] == 0:
            planner = Mpc(course)
        planner.see(sims.episodes.boxes[0])
        return planner.action(sims.episodes)[None]

    return pilot


def prepare(name: str, course: Course) -> tuple[str, Pilot]:
    """Returns a pilot and its observation.

    Raises:
        NoFlight: The reference finds none.
    """
    if name == "reference":
        return "guided", open_loop(Reference(course).plan())
    if name == "mpc":
        return "guided", mpc(course)
    if name in NOT_LEARNED:  # the law adapts where the observation does
        return "robust" if name == "adaptive law" else "guided", Simulations.law
    policy = TrainedPolicy.load(weights_file(policy_file(name)))
    return policy.observation, lambda sims: policy(sims.observe().astype(np.float32))


def policy_file(name: str) -> Path:
    """Returns the file of a pilot that is a policy."""
    return SHIPPED if name == "policy" else Path(name)


def fly(
    course: Course, pilot: Pilot, rules: Rules, disturbances: Disturbances
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flies a course of one segment from rest at its start, once for each of the disturbances.

    Returns:
        Success, contact (count,) Boolean and the seconds (count,) until it ended.
    """
    count = disturbances.count
    sims = Simulations([course], count, rules=rules, threads=1, disturbances=disturbances)
    sims.reset()
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


def disturbance(kind: str, value: float) -> Disturbance:
    """Returns one kind of a strength, or a share of the greatest of every kind in training."""
    if kind == "all":
        return Disturbance(**{k: value * v for k, v in asdict(DISTURBANCE).items()})
    return Disturbance(**{kind: value})


def flights(course: Course, number: int, args: Args, name: str) -> list[Row]:
    """Flies one pilot through every level on one segment; returns no rows if it finds no flight."""
    try:
        observation, pilot = prepare(name, course)
    except NoFlight:
        return []
    rules = Rules(observation, shield=name not in ("reference", "mpc"))
    # The MPC is slow and holds a plan of its own: few flights, one by one.
    counts = [1] * max(args.draws // 8, 1) if name == "mpc" else [args.draws]
    detour = detour_bound(course.scene, *course.nodes, course.guidance[0].length)

    def measure(index: int, level: Disturbance) -> Row:
        results = []
        for group, count in enumerate(counts):
            rng = np.random.default_rng([args.seed, number, index, group])
            results.append(fly(course, pilot, rules, Disturbances(level, count, rng)))
        success, contact, seconds = (np.concatenate(part) for part in zip(*results, strict=True))
        times = (seconds[success] / detour).round(4).tolist()
        won, contacts = int(success.sum()), int(contact.sum())
        return {"flights": len(success), "success": won, "contacts": contacts, "times": times}

    calm = measure(0, Disturbance())
    return [
        {"pilot": name, "kind": kind, "level": value, "segment": number}
        | (measure(index, disturbance(kind, value)) if value > 0.0 else calm)
        for index, (kind, (_, _, levels)) in enumerate(KINDS.items())
        for value in levels
    ]


def fly_segment(args: Args, job: tuple[int, Sequence[str]]) -> list[Row]:
    """Flies some pilots on one segment; returns no rows where the guidance finds no way."""
    torch.set_num_threads(1)
    number, names = job
    course = segment_course(args.seed, number)
    if course is None:
        return []
    return [row for name in names for row in flights(course, number, args, name)]


def summary(rows: Sequence[Row]) -> list[Row]:
    """Returns success rate, contacts and mean time over detour time by pilot, kind and level."""
    found = []
    for key, these in grouped(rows, *LEVEL).items():
        count = sum(row["flights"] for row in these)
        # Each segment counts once, whatever the number of its arrivals.
        times = [float(np.mean(row["times"])) for row in these if row["times"]]
        found.append(
            {
                **dict(zip(LEVEL, key, strict=True)),
                "flights": count,
                "success_rate": sum(row["success"] for row in these) / count,
                "contact_rate": sum(row["contacts"] for row in these) / count,
                "time": float(np.mean(times)) if times else None,
            }
        )
    return found


def differences(rows: Sequence[Row]) -> list[Row]:
    """Returns how much more often policies arrive than the adaptive law, in shares, by level.

    The intervals are of 95% over the segments, as of every mean in `train.reproduce`.
    """
    levels = {
        key: {row["segment"]: row["success"] / row["flights"] for row in these}
        for key, these in grouped(rows, *LEVEL).items()
    }
    found = []
    for (pilot, *level), own in levels.items():
        law = levels.get(("adaptive law", *level), {})
        gains = [rate - law[segment] for segment, rate in own.items() if segment in law]
        if gains and pilot not in NOT_LEARNED:
            gain = mean_and_interval(gains)
            row = dict(zip(LEVEL, (pilot, *level), strict=True)) | {"segments": gain["n"]}
            found.append(row | {"more": gain["mean"], "low": gain["low"], "high": gain["high"]})
    return found


def draw(path: Path, found: Sequence[Row]) -> None:
    """Draws for each disturbance the success above, and the time of those that arrive below."""
    made = figure(12.5, 13.0)
    grid: Any = made.subplots(4, 4, gridspec_kw={"height_ratios": [3, 2, 3, 2]})
    names = list(dict.fromkeys(row["pilot"] for row in found))
    others = iter((BLACK, "#56B4E9", "#F0E442"))
    styles = {name: STYLES.get(name) or (next(others), name) for name in names}
    for place, (kind, (title, unit, _)) in enumerate(KINDS.items()):
        success, time = grid[2 * (place // 4), place % 4], grid[2 * (place // 4) + 1, place % 4]
        for name, these in grouped([r for r in found if r["kind"] == kind], "pilot").items():
            x = [row["level"] for row in these]
            style = {"color": styles[name[0]][0], "marker": "o", "markersize": 3.5}
            success.plot(x, [row["success_rate"] for row in these], **style)
            # Where hardly anything arrives, the time of what does says nothing.
            times = [row["time"] if row["success_rate"] >= 0.5 else np.nan for row in these]
            time.plot(x, times, **style)
        success.set_title(title, **LABEL)
        success.set_ylim(-0.04, 1.04)
        time.set_ylim(1.0, 1.6)
        time.set_xlabel(unit, **LABEL)
        for axes in (success, time):
            axes.axvline(getattr(DISTURBANCE, kind, 1.0), color=BLACK, linewidth=0.8, linestyle=":")
            axes.grid(color="#E0E0E0", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
    for row in (0, 2):
        grid[row, 0].set_ylabel("success rate", **LABEL)
        grid[row + 1, 0].set_ylabel("time / detour time", **LABEL)
    for axes in grid[2:, 3]:
        axes.set_visible(False)
    lines, labels = grid[0, 0].get_lines(), [label for _, label in styles.values()]
    made.tight_layout(h_pad=1.5)
    note = "dotted: the greatest\nthat the policy was trained with"
    made.legend(lines, labels, loc="center", bbox_to_anchor=(0.88, 0.3), frameon=False, title=note)
    save_figure(made, path)


def policies(pilots: Sequence[str]) -> dict[str, str]:
    """Returns the digests of those pilots that are policies."""
    return {name: policy_digest(policy_file(name)) for name in pilots if name not in NOT_LEARNED}


def flown_before(every: Path | None, args: Args) -> list[Row]:
    """Returns the flights of an earlier call that this one would repeat.

    Raises:
        SystemExit: They were drawn in another way.
    """
    if every is None or not every.is_file():
        return []
    saved = json.loads(every.read_text())
    for field in ("draws", "seed"):
        if saved[field] != (given := getattr(args, field)):
            raise SystemExit(f"--{field}: {given}: {every} has {saved[field]}; use another --out")
    now = policies(args.pilots)
    return [
        row
        for row in saved["flights"]
        if row["pilot"] in args.pilots
        and row["segment"] in range(FIRST, FIRST + args.segments)
        and now.get(row["pilot"]) == saved["policies"].get(row["pilot"])
    ]


def main(args: Args) -> int:
    """Flies, counts, draws; returns 0."""
    every = None if args.out is None else args.out.with_suffix(".flights.json")
    rows, flown = flown_before(every, args), policies(args.pilots)
    how = {"draws": args.draws, "seed": args.seed, "policies": flown}
    done = {(row["segment"], row["pilot"]) for row in rows}
    jobs = [
        (number, names)
        for number in range(FIRST, FIRST + args.segments)
        if (names := [name for name in args.pilots if (number, name) not in done])
    ]
    for found in in_processes(partial(fly_segment, args), jobs, args.workers):
        rows += found
        save(every, {**how, "flights": rows})
    rows.sort(key=lambda row: args.pilots.index(row["pilot"]))
    found = summary(rows)
    save(args.out, {"policies": flown, "summary": found, "differences": differences(rows)}, args)
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
