"""Learns to the end of a budget, with progress bar, metrics, checkpoints and Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from mjcollect.learning.trainer import Trainer
from train.support.command_line import progress_bar, say, stop_on_ctrl_c
from train.support.run_folder import RunFolder


def learn_to_the_end(
    trainer: Trainer,
    folder: RunFolder,
    parts: dict[str, Any],
    describe: Callable[[dict[str, float]], str],
    *,
    resume: bool,
    checkpoint_every: int,
    after_round: Callable[[], None] = lambda: None,
) -> bool:
    """Trains to the end; returns False if Ctrl-C stopped it, after a checkpoint.

    Args:
        parts: what a checkpoint holds, by name.
        describe: returns what the bar says of the last evaluation, a row of metrics.csv.
        resume: whether to go on from the folder's checkpoint, if there is one.
        checkpoint_every: updates between checkpoints.
        after_round: called after each round of updates, before a checkpoint.
    """
    if resume and folder.load_checkpoint(**parts):
        say(f"resuming after {trainer.learner.updates} updates")
        folder.write_metrics(trainer.rows)  # cut back to the checkpoint
    total = trainer.config.updates
    saved, shown = trainer.learner.updates, len(trainer.rows)
    begun, before = time.monotonic(), trainer.seconds
    with stop_on_ctrl_c() as stopped, progress_bar(total) as bar:
        bar.update(trainer.learner.updates)
        for updates in trainer.run():
            bar.total = total if updates < total else trainer.budget
            bar.update(updates - bar.n)
            trainer.seconds = before + time.monotonic() - begun
            after_round()
            if trainer.rows:
                bar.set_postfix_str(describe(trainer.rows[-1]), refresh=False)
            if len(trainer.rows) > shown:
                folder.write_metrics(trainer.rows)
                shown = len(trainer.rows)
            if updates - saved >= checkpoint_every or stopped() or trainer.finished:
                folder.save_checkpoint(**parts)
                saved = updates
            if stopped() and not trainer.finished:
                say(f"stopped after {updates} updates, saved; go on with --resume")
                return False
    return True
