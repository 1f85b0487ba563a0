"""One display for all segments of a mission: state, success rate, time against bound, time left."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.table import Table

from mjcollect.scene.bounds import segment_bound
from mjcollect.scene.order import legs, node_name
from mjcollect.scene.scene import Scene
from train.support.mission_report import read_metrics
from train.support.run_folder import RunFolder

REFRESH = 1.0  # seconds between looks at the segments' metrics


class MissionDisplay:
    """A live table on a terminal, a line per finished segment in a log file.

    It reads the segments' metrics.csv, so it shows the same wherever they are trained.
    """

    def __init__(self, folder: Path, scene: Scene, order: tuple[int, ...], updates: int) -> None:
        """Prepare the table; nothing is shown until entered."""
        self._folder, self._updates = folder, updates
        self._ways = [(frm, to, segment_bound(scene, frm, to)) for frm, to in legs(order)]
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, refresh_per_second=2, transient=False)
        self._shown, self._begun, self._at_start = 0.0, time.monotonic(), self._total()
        self._moving = sys.stderr.isatty()

    def __enter__(self) -> MissionDisplay:
        """Start showing."""
        if self._moving:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Show the last state and stop."""
        if self._moving:
            self._live.update(self._table())
            self._live.stop()

    def update(self) -> None:
        """Look again, at most once a second."""
        if self._moving and time.monotonic() - self._shown > REFRESH:
            self._live.update(self._table())
            self._shown = time.monotonic()

    def finished(self, index: int) -> None:
        """Say that a training of segment `index` has ended."""
        if not self._moving:
            row = self._last(index)
            self._console.print(
                f"segment {index}: trained, success rate {row.get('eval_success_rate', 0):.0%}, "
                f"best {row.get('best_time', math.nan):.1f} s (bound {self._ways[index][2]:.1f} s)",
                highlight=False,
            )

    def _last(self, index: int) -> dict[str, float]:
        """The last row of a segment's metrics; of a finished one with the kept policy's success."""
        folder = RunFolder(self._folder / "segments" / str(index))
        rows = read_metrics(folder.path / "metrics.csv")
        last = rows[-1] if rows else {}
        if (result := folder.read_json("segment.json")) is not None:
            last["eval_success_rate"] = result["success_rate"]
        return last

    def _total(self) -> float:
        return sum(self._last(index).get("update", 0.0) for index in range(len(self._ways)))

    def _left(self) -> str:
        done = self._total()
        gained = done - self._at_start
        if gained <= 0:
            return "-"
        rate = gained / (time.monotonic() - self._begun)
        seconds = max(len(self._ways) * self._updates - done, 0.0) / rate
        return f"{seconds / 60:.0f} min left" if seconds >= 60 else f"{seconds:.0f} s left"

    def _table(self) -> Table:
        table = Table(title=f"training, {self._left()}")
        for column in ("segment", "from", "to", "state", "updates", "success", "best", "bound"):
            table.add_column(column, justify="right" if column in ("best", "bound") else "left")
        for index, (frm, to, bound) in enumerate(self._ways):
            folder = self._folder / "segments" / str(index)
            row = self._last(index)
            state = "waiting"
            if (folder / "segment.json").is_file():
                state = "done"
            elif (folder / "config.json").is_file():
                state = "training"
            best = row.get("best_time", math.nan)
            table.add_row(
                str(index),
                node_name(frm),
                node_name(to),
                state,
                f"{row.get('update', 0):.0f} / {self._updates}",
                f"{row['eval_success_rate']:.0%}" if row else "-",
                f"{best:.1f} s" if math.isfinite(best) else "-",
                f"{bound:.1f} s",
            )
        return table
