"""Words and number formats that claims and page share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

HOLDS, PARTLY, FAILS = "holds", "holds in part", "does not hold"
UNDECIDED, UNTESTED = "undecided", "not tested"  # intervals that say nothing; no flights
FEW = 5  # random scenes; on fewer no verdict is built
Document = Mapping[str, Any]
Verdict = tuple[str, str, dict[str, float]]  # verdict, reason, numbers that no table holds


def percent(share: float, digits: int = 1) -> str:
    """A share as '12.3%'."""
    return f"{100 * share:.{digits}f}%"


def interval(row: Mapping[str, Any], scale: float = 100.0, digits: int = 1, unit: str = "%") -> str:
    """Mean and 95% interval of a `summary`."""
    mean = f"{scale * row['mean']:.{digits}f}{unit}"
    if row["low"] is None:
        return mean
    return f"{mean} [{scale * row['low']:.{digits}f}, {scale * row['high']:.{digits}f}]"
