"""What a reproduction needs before anything flies: scenes, orders, a note of the machine."""

from __future__ import annotations

import hashlib

from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.jobs.processes import importing_pool
from train.reproduction.document import machine
from train.reproduction.plan import Order, Plan, Sizes, content, random_scenes
from train.support.command_line import say
from train.support.run_folder import RunError, RunFolder


def time_orders(folder: RunFolder, sizes: Sizes, workers: int, compute: bool) -> dict[str, Order]:
    """LKH's order at obstacle-aware cost of every random scene, kept in orders.json.

    Args:
        workers: processes that compute them. compute: False takes only those that are kept.
    """
    scenes = random_scenes(sizes)
    keys = {label: hashlib.sha256(content(scene).encode()).hexdigest()[:16]
            for label, scene in scenes.items()}  # fmt: skip
    kept = folder.read_json("orders.json") or {}
    missing = [label for label, key in keys.items() if key not in kept]
    if compute and missing:
        say(f"ordering {len(missing)} random scenes at obstacle-aware cost")
        count = min(workers, len(missing))
        with importing_pool(count) as pool:
            found = pool.map(time_order, [scenes[label] for label in missing])
            for label, order in zip(missing, found, strict=True):
                kept[keys[label]] = list(order)
        folder.write_json("orders.json", kept)
    return {label: tuple(kept[key]) for label, key in keys.items() if key in kept}


def time_order(scene: Scene) -> Order:
    """LKH's order at the least time round the obstacles."""
    from mjcollect.guidance.travel_times import travel_times

    return plan_order(scene, "lkh", cost=travel_times(scene))


def write_scenes(folder: RunFolder, plan: Plan) -> None:
    """A file for every scene in scenes/.

    Raises:
        RunError: a file of that name holds another scene.
    """
    for label, scene in plan.scenes.items():
        name = f"scenes/{label}.json"
        path = folder.path / name
        if not path.is_file():
            folder.write(name, scene.save)
        elif Scene.load(path) != scene:
            raise RunError(f"--resume: {path}: differs from today's {label}; use another --out")


def note_machine(folder: RunFolder) -> None:
    """Add this machine to machines.json, which lists all that flew cells."""
    known = folder.read_json("machines.json") or {"machines": []}
    if (here := machine()) not in known["machines"]:
        folder.write_json("machines.json", {"machines": [*known["machines"], here]})
