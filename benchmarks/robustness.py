"""Measures how flights stand disturbances: how they end, and how long they take.

    python -m benchmarks.robustness --out docs/results/robustness.json \
        --figure docs/images/robustness.png

Flies segments of generated scenes that no policy was trained on, from rest at the segment's start.
All pilots but the plain law fly with what is estimated in flight and countered, and with the shield
for disturbed air; those called `told` know gain, push, delay and position, and the moving boxes'
turns. All but the MPC, which flies one by one, meet the same draws.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from benchmarks.common import Row, grouped, in_processes, save, segment_course
from mjcollect.envs.batch import Simulations
from mjcollect.envs.course import Course
from mjcollect.envs.disturbed import ENDS, Pilot, by_policies
from mjcollect.envs.episode import Rules
from mjcollect.flight.disturbance import Disturbance, Disturbances
from mjcollect.flight.moving_boxes import MovingBoxes
from mjcollect.geometry.boxes import segment_box_distance
from mjcollect.learning.policy import DISTURBED, SHIPPED, TrainedPolicy, policy_digest, weights_file
from mjcollect.planners.mpc import Mpc
from mjcollect.render.time_figures import BLACK, BLUE, GREEN, LABEL, ORANGE, PURPLE, figure
from mjcollect.render.time_figures import save as save_figure
from mjcollect.scene.bounds import detour_bound
from train.generalist import HELD_OUT
from train.reproduction.tables import summary as mean_and_interval

# Title and unit of each kind of disturbance in the figure, and the levels that are flown.
KINDS: dict[str, tuple[str, str, tuple[float, ...]]] = {
    "all": ("all at once", "share of the greatest", (0.0, 0.25, 0.5, 0.75, 1.0)),
    "wind": ("steady wind", "m/s²", (0.0, 5.0)),
    "gusts": ("gusts", "m/s², standard deviation", (0.0, 2.5)),
    "gain": ("actuator gain", "share", (0.0, 0.25)),
    "delay": ("actuator delay", "s", (0.0, 0.1)),
    "noise": ("position noise", "m, standard deviation", (0.0, 0.5)),
    "mover": ("moving box", "m/s", (0.0, 2.5, 10.0, 20.0)),
}
GREATEST = Disturbance(wind=5.0, gusts=2.5, gain=0.25, delay=0.1, noise=0.5, mover=10.0)
LEVEL = ("pilot", "kind", "level")
# Colour and name in the figure of the pilots that there are without a file.
STYLES = {
    "law": (BLUE, "law"),
    "adaptive law": (PURPLE, "adaptive law"),
    "mpc": (ORANGE, "MPC"),
    "policy": (GREEN, "policy for disturbed air"),
    "calm policy": (BLACK, "policy for calm air"),
}
TOLD = "told "  # This before a pilot's name says that it knows what disturbs it.
BARE = "bare "  # This before a policy's name says that it never explores.
NOT_LEARNED = ("law", "adaptive law", "mpc")
FIRST = HELD_OUT + 10_000  # no policy was chosen by these segments either


@dataclass(frozen=True)
class Args:
    """Flies every pilot through every disturbance."""

    pilots: tuple[str, ...] = tuple(STYLES)
    """Pilots that fly: any of these, of which the policies are the package's own, files of others,
    policies with `bare ` before, which never explore, and all of them with `told ` before."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """Kinds of disturbance that are flown."""
    segments: int = 200
    """Number of segments, each of a generated scene of its own."""
    draws: int = 16
    """Flights on each segment at each level; of the slower MPC an eighth, on a fifth of the
    segments."""
    seed: int = 0
    """Seed of scenes and disturbances."""
    workers: int = 2
    """Processes that fly side by side."""
    guidance_cache: Path | None = None
    """Folder of guidance that is loaded where it fits."""
    out: Path | None = None
    """JSON file for the results. Every flight goes into a `.flights.json` beside it, segment by
    segment; what this already holds of the same pilots is not flown again."""
    figure: Path | None = None
    """PNG file for the curves."""


def mpc(course: Course) -> Pilot:
    """Returns a pilot of a single simulation that plans each flight from nothing."""
    planner = Mpc(course)

    def pilot(sims: Simulations) -> np.ndarray:
        nonlocal planner
        if sims.episodes.steps[0] == 0:
            planner = Mpc(course)
        return planner.action(sims.episodes)[None]

    return pilot


def prepare(name: str, course: Course) -> tuple[str, Pilot]:
    """Returns a pilot and its observation."""
    if name == "mpc":
        return "guided", mpc(course)
    if name in NOT_LEARNED:
        return "guided", Simulations.law
    explore = not name.startswith(BARE)
    policy = TrainedPolicy.load(weights_file(policy_file(name)))
    return policy.observation, by_policies([policy], explore=explore)


def policy_file(name: str) -> Path:
    """Returns the file of a pilot that is a policy."""
    name = name.removeprefix(BARE)
    return {"policy": DISTURBED, "calm policy": SHIPPED}.get(name, Path(name))


def reached_by_a_box(point: np.ndarray, radius: float, movers: MovingBoxes) -> np.ndarray:
    """Returns in which flights (N,) a moving box ever reaches a body that stays at a point (3,).

    Where none does, whoever waits there touches no moving box: contact could have been avoided.
    """
    ends = point - movers.path  # of the point's way as each box sees it
    box = np.stack([-movers.half, movers.half], axis=2)
    gap = segment_box_distance(ends[:, :, 0], ends[:, :, 1], box)
    return np.asarray(((gap <= radius) & (movers.speed > 0.0)).any(axis=1))


def fly(
    course: Course, pilot: Pilot, rules: Rules, disturbances: Disturbances
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Flies a course of one segment from rest at its start, once for each of the disturbances.

    Returns:
        How each ended, as indices (count,) of ENDS, the seconds (count,) until then, the share of
        the slots flown in which the shield gave way, and in how many flights a moving box comes to
        the start itself.
    """
    count = disturbances.count
    sims = Simulations([course], count, rules=rules, threads=1, disturbances=disturbances)
    sims.reset()
    start, radius = sims.episodes.truth[0].copy(), course.scene.reach
    hopeless = int(reached_by_a_box(start, radius, disturbances.movers).sum())
    running, ended = np.ones(count, bool), np.full(count, ENDS.index("too late"))
    slots, gave = np.zeros(count), 0
    while running.any():
        outcome = sims.step(pilot(sims))
        slots += running
        gave += int((running & (outcome.room < 1.0)).sum())
        slot = outcome.slot
        for end, those in (
            ("home", outcome.success),
            ("out of bounds", slot.outside),
            ("standing box", slot.contact),
            ("moving box", outcome.struck),
        ):
            ended[running & those] = ENDS.index(end)
        running &= ~(outcome.terminated | outcome.truncated)
    sims.close()
    return ended, slots * course.scene.slot, gave / float(slots.sum()), hopeless


def disturbance(kind: str, value: float) -> Disturbance:
    """Returns one kind of a strength, or a share of the greatest of every kind."""
    return GREATEST.times(value) if kind == "all" else Disturbance(**{kind: value})


def flights(course: Course, number: int, args: Args, pilot: str) -> list[Row]:
    """Flies one pilot through every level on one segment."""
    name = pilot.removeprefix(TOLD)
    observation, fly_by = prepare(name, course)
    told = "truth" if pilot != name else "none" if name == "law" else "flight"
    rules = Rules(observation, estimate=told)
    # The MPC is slow and holds a plan of its own: few flights, one by one.
    counts = [1] * max(args.draws // 8, 1) if name == "mpc" else [args.draws]
    detour = detour_bound(course.scene, *course.nodes, course.guidance[0].length)

    def measure(index: int, level: Disturbance) -> Row:
        results = []
        for group, count in enumerate(counts):
            rng = np.random.default_rng([args.seed, number, index, group])
            results.append(fly(course, fly_by, rules, Disturbances(level, count, rng)))
        ended, seconds = (np.concatenate([each[k] for each in results]) for k in range(2))
        home = ended == ENDS.index("home")
        ends = {end: int((ended == k).sum()) for k, end in enumerate(ENDS)}
        times = [
            round(float(t) / detour, 4) if ok else None for t, ok in zip(seconds, home, strict=True)
        ]
        gave = float(np.mean([each[2] for each in results]))
        row = {"flights": len(ended), **ends, "times": times, "gave_way": gave}
        return row | {"unavoidable": sum(each[3] for each in results)}

    calm = None
    rows = []
    for index, (kind, (_, _, levels)) in enumerate(KINDS.items()):
        for value in levels if kind in args.kinds else ():
            if value == 0.0:
                calm = calm or measure(0, Disturbance())
            found = calm if value == 0.0 else measure(index, disturbance(kind, value))
            assert found is not None
            named = {"pilot": pilot, "kind": kind, "level": value, "segment": number}
            rows.append({**named, **found})
    return rows


def fly_segment(args: Args, job: tuple[int, Sequence[str]]) -> list[Row]:
    """Returns the flights of some pilots on one segment; none where the guidance finds no way."""
    torch.set_num_threads(1)
    number, names = job
    course = segment_course(args.seed, number, guidance=args.guidance_cache)
    if course is None:
        return []
    return [row for name in names for row in flights(course, number, args, name)]


def summary(rows: Sequence[Row]) -> list[Row]:
    """Returns how flights ended, as shares, and their mean time by pilot, kind and level.

    `low` and `high` bound the share that comes home with 95%, over the segments; `unavoidable` is
    the share of flights whose start a moving box passes: at most so many had to touch one.
    """
    found = []
    for key, these in grouped(rows, *LEVEL).items():
        count = sum(row["flights"] for row in these)
        # Each segment counts once, whatever the number of its arrivals.
        home = [[time for time in row["times"] if time is not None] for row in these]
        times = [float(np.mean(own)) for own in home if own]
        interval = mean_and_interval([row["home"] / row["flights"] for row in these])
        found.append(
            {
                **dict(zip(LEVEL, key, strict=True)),
                "segments": len(these),
                "flights": count,
                **{end: sum(row[end] for row in these) / count for end in ENDS},
                "low": interval["low"],
                "high": interval["high"],
                "time": float(np.mean(times)) if times else None,
                "gave_way": float(np.mean([row["gave_way"] for row in these])),
                "unavoidable": sum(row["unavoidable"] for row in these) / count,
            }
        )
    return found


def differences(rows: Sequence[Row]) -> list[Row]:
    """Returns how policies compare with each other pilot, by level, on the same segments.

    `more` is how much more often they come home, in shares; `slower` the mean ratio of their times
    over flights with the same draws that both finish (of the MPC, which has draws of its own, over
    segments). The intervals are of 95% over the segments.
    """
    levels = {
        key: {row["segment"]: row for row in these} for key, these in grouped(rows, *LEVEL).items()
    }
    found = []
    for (pilot, *level), own in levels.items():
        if pilot.removeprefix(TOLD) in NOT_LEARNED:
            continue
        for peer in NOT_LEARNED:
            theirs = levels.get((peer, *level), {})
            pairs = [(row, theirs[number]) for number, row in own.items() if number in theirs]
            gains = [a["home"] / a["flights"] - b["home"] / b["flights"] for a, b in pairs]
            ratios = [ratio for a, b in pairs if (ratio := time_ratio(a["times"], b["times"]))]
            if not gains:
                continue
            gain, slower = mean_and_interval(gains), mean_and_interval(ratios)
            row = {"pilot": pilot, "peer": peer, "kind": level[0], "level": level[1]}
            row |= {"segments": gain["n"], "more": gain["mean"]}
            row |= {"low": gain["low"], "high": gain["high"], "slower": slower["mean"]}
            found.append(row | {"slower_low": slower["low"], "slower_high": slower["high"]})
    return found


def time_ratio(ours: Sequence[float | None], theirs: Sequence[float | None]) -> float | None:
    """Returns the ratio of mean times over the flights that both finish, None without any."""
    if len(ours) == len(theirs):
        both = [(a, b) for a, b in zip(ours, theirs, strict=True) if a and b]
        ours, theirs = [a for a, _ in both], [b for _, b in both]
    mine, other = ([time for time in times if time] for times in (ours, theirs))
    return float(np.mean(mine) / np.mean(other)) if mine and other else None


def draw(path: Path, found: Sequence[Row]) -> None:
    """Draws for each disturbance the success above, and the time of those that arrive below."""
    made = figure(12.5, 13.0)
    grid: Any = made.subplots(4, 4, gridspec_kw={"height_ratios": [3, 2, 3, 2]})
    names = list(dict.fromkeys(row["pilot"] for row in found))
    floor = min(0.9, min(row["home"] for row in found) - 0.02)
    others = iter(("#56B4E9", "#F0E442", "#D55E00"))
    styles = {name: STYLES.get(name) or (next(others), name) for name in names}
    for place, (kind, (title, unit, _)) in enumerate(KINDS.items()):
        success, time = grid[2 * (place // 4), place % 4], grid[2 * (place // 4) + 1, place % 4]
        for name, these in grouped([r for r in found if r["kind"] == kind], "pilot").items():
            x = [row["level"] for row in these]
            style = {"color": styles[name[0]][0], "marker": "o", "markersize": 3.5}
            success.plot(x, [row["home"] for row in these], **style)
            # Where hardly anything arrives, the time of what does says nothing.
            times = [row["time"] if row["home"] >= 0.5 else np.nan for row in these]
            time.plot(x, times, **style)
        success.set_title(title, **LABEL)
        success.set_ylim(floor, 1.0 + 0.05 * (1.0 - floor))
        time.set_ylim(1.0, 1.6)
        time.set_xlabel(unit, **LABEL)
        for axes in (success, time):
            axes.axvline(getattr(GREATEST, kind, 1.0), color=BLACK, linewidth=0.8, linestyle=":")
            axes.grid(color="#E0E0E0", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
    for row in (0, 2):
        grid[row, 0].set_ylabel("success rate", **LABEL)
        grid[row + 1, 0].set_ylabel("time / detour time", **LABEL)
    for axes in grid[2:, 3]:
        axes.set_visible(False)
    lines, labels = grid[0, 0].get_lines(), [label for _, label in styles.values()]
    made.tight_layout(h_pad=1.5)
    note = "dotted: the whole of 'all at once'"
    made.legend(lines, labels, loc="center", bbox_to_anchor=(0.88, 0.3), frameon=False, title=note)
    save_figure(made, path)


def settings(args: Args) -> Row:
    """Returns what flights in one file of flights have in common."""
    return {"draws": args.draws, "seed": args.seed, "kinds": list(args.kinds)}


def policies(pilots: Sequence[str]) -> dict[str, str]:
    """Returns the digests of those pilots that are policies."""
    names = (name.removeprefix(TOLD) for name in pilots)
    return {name: policy_digest(policy_file(name)) for name in names if name not in NOT_LEARNED}


def flown_before(every: Path | None, args: Args) -> list[Row]:
    """Returns the flights of an earlier call that this one would repeat.

    Raises:
        SystemExit: They were drawn in another way.
    """
    if every is None or not every.is_file():
        return []
    saved = json.loads(every.read_text())
    for field, given in settings(args).items():
        if saved[field] != given:
            raise SystemExit(f"--{field}: {given}: {every} has {saved[field]}; use another --out")
    now = policies(args.pilots)
    return [
        row
        for row in saved["flights"]
        if row["pilot"] in args.pilots
        and row["segment"] in range(FIRST, FIRST + args.segments)
        and now.get(row["pilot"].removeprefix(TOLD))
        == saved["policies"].get(row["pilot"].removeprefix(TOLD))
    ]


def main(args: Args) -> int:
    """Flies, counts, draws; returns 0."""
    every = None if args.out is None else args.out.with_suffix(".flights.json")
    rows, flown = flown_before(every, args), policies(args.pilots)
    how = {**settings(args), "policies": flown}
    done = {(row["segment"], row["pilot"]) for row in rows}
    few = range(FIRST, FIRST + max(args.segments // 5, 1))  # which the MPC flies
    jobs = [
        (number, names)
        for number in range(FIRST, FIRST + args.segments)
        if (
            names := [
                name
                for name in args.pilots
                if (number, name) not in done and (number in few or not name.endswith("mpc"))
            ]
        )
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
        ends = "  ".join(f"{end} {row[end]:.1%}" for end in ENDS)
        print(f"{row['pilot']:>22} {row['kind']:>6} {row['level']:5.2f}  {ends}  time {time}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
