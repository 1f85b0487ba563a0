"""Measures what each deviation from the paper is worth: one at a time is set back to its way.

    python -m benchmarks.deviations --out docs/results/deviations.json

The numbers are those of docs/deviations.md; the ones without a flag are missing. Each cell is one
run of `train.segment`, with its command in the JSON. Cells that the JSON holds already are not run
again. Prints a table, and says how each change compares with our settings on the same segments and
seeds.
"""

from __future__ import annotations

import json
import shlex
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.common import Row, grouped, load_rows, save
from mjcollect.envs.course import Course
from mjcollect.scene.order import first_blocked, plan_order
from mjcollect.scene.scene import Scene
from train.jobs.workers import Done, Job, LocalWorkers, run_jobs, settings_arguments
from train.support.command_line import INTERRUPTED, say
from train.support.markdown import markdown_table
from train.support.presets import PAPER, with_slot

KEPT = (
    "success", "success_rate", "time", "detour_time", "lower_bound", "contacts", "shield_share",
    "best_mean_time", "last_mean_time", "last_success_rate", "updates", "env_steps",
    "train_seconds",
)  # fmt: skip
COLUMNS = (
    "deviation", "set to the paper's way", "flights with success", "success rate",
    "time / detour time", "against ours", "updates", "training (s)",
)  # fmt: skip


@dataclass(frozen=True)
class Change:
    """Says what is set to the paper's way.

    Attributes:
        number: The deviation's in docs/deviations.md; empty for none; or all, and all but one.
        name: What the table calls it.
        flags: The flags of train.segment that set it.
        slot: Seconds of a slot in place of the scene's.
    """

    number: str
    name: str
    flags: tuple[str, ...] = ()
    slot: float | None = None


def paper(*fields: str) -> tuple[str, ...]:
    """Returns the flags that set these settings to the paper's way."""
    return tuple(settings_arguments({name: PAPER[name] for name in fields}))


OURS = Change("", "our settings")
CHANGES = (
    OURS,
    Change("1", "slot of 1 s", slot=1.0),
    Change("7", "paper's reward", paper("reward")),
    Change("8", "paper's state", paper("observation")),
    Change("9, 19", "one simulation, thus one noise", paper("envs", "u1", "noise_min")),
    Change("10", "no demonstrations", paper("demonstrations", "guided_share")),
    Change("11", "plain gradient steps", paper("optimizer")),
    Change("11", "constant learning rates", paper("final_rate")),
    Change("11", "actor from the start", paper("actor_delay")),
    Change("12", "last policy flown", paper("flown")),
    Change("13", "no shield", paper("shield")),
    Change("18", "no averaged actor", paper("average_rate")),
    Change("19", "one noise for all", paper("noise_min")),
    Change("all", "--preset paper, slot of 0.2 s", ("--preset", "paper"), 0.2),
    Change("all", "--preset paper, slot of 1 s", ("--preset", "paper"), 1.0),
    Change("all but 13", "--preset paper --shield", ("--preset", "paper", "--shield"), 0.2),
)


@dataclass(frozen=True)
class Args:
    """Learns the same segments with one thing at a time set back to the paper's way."""

    segments: tuple[str, ...] = ("scenario_1", "city_6")
    """Scenes, of which the first blocked segment is learned, or SCENE:SEGMENT."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the trainings, of which each segment has one for each seed."""
    updates: int = 2_500
    """Most updates that a run may make."""
    only: tuple[int, ...] = ()
    """Positions in the table of the changes to run, from 0, which is our settings; default: all."""
    workers: int = 1
    """Number of runs side by side."""
    out: Path | None = None
    """JSON file for the results; cells that it holds already are not run again."""


@dataclass(frozen=True)
class Cell:
    """Names one run: a change on a segment with a seed."""

    change: Change
    scene: str
    segment: int
    seed: int
    updates: int

    @property
    def arguments(self) -> tuple[str, ...]:
        """Returns the run's arguments of train.segment."""
        slot = () if self.change.slot is None else ("--slot", str(self.change.slot))
        return (
            "--scene", self.scene, "--segment", str(self.segment), "--seed", str(self.seed),
            "--updates", str(self.updates), "--extra-updates", "0", "--no-video",
            *self.change.flags, *slot,
        )  # fmt: skip

    @property
    def command(self) -> str:
        """Returns the command line by which anyone can repeat the run."""
        return shlex.join(("python", "-m", "train.segment", *self.arguments))


def plan(args: Args) -> list[Cell]:
    """Returns all cells, in the order in which they are run.

    Raises:
        ValueError: A segment is no number, or there is no such change.
    """
    chosen = args.only or range(len(CHANGES))
    if not all(0 <= index < len(CHANGES) for index in chosen):
        raise ValueError(f"--only: {args.only}: must be 0 to {len(CHANGES) - 1}")
    where = []
    for text in args.segments:
        name, _, number = text.partition(":")
        scene = Scene.find(name)
        order = plan_order(scene, "lkh")
        if number and not (number.isdigit() and int(number) <= len(order)):
            raise ValueError(f"--segments: {text}: {number!r} must be 0 to {len(order)}")
        where.append((name, int(number) if number else first_blocked(scene, order)))
    return [
        Cell(CHANGES[index], scene, segment, seed, args.updates)
        for index in chosen
        for scene, segment in where
        for seed in args.seeds
    ]


def run(cells: Sequence[Cell], results: dict[str, Row], args: Args) -> int:
    """Runs the cells that `results` (by command) does not hold.

    Returns:
        0, 1 if a run ended with an error (the others go on), 130 if Ctrl-C stopped it.
    """
    todo = [cell for cell in cells if cell.command not in results]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        guidance = folder / "guidance"  # shared: it does not depend on how the learner is set
        for scene, segment, slot in {(c.scene, c.segment, c.change.slot): None for c in todo}:
            changed = with_slot(Scene.find(scene), slot)
            Course.segment(changed, plan_order(changed, "lkh"), segment).save_guidance(guidance)
        jobs = [
            Job(i, (*cell.arguments, "--guidance-cache", str(guidance)), folder / str(i))
            for i, cell in enumerate(todo)
        ]

        def finished(done: Done) -> None:
            cell, path = todo[done.job.index], done.job.folder / "segment.json"
            if not path.is_file():
                say(f"error: {cell.command}: exit code {done.code}: {done.message}")
                return
            results[cell.command] = row(cell, json.loads(path.read_text()))
            have = sum(each.command in results for each in cells)
            say(f"{have} of {len(cells)} cells: {cell.change.name}, {done.message}")
            save(args.out, {"results": list(results.values())}, args)

        if not run_jobs(LocalWorkers(args.workers), jobs, finished):
            return INTERRUPTED
    return 0 if all(cell.command in results for cell in cells) else 1


def row(cell: Cell, result: Row) -> Row:
    """Returns a cell's entry in the JSON."""
    named = {"deviation": cell.change.number, "change": cell.change.name, "scene": cell.scene}
    place = {"segment": cell.segment, "seed": cell.seed, "command": cell.command}
    return named | place | {key: result[key] for key in KEPT}


def table(rows: Sequence[Row]) -> list[str]:
    """Returns the lines of the table: a line for each change, means over its cells."""
    ours = ratios([each for each in rows if each["change"] == OURS.name])
    lines = []
    for (number, name), found in grouped(rows, "deviation", "change").items():
        reached = ratios(found)
        against = [100 * (reached[place] / ours[place] - 1) for place in reached if place in ours]
        lines.append(
            (
                number or "-",
                name,
                f"{len(reached)} of {len(found)}",
                _mean([each["success_rate"] for each in found], ".2f"),
                _mean(list(reached.values()), ".3f"),
                _mean(against, "+.1f") + (" %" if against else ""),
                _mean([each["updates"] for each in found], ".0f"),
                _mean([each["train_seconds"] for each in found], ".0f"),
            )
        )
    return markdown_table(COLUMNS, lines)


def ratios(rows: Sequence[Row]) -> dict[tuple[str, int, int], float]:
    """Returns time over detour time by scene, segment and seed, of one change's successes."""
    return {
        (each["scene"], each["segment"], each["seed"]): each["time"] / each["detour_time"]
        for each in rows
        if each["success"]
    }


def _mean(values: Sequence[float], form: str) -> str:
    return f"{statistics.mean(values):{form}}" if values else "-"


def main(args: Args) -> int:
    """Runs, prints, saves; returns the exit code."""
    try:
        cells = plan(args)
    except ValueError as error:
        say(f"error: {error}")
        return 2
    results = {each["command"]: each for each in load_rows(args.out)}
    code = run(cells, results, args)
    asked = [results[cell.command] for cell in cells if cell.command in results]
    print("\n".join(table(asked)))
    print(
        "\nMeans; the success rate is over 32 starts, the times over flights with success. "
        "'against ours': the same segments and seeds, where both arrived."
    )
    return code


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
