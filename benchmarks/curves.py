"""Draws how the runs of `benchmarks.deviations` learned: success and time against updates.

python -m benchmarks.curves docs/results/deviations.json docs/images/curves.png
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mjcollect.render.time_figures import (
    BLACK,
    BLUE,
    GREEN,
    LABEL,
    ORANGE,
    PURPLE,
    RED,
    figure,
    save,
)

COLOURS = {
    "our settings": GREEN,
    "no shield": BLUE,
    "no demonstrations": ORANGE,
    "paper's state": PURPLE,
    "paper's reward": BLACK,
    "--preset paper, slot of 0.2 s": RED,
}


def draw(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Two panels for each segment, a thin line for each run."""
    rows = [row for row in rows if row["change"] in COLOURS and row.get("curve")]
    places = list(dict.fromkeys((row["scene"], row["segment"]) for row in rows))
    made = figure(11, 3.6 * len(places) + 0.9)
    axes: Any = made.subplots(len(places), 2, squeeze=False)
    for line, place in zip(axes, places, strict=True):
        for row in rows:
            if (row["scene"], row["segment"]) != place:
                continue
            curve = {name: np.array(each, dtype=float) for name, each in row["curve"].items()}
            style = {"color": COLOURS[row["change"]], "marker": "o", "markersize": 3, "alpha": 0.8}
            line[0].plot(curve["update"], curve["eval_success_rate"], **style)
            line[1].plot(curve["update"], curve["eval_mean_time"] / row["detour_time"], **style)
        line[0].set_ylabel("success rate, 32 starts", **LABEL)
        line[1].set_ylabel("mean time / detour time", **LABEL)
        line[0].set_title(f"{place[0]}, segment {place[1]}", **LABEL)
        line[1].set_title("of the arrivals", **LABEL)
        line[0].set_ylim(-0.04, 1.04)
        line[1].set_ylim(0.98, 2.0)
        for each in line:
            each.set_xlabel("updates", **LABEL)
            each.grid(color="#E0E0E0", linewidth=0.6)
    for name, colour in COLOURS.items():
        if any(row["change"] == name for row in rows):
            axes[0, 0].plot([], [], color=colour, marker="o", markersize=3, label=name)
    made.legend(loc="lower center", ncols=3, frameon=False)
    made.tight_layout(rect=(0, 0.9 / (3.6 * len(places) + 0.9), 1, 1))
    save(made, path)


def main(results: Path, out: Path, /) -> int:
    """Draw `results`, the JSON of `benchmarks.deviations`, into the PNG `out`."""
    draw(out, json.loads(results.read_text())["results"])
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
