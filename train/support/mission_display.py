"""Shows all segments of a mission while they are learned: state, success rate, time, time left."""

from __future__ import annotations

import math
import sys
import time
from contextlib import AbstractContextManager, nullcontext

from rich.console import Console
from rich.live import Live
from rich.table import Table

from mjcollect.scene.bounds import segment_bound
from mjcollect.scene.order import node_name, tour_segments
from mjcollect.scene.scene import Scene
from train.support.mission_report import read_metrics
from train.support.run_folder import RunFolder

COLUMNS = ("segment", "from", "to", "state", "updates", "success", "best", "bound")


class MissionDisplay:
    """Shows a live table on a terminal, or in a log file a line for each training that ends.

    It reads the segments' metrics.csv, so it shows the same wherever they are trained.
    """

    def __init__(
        self, folder: RunFolder, scene: Scene, order: tuple[int, ...], updates: int
    ) -> None:
        """Prepares the table of a run folder, whose segments make so many updates each."""
        self._updates, self._ends = updates, tour_segments(order)
        self._bounds = [segment_bound(scene, *ends) for ends in self._ends]
        self._folders = [folder.segment(k) for k in range(len(self._ends))]
        self._console = Console(stderr=True)
        self._begun, self._at_start = time.monotonic(), self._total()
        self._moving = sys.stderr.isatty()

    def shown(self) -> AbstractContextManager[object]:
        """Shows the table, if this is a terminal, for as long as the context is open."""
        if not self._moving:
            return nullcontext()
        # Reading all metrics takes a moment, hence once a second.
        return Live(console=self._console, get_renderable=self._table, refresh_per_second=1)

    def finished(self, index: int) -> None:
        """Says that a training of segment `index` has ended."""
        if not self._moving:
            row = self._last(index)
            self._console.print(
                f"segment {index}: trained, success rate {row.get('eval_success_rate', 0):.0%}, "
                f"best {row.get('best_time', math.nan):.1f} s (bound {self._bounds[index]:.1f} s)",
                highlight=False,
            )

    def _last(self, index: int) -> dict[str, float]:
        """Returns the last row of a segment's metrics; the kept policy's success at the end."""
        folder = self._folders[index]
        rows = read_metrics(folder.path / "metrics.csv")
        last = rows[-1] if rows else {}
        if (result := folder.read_json("segment.json")) is not None:
            last["eval_success_rate"] = result["success_rate"]
        return last

    def _total(self) -> float:
        return sum(self._last(index).get("update", 0.0) for index in range(len(self._ends)))

    def _left(self) -> str:
        done = self._total()
        gained = done - self._at_start
        if gained <= 0:
            return "-"
        rate = gained / (time.monotonic() - self._begun)
        seconds = max(len(self._ends) * self._updates - done, 0.0) / rate
        return f"{seconds / 60:.0f} min left" if seconds >= 60 else f"{seconds:.0f} s left"

    def _table(self) -> Table:
        table = Table(title=f"training, {self._left()}")
        for column in COLUMNS:
            table.add_column(column, justify="right" if column in ("best", "bound") else "left")
        for index, (start, end) in enumerate(self._ends):
            folder, row = self._folders[index].path, self._last(index)
            state = "training" if (folder / "config.json").is_file() else "waiting"
            state = "done" if (folder / "segment.json").is_file() else state
            best = row.get("best_time", math.nan)
            table.add_row(
                str(index),
                node_name(start),
                node_name(end),
                state,
                f"{row.get('update', 0):.0f} / {self._updates}",
                f"{row['eval_success_rate']:.0%}" if row else "-",
                f"{best:.1f} s" if math.isfinite(best) else "-",
                f"{self._bounds[index]:.1f} s",
            )
        return table
