"""Writes what `examples.sweep` found: a table as Markdown and CSV, a verdict, and a figure."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjcollect.render.time_figures import BLUE, DPI, GREEN, RED, plain
from train.support.markdown import markdown_table
from train.support.run_folder import RunFolder

if TYPE_CHECKING:
    import optuna

CLEAR = 2.0  # A difference of so many standard errors is called clear.


@dataclass(frozen=True)
class Result:
    """Holds what became of one trial.

    Attributes:
        number: the first, 0, has the usual settings.
        scores: mean time over the lower bound, of each seed. success: mean success rate.
        pruned: after how many evaluations it was pruned, None if it was not. seconds: wall time.
    """

    number: int
    settings: Mapping[str, Any]
    scores: Sequence[float]
    success: float
    pruned: int | None
    seconds: float

    @classmethod
    def of(cls, number: int, trial: optuna.trial.FrozenTrial) -> Result:
        """Returns it for the `number`-th trial of the study that came to an end."""
        attrs = trial.user_attrs
        pruned = trial.last_step if math.isnan(attrs["success"]) else None
        return cls(
            number, trial.params, attrs["scores"], attrs["success"], pruned, attrs["seconds"]
        )

    @property
    def mean(self) -> float:
        """Returns the mean score over the seeds."""
        return float(np.mean(self.scores))


def spread(scores: Sequence[float]) -> float:
    """Returns the standard deviation over seeds, NaN of a single one."""
    return float(np.std(scores, ddof=1)) if len(scores) > 1 else math.nan


def shown(scores: Sequence[float]) -> str:
    """Returns mean and spread as text."""
    mean = f"{np.mean(scores):.3f}"
    return f"{mean} ± {spread(scores):.3f}" if len(scores) > 1 else mean


def ranked(results: Sequence[Result]) -> list[Result]:
    """Returns the results, best first, pruned ones last."""
    return sorted(results, key=lambda r: (r.pruned is not None, -(r.pruned or 0), r.mean, r.number))


def write_report(
    folder: RunFolder, results: Sequence[Result], again: Mapping[int, Sequence[float]], law: float
) -> str:
    """Writes sweep.md, sweep.csv and sweep.png; returns the text of sweep.md.

    Args:
        again: scores with further seeds, by the number of the trial; trial 0 has usual settings.
        law: score of the guidance law, which learns nothing.
    """
    rows = ranked(results)
    text = "\n".join([*table(rows), "", *verdict(rows, again, law), ""])
    folder.write_text("sweep.md", text)
    folder.write("sweep.csv", lambda part: save_csv(part, rows))
    folder.write("sweep.png", lambda part: plot(part, rows, law))
    return text


def table(rows: Sequence[Result]) -> list[str]:
    """Returns the lines of the table in Markdown."""
    names = list(rows[0].settings)
    columns = ["trial", *names, "time / bound", "success", "wall (s)"]
    body = []
    for row in rows:
        ended = shown(row.scores)
        if row.pruned is not None:
            ended += f", pruned at evaluation {row.pruned}"
        success = "-" if row.pruned is not None else f"{row.success:.0%}"
        settings = [f"{row.settings[name]:.3g}" for name in names]
        usual = " (usual)" if row.number == 0 else ""
        body.append([f"{row.number}{usual}", *settings, ended, success, f"{row.seconds:.0f}"])
    return markdown_table(columns, body)


def verdict(rows: Sequence[Result], again: Mapping[int, Sequence[float]], law: float) -> list[str]:
    """Returns sentences that compare the best others with the usual settings, with new seeds."""
    lines = [f"The guidance law, which learns nothing: {law:.3f}."]
    if rows[0].number == 0:
        lines.append("Nothing was better than the usual settings.")
    others = [row.number for row in rows if row.number > 0 and row.pruned is None]
    if not others or others[0] not in again:
        return lines
    best, usual = again[others[0]], again[0]
    lines.append(
        f"With seeds that the sweep has not used, {len(best)}: trial {others[0]} {shown(best)}, "
        f"usual settings {shown(usual)}."
    )
    if len(best) > 1:
        gained = float(np.mean(usual) - np.mean(best))
        error = math.sqrt((spread(best) ** 2 + spread(usual) ** 2) / len(best))
        which = "a clear difference" if abs(gained) > CLEAR * error else "no clear difference"
        lines.append(
            f"The trial gains {gained:+.3f} with a standard error of {error:.3f}: {which} (it "
            f"would take {CLEAR:.0f} standard errors)."
        )
    return lines


def save_csv(path: Path, rows: Sequence[Result]) -> None:
    """Writes the table with a column for each seed's score."""
    seeds = [f"score_{k}" for k in range(len(rows[0].scores))]
    names = list(rows[0].settings)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", *names, *seeds, "mean", "spread", "success", "pruned", "seconds"])
        for row in rows:
            success = "" if math.isnan(row.success) else row.success
            pruned = "" if row.pruned is None else row.pruned
            figures = [*row.scores, row.mean, spread(row.scores), success, pruned, row.seconds]
            writer.writerow([row.number, *(row.settings[name] for name in names), *figures])


def plot(path: Path, rows: Sequence[Result], law: float) -> None:
    """Draws what the time is above the bound over each setting: a dot for each seed, a bar for all.

    The axis is logarithmic, since what never arrives is a hundred times worse than what is good.
    """
    names = list(rows[0].settings)
    figure = Figure(figsize=(2.6 * len(names), 3.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    for axes, name in zip(panels, names, strict=True):
        for row in rows:
            colour = "#B0B0B0" if row.pruned is not None else RED if row.number == 0 else BLUE
            at = row.settings[name]
            axes.plot([at] * len(row.scores), _above(row.scores), ".", color=colour, markersize=5)
            axes.plot(at, _above([row.mean])[0], "_", color=colour, markersize=12)
        axes.axhline(_above([law])[0], color=GREEN, linewidth=1.2)
        axes.set_xlabel(name)
        axes.set_yscale("log")
        values = sorted({row.settings[name] for row in rows})
        if values[0] > 0 and values[-1] > 8 * values[0]:
            axes.set_xscale("log")
        if all(isinstance(value, int) for value in values):
            axes.set_xticks(values, labels=[str(value) for value in values])
            axes.minorticks_off()
        plain(axes)
    panels[0].set_ylabel("time / lower bound - 1")
    title = "red: usual settings; blue: others; grey: pruned; green line: guidance law"
    figure.suptitle(title, size=10)
    figure.savefig(path)


def _above(scores: Sequence[float]) -> list[float]:
    return [max(score - 1.0, 1e-4) for score in scores]
