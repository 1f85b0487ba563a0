"""Regenerates every table and figure of the paper with one command.

    python -m train.reproduce --quick --out DIR
    python -m train.reproduce --out DIR --workers 8 --resume

It flies every cell (scene, visiting order, planner, training seed) that the folder does not hold
yet, each as a `train.mission` or `train.fly` of its own, then writes results.json, the figures and
reproduction.md. What became of the paper's claims is written by hand: docs/reproduction.md.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from mjcollect.scene.order import TourError, plan_order
from mjcollect.scene.shortest_tour import MAX_EXACT
from train.jobs.workers import connect_ray
from train.reproduction.figures import draw
from train.reproduction.page import page
from train.reproduction.plan import PARTS, PLANNERS, Cell, Part, Plan, Planner, Sizes, make_plan
from train.reproduction.prepare import note_machine, time_orders, write_scenes
from train.reproduction.running import fly_cells, result_of
from train.reproduction.tables import document
from train.support.arguments import check_least
from train.support.command_line import INTERRUPTED, run_program, say
from train.support.run_folder import RunError, RunFolder

QUICK = Sizes(training_seeds=1, sweep=(1, 2, 4), floating=1, city=1, items=3, first_scene=7001)
QUICK_TRAINING = ("--updates", "1500", "--extra-updates", "0", "--retries", "0")
OUTPUTS = ("cells", "scenes", "config.json", "command.txt", "orders.json", "machines.json",
           "results.json", "reproduction.md", "*.png")  # fmt: skip
# What is compared with another run's flights.
COMPARED = ("order", "success", "mission_time", "segment_times", "contacts", "updates")
CELL_NAME = re.compile(rf"(.+)-({'|'.join(PLANNERS)})-([a-z0-9.]+)(?:-seed(\d+))?", re.ASCII)


@dataclass(frozen=True)
class Args:
    """Regenerate every table and figure of the paper."""

    quick: bool = False
    """Fly few scenes after a short training: minutes on two cores, to see that all works."""
    out: Path | None = None
    """Folder for flights and results; default: runs/reproduce, or runs/reproduce-quick."""
    workers: int = 2
    """Number of flights side by side, each in a process of its own."""
    ray: str | None = None
    """Address of a Ray cluster to fly on instead: host:port, auto, or local."""
    resume: bool = False
    """Go on with the folder: fly only what it does not hold yet."""
    overwrite: bool = False
    """Start anew in a folder that is not empty."""
    seed: int = 0
    """First seed: those of trainings and of random orders count up from it."""
    parts: tuple[Part, ...] = PARTS
    """Parts of the paper to fly; the page shows whatever the folder holds."""
    planners: tuple[Planner, ...] = PLANNERS
    """Planners to fly."""
    only: tuple[str, ...] = ()
    """Names of the only flights to make, as in results.json: to check some of another run's."""
    against: Path | None = None
    """Another run's results.json to compare the flights with; exit code 1 if one differs."""
    training_seeds: int | None = None
    """Number of trainings, each with its own seed, in scenarios 1 and 2 (3; with --quick 1)."""
    floating: int | None = None
    """Number of random scenes with floating boxes (20; with --quick 1)."""
    city: int | None = None
    """Number of random scenes with boxes on the ground (6; with --quick 1)."""
    items: int | None = None
    """Number of items in each random scene (8; with --quick 3)."""
    mission_arguments: Annotated[str, tyro.conf.arg(metavar="'...'")] = ""
    """Further arguments of train.mission, such as --mission-arguments="--updates 200"."""
    keep: bool = False
    """Keep policies, checkpoints and pictures of every flight."""


def main(argv: list[str] | None = None) -> int:
    """Run the program and return its exit code."""
    return run_program("train.reproduce", Args, reproduce, argv)


def reproduce(args: Args) -> int:
    """Plan, fly, count and draw; the exit code is returned.

    Raises:
        RunError: something is wrong with the arguments or the folder.
    """
    sizes = sizes_of(args)
    only = [parse_cell(name, sizes) for name in args.only]
    theirs = None if args.against is None else load_cells(args.against)
    try:
        training = (*(QUICK_TRAINING if args.quick else ()), *shlex.split(args.mission_arguments))
    except ValueError as error:
        raise RunError(
            f"--mission-arguments: {args.mission_arguments}: {error}; close the quotes"
        ) from None
    folder = RunFolder(
        args.out or Path("runs") / ("reproduce-quick" if args.quick else "reproduce")
    )
    config = {"program": "train.reproduce", "training": list(training)}
    folder.check(config, resume=args.resume, overwrite=args.overwrite)
    if args.ray is not None:
        connect_ray(args.ray)
    folder.create(config, None, overwrite=args.overwrite, files=OUTPUTS)
    try:
        orders = time_orders(folder, sizes, args.workers, "random" in args.parts and not only)
        plan = make_plan(sizes, args.seed, orders)
        for cell in only:
            plan.cells.setdefault(cell.name, cell)
        write_scenes(folder, plan)
        cells = only or chosen(plan, args)
        if any(result_of(folder.path, cell) is None for cell in cells):
            note_machine(folder)
        ray = args.ray is not None
        complete, errors = fly_cells(
            folder.path, cells, training, workers=args.workers, ray=ray, keep=args.keep
        )
        if not complete:
            say("stopped, saved; go on with --resume")
            return INTERRUPTED
        about = {
            "command": shlex.join(["python", "-m", "train.reproduce", *without_folder(args.out)]),
            "quick": args.quick,
            "seed": args.seed,
            "training": list(training),
            "machines": (folder.read_json("machines.json") or {"machines": []})["machines"],
        }
        say("counting and drawing")
        found = document(folder.path, plan, sizes, errors, about)
        found["figures"] = draw(folder.path, plan, found)
        folder.write_json("results.json", found)
        folder.write_text("reproduction.md", page(found))
    finally:
        folder.unlock()
    for name, message in errors.items():
        say(f"error: {name}: {message}")
    print(f"{len(cells) - len(errors)} of {len(cells)} flights: {folder.path / 'reproduction.md'}")
    differing = {}
    if theirs is not None:
        differing = differences([cell.name for cell in cells], found["cells"], theirs)
        for name, what in differing.items():
            print(f"differs: {name}: {what}")
        print(f"{len(cells) - len(differing)} of {len(cells)} flights as in {args.against}")
    return 1 if errors or differing else 0


def sizes_of(args: Args) -> Sizes:
    """Return how much to fly.

    Raises:
        RunError: a number is out of range, or options exclude each other.
    """
    least = {"training_seeds": 1, "floating": 0, "city": 0, "items": 1}
    given = {field: getattr(args, field) for field in least if getattr(args, field) is not None}
    check_least(args, seed=0, workers=1, **{field: least[field] for field in given})
    if args.items is not None and args.items > MAX_EXACT:
        raise RunError(f"--items: {args.items}: must be at most {MAX_EXACT}")
    for field in ("parts", "planners"):
        if not getattr(args, field):
            raise RunError(f"--{field}: names none; leave it out to fly all")
    return replace(QUICK if args.quick else Sizes(), **given)


def parse_cell(name: str, sizes: Sizes) -> Cell:
    """Return the cell of a name as in `Cell.name`; its order may be a method's name, such as lkh.

    Raises:
        RunError: there is no such scene, planner, order or seed.
    """
    scenes = make_plan(sizes, 0, {}).scenes
    parts = CELL_NAME.fullmatch(name)
    if parts is not None and parts[1] in scenes and (parts[2] == "policy") == bool(parts[4]):
        label, planner, order, seed = parts.groups()
        with contextlib.suppress(TourError):
            stops = plan_order(scenes[label], order.replace(".", ","))
            return Cell(label, stops, planner, int(seed or 0))
    raise RunError(
        f"--only: {name}: is no cell of this run; take a name from results.json, with the same "
        "sizes (--quick, --floating, --city, --items)"
    )


def load_cells(path: Path) -> dict[str, Any]:
    """Return the entries of the cells in a results.json, by name.

    Raises:
        RunError: there is no such file, or it is none.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["cells"])
    except OSError as error:
        raise RunError(f"--against: {path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise RunError(f"--against: {path}: is no results.json of train.reproduce") from None


def differences(
    names: Sequence[str], ours: Mapping[str, Mapping[str, Any]], theirs: Mapping[str, Any]
) -> dict[str, str]:
    """Return what differs, by cell; nothing if all flights of `names` are the same in both."""
    found = {}
    for name in names:
        one, two = ours.get(name), theirs.get(name)
        if one is None or two is None:
            found[name] = "not flown" if one is None else "not in the other run"
        elif differ := [key for key in COMPARED if one[key] != two[key]]:
            found[name] = "; ".join(f"{key} {one[key]}, there {two[key]}" for key in differ)
    return found


def chosen(plan: Plan, args: Args) -> list[Cell]:
    """Return the cells of the parts and planners asked for."""
    names = dict.fromkeys(
        use.cell for use in plan.uses if use.part in args.parts and use.planner in args.planners
    )
    return [plan.cells[name] for name in names]


def without_folder(out: Path | None) -> list[str]:
    """Return this program's arguments but for --out, whose place means nothing elsewhere."""
    return [word for word in sys.argv[1:]
            if Path(word) != out and word != "--out" and not word.startswith("--out=")]  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
