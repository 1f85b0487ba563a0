"""Prepares what is needed before anything flies: scenes, orders, a note of the machine."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

from mjcollect.guidance.travel_times import travel_times
from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.jobs.processes import importing_pool
from train.reproduction.plan import Order, Plan, Sizes, random_scenes
from train.support.command_line import say
from train.support.run_folder import RunError, RunFolder


def time_orders(folder: RunFolder, sizes: Sizes, workers: int, compute: bool) -> dict[str, Order]:
    """Return LKH's order at obstacle-aware cost of every random scene, kept in orders.json.

    Args:
        folder: the run's.
        sizes: how many random scenes there are, of how many items.
        workers: how many processes compute orders side by side.
        compute: False returns only those that are kept.
    """
    scenes = random_scenes(sizes)
    kept = folder.read_json("orders.json") or {}
    missing = [label for label in scenes if label not in kept]
    if compute and missing:
        say(f"ordering {len(missing)} random scenes at obstacle-aware cost")
        with importing_pool(min(workers, len(missing))) as pool:
            found = pool.map(time_order, [scenes[label] for label in missing])
            kept.update(zip(missing, found, strict=True))
        folder.write_json("orders.json", kept)
    return {label: tuple(kept[label]) for label in scenes if label in kept}


def time_order(scene: Scene) -> Order:
    """Return LKH's order at the least time round the obstacles."""
    return plan_order(scene, "lkh", cost=travel_times(scene))


def write_scenes(folder: RunFolder, plan: Plan) -> None:
    """Write a file for every scene into scenes/.

    Raises:
        RunError: a file of that name holds another scene.
    """
    (folder.path / "scenes").mkdir(exist_ok=True)
    for label, scene in plan.scenes.items():
        name = f"scenes/{label}.json"
        path = folder.path / name
        if not path.is_file():
            folder.write(name, scene.save)
        elif Scene.load(path) != scene:
            raise RunError(f"--resume: {path}: differs from today's {label}; use another --out")


def note_machine(folder: RunFolder) -> None:
    """Add this machine to machines.json, which lists all that flew cells."""
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text(encoding="utf-8", errors="replace") if cpuinfo.is_file() else ""
    named = re.search(r"^model name\s*: *(.+)", text, re.MULTILINE)
    model = named[1] if named else platform.machine()
    here = {"cpus": os.cpu_count(), "processor": model, "system": platform.system()}
    known = folder.read_json("machines.json") or {"machines": []}
    if here not in known["machines"]:
        folder.write_json("machines.json", {"machines": [*known["machines"], here]})
