"""Reads a finished run that is flown again, and says where it differs from what is asked for."""

from __future__ import annotations

from pathlib import Path

from mjcollect.scene.order import plan_order
from mjcollect.scene.scene import Scene
from train.support.run_folder import RunError, RunFolder, as_written


def finished_run(
    folder: Path, scene_name: str | None, own_seed: int | None, own_order: str | None
) -> tuple[Scene, tuple[int, ...], str, int]:
    """Returns the run's scene, order, method of ordering, and seed.

    Args:
        folder: of the run. scene_name, own_seed, own_order: --scene, --seed and --order if given.

    Raises:
        RunError: the run is not a finished mission, or does not match the other arguments.
    """
    run = RunFolder(folder)
    result = run.read_json("mission.json")
    if result is None:
        raise RunError(
            f"--run: {folder}: holds no mission.json; name the folder of a finished mission"
        )
    scene = Scene.load(folder / "scene.json")
    with as_written(folder / "mission.json"):
        segments, seed = len(result["segments"]), int(result["seed"])
        method = str(result["order_method"])
        order = plan_order(scene, ",".join(str(int(item)) for item in result["order"]))
    if not run.segment(0).path.is_dir():
        raise RunError(
            f"--run: {folder}: holds no trained policies; name the folder of a train.mission run"
        )
    others = [run.segment(k).path / "scene.json" for k in range(segments)]
    given = [("--scene", Scene.find(scene_name))] if scene_name is not None else []
    for name, other in given + [(str(path), Scene.load(path)) for path in others]:
        if difference := scene.difference(other):
            raise RunError(
                f"{name}: differs from {folder / 'scene.json'}, for which the run was trained: "
                f"{difference}; train again for another scene"
            )
    if own_seed not in (None, seed):
        raise RunError(f"--seed: {own_seed}: the run's is {seed}; leave it out with --run")
    if own_order is not None and plan_order(scene, own_order, seed=seed) != order:
        raise RunError(
            f"--order: {own_order}: the run's is {list(order)} ({method}); leave it out with --run"
        )
    return scene, order, method, seed
