"""Logs a training for other tools, by TorchRL's loggers: CSV, TensorBoard, Weights & Biases.

A log holds what metrics.csv holds, the time spent, and the settings. It is made anew from all rows
whenever a training begins or goes on: no point is in it twice, or is left over from after the
checkpoint. It only reads, so that training does not depend on it.
"""

from __future__ import annotations

import importlib.metadata
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

LoggerName = Literal["none", "csv", "tensorboard", "wandb"]
EXTRAS = {"tensorboard": "viz", "wandb": "wandb"}  # Packages, and our extras that install them.
EVALUATED = ("eval_", "best_")  # Columns of metrics.csv about policies without noise begin so.


def check_logger(name: LoggerName) -> None:
    """Refuses a logger whose package is not installed.

    Raises:
        ModuleNotFoundError: it is not; the message says how to get it.
    """
    if name in EXTRAS:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            raise ModuleNotFoundError(
                f"{name}: is not installed; pip install 'mjcollect[{EXTRAS[name]}]', or use csv"
            ) from None


class TrainingLog:
    """Is the log of one training; use it as a context."""

    def __init__(self, name: LoggerName, folder: Path, settings: Mapping[str, Any]) -> None:
        """Begins the log in `folder`, in a folder of the logger's name, in place of an earlier one.

        Args:
            name: logger; with none, nothing is ever written.
            settings: resolved configuration, logged as hyperparameters; may be nested.
        """
        self._logger: Any = None
        self._written = 0
        if name != "none":
            shutil.rmtree(folder / name, ignore_errors=True)
            self._logger = _open(name, folder, settings)

    def write(self, rows: Sequence[Mapping[str, float]], seconds: Sequence[float]) -> None:
        """Logs the rows that are not logged yet; their step is their number of updates.

        Args:
            rows: all rows of metrics.csv so far. seconds: time spent until each (s).
        """
        if self._logger is None or len(rows) == self._written:
            return
        for index in range(self._written, len(rows)):
            row, time = rows[index], seconds[index]
            begun, before = (rows[index - 1]["update"], seconds[index - 1]) if index else (0, 0.0)
            done, spent = row["update"] - begun, time - before
            timed = {"seconds": time, "updates_per_second": done / spent if spent else math.nan}
            values = {
                f"{'evaluation' if column.startswith(EVALUATED) else 'training'}/{column}": value
                for column, value in {**row, **timed}.items()
                if math.isfinite(value)
            }
            self._logger.log_metrics(values, step=int(row["update"]))
        self._written = len(rows)
        self._logger.flush()

    def __enter__(self) -> TrainingLog:
        """Returns itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Closes the log."""
        if self._logger is not None:
            self._logger.close()


def _open(name: LoggerName, folder: Path, settings: Mapping[str, Any]) -> Any:
    """Returns one of TorchRL's loggers, with the settings as its hyperparameters."""
    from torchrl.record.loggers import get_logger  # takes seconds to import

    parameters = _flat(settings)
    if name == "tensorboard":
        from torch.utils.tensorboard.summary import hparams

        logger = get_logger(name, str(folder), name)
        # TorchRL's log_hparams would put them in a run of their own, away from the curves.
        for summary in hparams(parameters, {}):
            logger.experiment.file_writer.add_summary(summary)
        return logger
    options = {}
    if name == "wandb":
        import wandb

        quiet = wandb.Settings(console="off", silent=True, x_disable_stats=True)
        options = {"offline": True, "project": "mjcollect", "settings": quiet}
    named = [parameters[k] for k in ("program", "scene", "segment", "seed") if k in parameters]
    title = "-".join(map(str, named)) if name == "wandb" else name
    logger = get_logger(name, str(folder), title, wandb_kwargs=options)
    logger.log_hparams(parameters)
    return logger


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, bool | float | str]:
    """Returns nested settings as one dict, with dots in its keys and simple values."""
    flat: dict[str, bool | float | str] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = (
                value if isinstance(value, bool | float | int | str) else str(value)
            )
    return flat
