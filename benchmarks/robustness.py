"""How flights stand disturbances: success and time against each kind, and against all at once.

    python -m benchmarks.robustness --out docs/results/robustness.json \
        --figure docs/images/robustness.png

Flies segments of generated scenes that no policy was trained on, from rest at the segment's start,
by the guidance law, by the law that adapts (the base of the observation `robust`), by policies, by
the MPC and by the reference flown open loop. The MPC is told of no disturbance, but sees every
slot's position, velocity and boxes. All but the MPC, which flies one by one, meet the same draws.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.results import save
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.guidance.guidance import GuidanceError
from mjcollect.learning.policy import SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.planners.mpc import Mpc
from mjcollect.planners.reference.reference import NoFlight, Reference
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, ORANGE, PURPLE, RED, figure
from mjcollect.render.time_figures import save as save_figure
from mjcollect.scene.bounds import detour_bound
from train.generalist import DISTURBANCE, HELD_OUT
from train.jobs.processes import importing_pool
from train.jobs.segment_pool import draw_segment
from train.reproduction.tables import summary as mean_and_interval

LEVELS: dict[str, tuple[float, ...]] = {
    "wind": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
    "gusts": (0.0, 1.0, 2.0, 3.0, 4.0),
    "gain": (0.0, 0.1, 0.2, 0.3),
    "delay": (0.0, 0.04, 0.08, 0.12, 0.16),
    "noise": (0.0, 0.25, 0.5, 1.0, 2.0),
    "mover": (0.0, 2.5, 5.0, 10.0, 20.0),
    "all": (0.0, 0.25, 0.5, 0.75, 1.0),
}
UNITS = {"wind": "m/s²", "gusts": "m/s², standard deviation", "gain": "share", "delay": "s",
         "noise": "m, standard deviation", "mover": "m/s",
         "all": "share of the greatest"}  # fmt: skip
TITLES = {"wind": "steady wind", "gusts": "gusts", "gain": "actuator gain",
          "delay": "actuator delay", "noise": "position noise", "mover": "moving box",
          "all": "all at once"}  # fmt: skip
COLOURS = {"law": BLUE, "adaptive law": PURPLE, "mpc": ORANGE, "reference": RED,
           "policy": GREEN}  # fmt: skip
LEGEND = {"mpc": "MPC", "reference": "reference, open loop", "policy": "shipped policy"}
FIRST = HELD_OUT + 10_000  # no policy was chosen by these segments either
OTHERS = ("reference", "law", "adaptive law", "mpc")  # pilots that are no policies
Pilot = Callable[[Simulations], np.ndarray]


@dataclass(frozen=True)
class Args:
    """Fly every pilot through every disturbance."""

    pilots: tuple[str, ...] = ("reference", "law", "adaptive law", "mpc", "policy")
    """Who flies: any of these, of which `policy` is the one shipped, and files of others."""
    segments: int = 40
    """Segments, each of a generated scene of its own."""
    draws: int = 16
    """Flights on each segment at each level; of the slower MPC an eighth."""
    seed: int = 0
    """Seed of scenes and disturbances."""
    workers: int = 2
    """Processes."""
    out: Path | None = None
    """JSON file for the results. Every flight goes into a `.flights.json` beside it, segment by
    segment; what this already holds of the same pilots is not flown again."""
    figure: Path | None = None
    """PNG file for the curves."""


def law(sims: Simulations) -> np.ndarray:
    """The guidance law; the one that adapts where the observation does."""
    return sims.episodes.guidance_action()


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
    observation: str, shield: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Success, contact (count,) and seconds (count,) of flights from rest at the start."""
    disturbances = Disturbances(level, count, rng)
    rules = Rules(observation, shield=shield)
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

    def pilot(sims: Simulations) -> np.ndarray:
        planner.see(sims.episodes.boxes[0])
        return planner.action(sims.episodes)[None]

    return pilot


def disturbance(kind: str, value: float) -> Disturbance:
    """One kind of a strength, or a share of the greatest of every kind in training."""
    if kind == "all":
        return Disturbance(**{k: value * v for k, v in asdict(DISTURBANCE).items()})
    return Disturbance(**{kind: value})


def flights(
    course: Course, number: int, args: Args, pilots: dict[str, tuple[str, Callable[[], Pilot]]]
) -> list[dict[str, Any]]:
    """Every one of `pilots`, observation and maker, through every level on one segment."""
    rows: list[dict[str, Any]] = []
    detour = detour_bound(course.scene, *course.nodes, course.guidance[0].length)
    for name, (observation, make) in pilots.items():
        calm, shield = None, name not in ("reference", "mpc")
        # The MPC is slow and holds a plan of its own: few flights, one by one.
        groups = [[k] for k in range(max(args.draws // 8, 1))] if name == "mpc" else []
        for index, (kind, levels) in enumerate(LEVELS.items()):
            for value in levels:
                row = {"pilot": name, "kind": kind, "level": value, "segment": number}
                if value == 0.0 and calm is not None:
                    rows.append(calm | row)
                    continue
                results = []
                for group in groups or [range(args.draws)]:
                    rng = np.random.default_rng([args.seed, number, index, group[0]])
                    level = disturbance(kind, value)
                    flown = fly(course, make(), level, len(group), rng, observation, shield)
                    results.append(flown)
                success, contact, seconds = (
                    np.concatenate(part) for part in zip(*results, strict=True)
                )
                row |= {
                    "flights": len(success), "success": int(success.sum()),
                    "contacts": int(contact.sum()),
                    "times": (seconds[success] / detour).round(4).tolist(),
                }  # fmt: skip
                calm = row if value == 0.0 else calm
                rows.append(row)
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


def differences(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How much more often policies arrive than the adaptive law, in shares, kind by kind.

    With intervals of 95% over the segments, as of every mean in `train.reproduce`.
    """
    rate = {
        (row["pilot"], row["kind"], row["level"], row["segment"]): row["success"] / row["flights"]
        for row in rows
    }
    found = []
    for pilot, kind, level in dict.fromkeys(key[:3] for key in rate if key[0] not in OTHERS):
        own = [key for key in rate if key[:3] == (pilot, kind, level)]
        pairs = [(rate[key], rate.get(("adaptive law", *key[1:]))) for key in own]
        gain = mean_and_interval([mine - law for mine, law in pairs if law is not None])
        if not gain["n"]:
            continue
        found.append(
            {
                "pilot": pilot, "kind": kind, "level": level, "segments": gain["n"],
                "more": gain["mean"], "low": gain["low"], "high": gain["high"],
            }
        )  # fmt: skip
    return found


def draw(path: Path, found: list[dict[str, Any]]) -> None:
    """For each disturbance the success above, and the time of those that arrive below."""
    made = figure(12.5, 13.0)
    grid: Any = made.subplots(4, 4, gridspec_kw={"height_ratios": [3, 2, 3, 2]})
    names = list(dict.fromkeys(row["pilot"] for row in found))
    spare = iter((BLACK, "#56B4E9", "#F0E442"))
    colours = {name: COLOURS.get(name) or next(spare) for name in names}
    for place, kind in enumerate(LEVELS):
        success, time = grid[2 * (place // 4), place % 4], grid[2 * (place // 4) + 1, place % 4]
        for name in names:
            these = [row for row in found if row["pilot"] == name and row["kind"] == kind]
            x = [row["level"] for row in these]
            style = {"color": colours[name], "marker": "o", "markersize": 3.5}
            # Where hardly anything arrives, the time of what does says nothing.
            times = [row["time"] if row["success_rate"] >= 0.5 else None for row in these]
            success.plot(x, [row["success_rate"] for row in these], **style)
            time.plot(x, [np.nan if t is None else t for t in times], **style)
        success.set_title(TITLES[kind], **LABEL)
        success.set_ylim(-0.04, 1.04)
        time.set_ylim(1.0, 1.6)
        time.set_xlabel(UNITS[kind], **LABEL)
        greatest = 1.0 if kind == "all" else getattr(DISTURBANCE, kind)
        for axes in (success, time):
            axes.axvline(greatest, color=BLACK, linewidth=0.8, linestyle=":")
            axes.grid(color="#E0E0E0", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
    for row in (0, 2):
        grid[row, 0].set_ylabel("success rate", **LABEL)
        grid[row + 1, 0].set_ylabel("time / detour time", **LABEL)
    for axes in grid[2:, 3]:
        axes.set_visible(False)
    lines = grid[0, 0].get_lines()
    labels = [LEGEND.get(name, name) for name in names]
    made.tight_layout(h_pad=1.5)
    note = "dotted: the greatest\nthat the policy was trained with"
    made.legend(lines, labels, loc="center", bbox_to_anchor=(0.88, 0.3), frameon=False, title=note)
    save_figure(made, path)


def one_segment(args: Args, job: tuple[int, Sequence[str]]) -> list[dict[str, Any]]:
    """Every flight of some pilots on one segment; none where the guidance finds no way."""
    torch.set_num_threads(1)
    number, names = job
    leg = draw_segment(args.seed, number)
    with tempfile.TemporaryDirectory() as nowhere, contextlib.suppress(GuidanceError):
        course = leg.course(Path(nowhere))
        pilots: dict[str, tuple[str, Callable[[], Pilot]]] = {}
        for name in names:
            if name in ("law", "adaptive law"):
                pilots[name] = ("guided" if name == "law" else "robust", lambda: law)
            elif name == "mpc":
                pilots[name] = ("guided", lambda: mpc(course))
            elif name == "reference":
                with contextlib.suppress(NoFlight):
                    commands = Reference(course).plan()
                    pilots[name] = ("guided", lambda commands=commands: planned(commands))
            else:
                file = SHIPPED if name == "policy" else Path(name)
                policy = TrainedPolicy.load(weights_file(file))
                pilots[name] = (policy.observation, lambda policy=policy: learned(policy))
        return flights(course, number, args, pilots)
    return []


def policies(pilots: Sequence[str]) -> dict[str, str]:
    """Digests of those pilots that are policies."""
    files = {name: SHIPPED if name == "policy" else Path(name) for name in pilots}
    return {name: policy_digest(file) for name, file in files.items() if name not in OTHERS}


def flown_before(every: Path | None, args: Args) -> list[dict[str, Any]]:
    """Flights of an earlier call that this one would repeat.

    Raises:
        SystemExit: they were drawn in another way.
    """
    if every is None or not every.is_file():
        return []
    saved = json.loads(every.read_text())
    for field, value in (("draws", args.draws), ("seed", args.seed)):
        if saved[field] != value:
            raise SystemExit(f"--{field}: {value}: {every} has {saved[field]}; use another --out")
    now = policies(args.pilots)
    numbers = range(FIRST, FIRST + args.segments)
    return [
        row
        for row in saved["flights"]
        if row["pilot"] in args.pilots
        and row["segment"] in numbers
        and now.get(row["pilot"]) == saved["policies"].get(row["pilot"])
    ]


def main(args: Args) -> int:
    """Fly, count, draw."""
    every = None if args.out is None else args.out.with_suffix(".flights.json")
    rows, drawn = flown_before(every, args), {"draws": args.draws, "seed": args.seed}
    flown = policies(args.pilots)
    done = {(row["segment"], row["pilot"]) for row in rows}
    jobs = [
        (number, names)
        for number in range(FIRST, FIRST + args.segments)
        if (names := [name for name in args.pilots if (number, name) not in done])
    ]
    with importing_pool(args.workers) as pool:
        for found in tqdm(pool.map(partial(one_segment, args), jobs), total=len(jobs)):
            rows += found
            save(every, {**drawn, "policies": flown, "flights": rows})
    rows.sort(key=lambda row: args.pilots.index(row["pilot"]))
    found = summary(rows)
    save(
        args.out,
        {"policies": flown, "summary": found, "differences": differences(rows)},
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
