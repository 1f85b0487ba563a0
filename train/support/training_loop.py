"""Learns to the end of a budget, with progress bar, metrics, log, checkpoints and Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from mjcollect.learning.logs import LoggerName, TrainingLog
from mjcollect.learning.trainer import Trainer
from train.support.command_line import progress_bar, say, stop_on_ctrl_c
from train.support.run_folder import RunFolder

LOGS = "logs"  # folder in the run's


def learn_to_the_end(
    trainer: Trainer,
    folder: RunFolder,
    parts: dict[str, Any],
    describe: Callable[[dict[str, float]], str],
    *,
    resume: bool,
    checkpoint_every: int,
    logger: LoggerName,
    after_round: Callable[[], None] = lambda: None,
) -> bool:
    """Trains to the end; returns False if Ctrl-C stopped it, after a checkpoint.

    Args:
        parts: what a checkpoint holds, by name.
        describe: returns what the bar says of the last evaluation, a row of metrics.csv.
        resume: whether to go on from the folder's checkpoint, if there is one.
        checkpoint_every: updates between checkpoints.
        logger: logs what metrics.csv holds, in logs/ of the folder.
        after_round: called after each round of updates, before a checkpoint.
    """
    if resume and folder.load_checkpoint(**parts):
        say(f"resuming after {trainer.learner.updates} updates")
        folder.write_metrics(trainer.rows)  # cut back to the checkpoint
    total = trainer.config.updates
    saved, shown = trainer.learner.updates, len(trainer.rows)
    log = TrainingLog(logger, folder.path / LOGS, folder.read_json("config.json") or {})
    begun, before = time.monotonic(), trainer.seconds

    def write_log() -> None:
        trainer.row_seconds += [trainer.seconds] * (len(trainer.rows) - len(trainer.row_seconds))
        log.write(trainer.rows, trainer.row_seconds)

    with stop_on_ctrl_c() as stopped, progress_bar(total) as bar, log:
        bar.update(trainer.learner.updates)
        write_log()  # those of the checkpoint
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
                write_log()
            if updates - saved >= checkpoint_every or stopped() or trainer.finished:
                folder.save_checkpoint(**parts)
                saved = updates
            if stopped() and not trainer.finished:
                say(f"stopped after {updates} updates, saved; go on with --resume")
                return False
        write_log()  # where the policy to start from was good enough, nothing was yielded
    return True
