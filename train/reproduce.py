"""Every table and figure of the paper with one command, and what became of its claims.

    python -m train.reproduce --quick --out DIR
    python -m train.reproduce --out DIR --workers 8 --resume

Flies every cell (scene, visiting order, planner, training seed) that the folder does not hold yet,
each as a `train.mission` or `train.fly` of its own, then writes results.json, the figures and
reproduction.md.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mjcollect.scene.order import MAX_EXACT, TourError, plan_order
from train.jobs.workers import connect_ray, need_ray
from train.reproduction.compare import differences, load_cells
from train.reproduction.document import document
from train.reproduction.page import page
from train.reproduction.pictures import draw
from train.reproduction.plan import PARTS, PLANNERS, Cell, Plan, Sizes, make_plan
from train.reproduction.prepare import note_machine, time_orders, write_scenes
from train.reproduction.running import Settings, fly_cells, result_of
from train.support.command_line import INTERRUPTED, run_program, say
from train.support.run_folder import RunError, RunFolder

QUICK = Sizes(training_seeds=1, sweep=(1, 2, 4), floating=1, city=1, items=3, first_scene=7001)
QUICK_TRAINING = ("--updates", "300", "--extra-updates", "0", "--retries", "0")
OUTPUTS = ("cells", "scenes", "config.json", "command.txt", "orders.json", "machines.json",
           "results.json", "reproduction.md")  # fmt: skip
Part = Literal["scenarios", "sweep", "random"]
Planner = Literal["policy", "mpc", "guidance", "reference"]


@dataclass(frozen=True)
class Args:
    """Regenerate every table and figure of the paper."""

    quick: bool = False
    """Few scenes and a short training: minutes on two cores, to see that everything works."""
    out: Path | None = None
    """Folder for cells and results; default: runs/reproduce, or runs/reproduce-quick."""
    workers: int = 2
    """Flights side by side, each in a process of its own."""
    ray: str | None = None
    """Address of a Ray cluster to fly on instead: host:port, auto, or local."""
    resume: bool = False
    """Go on with the folder: fly only what it does not hold yet."""
    overwrite: bool = False
    """Start anew in a folder that is not empty."""
    seed: int = 0
    """Training seeds and random orders count up from it."""
    parts: tuple[Part, ...] = PARTS  # type: ignore[assignment]
    """Which parts to fly; the page shows whatever the folder holds."""
    planners: tuple[Planner, ...] = PLANNERS  # type: ignore[assignment]
    """Which planners fly."""
    only: tuple[str, ...] = ()
    """Fly only these cells, by the names in results.json: to check some of another run's."""
    against: Path | None = None
    """Another run's results.json: compare the flights with it; exit code 1 if one differs."""
    training_seeds: int | None = None
    """Training seeds in scenarios 1 and 2 (3; with --quick 1)."""
    floating: int | None = None
    """Random scenes of floating boxes (20; with --quick 1)."""
    city: int | None = None
    """Random scenes of grounded boxes (6; with --quick 1)."""
    items: int | None = None
    """Items in each random scene (8; with --quick 3)."""
    mission_arguments: Annotated[str, tyro.conf.arg(metavar="'...'")] = ""
    """Further arguments of train.mission, such as --mission-arguments="--updates 200"."""
    keep: bool = False
    """Keep policies, checkpoints and pictures of every flight."""


def main(argv: list[str] | None = None) -> int:
    """Run the program; the exit code of the contract."""
    return run_program("train.reproduce", Args, reproduce, argv)


def reproduce(args: Args) -> int:
    """Plan, fly, count, draw. Raises only before anything is written."""
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
    workers = args.workers if args.ray is None else ray_workers(args.ray)
    create(folder, config, args.overwrite)
    try:
        orders = time_orders(folder, sizes, args.workers, "random" in args.parts and not only)
        plan = make_plan(sizes, args.seed, orders)
        for cell in only:
            plan.cells.setdefault(cell.name, cell)
        write_scenes(folder, plan)
        cells = only or chosen(plan, args)
        settings = Settings(workers, args.ray is not None, training, args.keep)
        if any(result_of(folder.path, cell) is None for cell in cells):
            note_machine(folder)
        complete, errors = fly_cells(folder.path, cells, settings)
        if not complete:
            say("stopped, saved; go on with --resume")
            return INTERRUPTED
        about = {
            "command": command(),
            "quick": args.quick,
            "seed": args.seed,
            "training": list(training),
            "machines": (folder.read_json("machines.json") or {"machines": []})["machines"],
        }
        found = write_results(folder, plan, sizes, errors, about)
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
    """How much to fly.

    Raises:
        RunError: a number is out of range, or options exclude each other.
    """
    least = {"seed": 0, "workers": 1, "training_seeds": 1, "floating": 0, "city": 0, "items": 1}
    for field, smallest in least.items():
        value = getattr(args, field)
        if value is not None and value < smallest:
            name = field.replace("_", "-")
            raise RunError(f"--{name}: {value}: must be at least {smallest}")
    if args.items is not None and args.items > MAX_EXACT:
        raise RunError(f"--items: {args.items}: must be at most {MAX_EXACT}")
    for field in ("parts", "planners"):
        if not getattr(args, field):
            raise RunError(f"--{field}: names none; leave it out to fly all")
    if args.ray is not None:
        need_ray()
    given = {
        field: getattr(args, field)
        for field in ("training_seeds", "floating", "city", "items")
        if getattr(args, field) is not None
    }
    return replace(QUICK if args.quick else Sizes(), **given)


def parse_cell(name: str, sizes: Sizes) -> Cell:
    """The cell of a name as in `Cell.name`.

    Raises:
        RunError: there is no such scene, planner, order or seed.
    """
    plan = make_plan(sizes, 0, {})
    for label, scene in plan.scenes.items():
        for planner in PLANNERS:
            start = f"{label}-{planner}-"
            if not name.startswith(start):
                continue
            text, _, seed = name.removeprefix(start).partition("-seed")
            if (planner == "policy") != seed.isdigit():
                continue
            try:
                order = plan_order(scene, text.replace(".", ","))
            except TourError:
                continue
            return Cell(label, order, planner, int(seed or 0))
    raise RunError(
        f"--only: {name}: is no cell of this run; take a name from results.json, with the same "
        "sizes (--quick, --floating, --city, --items)"
    )


def create(folder: RunFolder, config: dict[str, Any], overwrite: bool) -> None:
    """Make and lock the folder; with `overwrite` remove what an earlier run left.

    Raises:
        RunError: the folder cannot be made, or is in use.
    """
    try:
        (folder.path / "scenes").mkdir(parents=True, exist_ok=True)
        (folder.path / "cells").mkdir(exist_ok=True)
    except OSError as error:
        raise RunError(f"--out: {folder.path}: cannot be made ({error.strerror})") from None
    folder.lock()
    if overwrite:
        for path in [folder.path / name for name in OUTPUTS] + list(folder.path.glob("*.png")):
            if path.is_dir():
                shutil.rmtree(path)
                path.mkdir()
            else:
                path.unlink(missing_ok=True)
    folder.write_text("command.txt", shlex.join([sys.executable, *sys.orig_argv[1:]]) + "\n")
    folder.write_json("config.json", config)


def ray_workers(address: str) -> int:
    """Connect to a cluster; how many cells it flies at a time.

    Raises:
        RunError: no cluster answers there.
    """
    connect_ray(address)
    import ray

    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def chosen(plan: Plan, args: Args) -> list[Cell]:
    """The cells of the parts and planners asked for."""
    names = dict.fromkeys(
        use.cell for use in plan.uses if use.part in args.parts and use.planner in args.planners
    )
    return [plan.cells[name] for name in names]


def command(argv: Sequence[str] | None = None) -> str:
    """The command line without the folder's place, which means nothing elsewhere."""
    words = list(sys.argv[1:] if argv is None else argv)
    kept = [
        word
        for before, word in zip(["", *words], words, strict=False)
        if word != "--out" and before != "--out" and not word.startswith("--out=")
    ]
    return shlex.join(["python", "-m", "train.reproduce", *kept])


def write_results(
    folder: RunFolder, plan: Plan, sizes: Sizes, errors: Mapping[str, str], about: Mapping[str, Any]
) -> dict[str, Any]:
    """results.json, which is also returned, the figures, and the page."""
    say("counting and drawing")
    found = document(folder.path, plan, sizes, errors, about)
    found["figures"] = draw(folder, plan, found)
    folder.write_json("results.json", found)
    folder.write_text("reproduction.md", page(found))
    return found


if __name__ == "__main__":
    sys.exit(main())
