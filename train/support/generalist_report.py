"""Leaves what `train.generalist` has learned in its run folder, and prints how good it is."""

from __future__ import annotations

import dataclasses

from mjcollect.learning.trainer import Trainer
from train.support.run_folder import RunFolder, finite, versions


def finish(trainer: Trainer, folder: RunFolder, numbers: tuple[list[int], list[int]]) -> None:
    """Saves the best policy, the curves, and last generalist.json."""
    from mjcollect.render.time_figures import plot_learning

    assert trainer.best is not None
    assert trainer.best_policy is not None
    trainer.learner.actor.load_state_dict(trainer.best_policy)
    folder.write("policy.safetensors", trainer.policy.save)
    folder.write("learning.png", lambda part: plot_learning(part, trainer.rows))
    folder.write_json(
        "generalist.json",
        {
            "held_out": {k: finite(v) for k, v in dataclasses.asdict(trainer.best).items()},
            "law": {k: finite(v) for k, v in dataclasses.asdict(trainer.evaluator.law()).items()},
            "best_update": trainer.best_update,
            "updates": trainer.learner.updates,
            "env_steps": trainer.env_steps,
            "train_seconds": trainer.seconds,
            "segments": len(numbers[0]),
            "held_out_segments": len(numbers[1]),
            "seed": trainer.seed,
            "versions": versions(),
        },
    )  # fmt: skip


def report(folder: RunFolder) -> int:
    """Prints the result; returns 0."""
    result = folder.read_json("generalist.json")
    assert result is not None
    best, law = result["held_out"], result["law"]
    print(
        f"held out: arrives from {best['success_rate']:.1%} of the starts (law "
        f"{law['success_rate']:.1%}), calm {best['point_rate']:.1%} in "
        f"{_seconds(best['point_time'])} (law {_seconds(law['point_time'])}): {folder.path}"
    )
    return 0


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} s"
