"""Compares a run's flights with those in another run's results.json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from train.support.run_folder import RunError

COMPARED = ("order", "success", "mission_time", "segment_times", "contacts", "updates")


def load_cells(path: Path) -> dict[str, Any]:
    """Return the entries of the cells in a results.json, by name.

    Raises:
        RunError: there is no such file, or it is none.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["cells"])
    except OSError as error:
        raise RunError(f"--against: {path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise RunError(f"--against: {path}: is no results.json of train.reproduce") from None


def differences(
    names: Sequence[str], ours: Mapping[str, Mapping[str, Any]], theirs: Mapping[str, Any]
) -> dict[str, str]:
    """Return what differs, by cell; nothing if all flights of `names` are the same in both."""
    found = {}
    for name in names:
        if name not in theirs:
            found[name] = "not in the other run"
        elif name not in ours:
            found[name] = "not flown"
        else:
            one, two = ours[name], theirs[name]
            found[name] = "; ".join(
                f"{key} {one[key]}, there {two[key]}" for key in COMPARED if one[key] != two[key]
            )
    return {name: what for name, what in found.items() if what}
