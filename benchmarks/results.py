"""Where benchmarks put what they measured."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from train.support.run_folder import versions as all_versions


def save(
    path: Path | None,
    content: Mapping[str, Any],
    *,
    arguments: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
) -> None:
    """Write a JSON file, whole or not at all, with machine and versions; nothing without a path.

    Args:
        arguments: of the program, its `out` left blank. versions: `train.runs.versions()` if None.
    """
    if path is None:
        return
    called = {} if arguments is None else {"arguments": {**arguments, "out": None}}
    document = {
        **called,
        "machine": {"cpus": os.cpu_count(), "processor": platform.machine()},
        "versions": all_versions() if versions is None else versions,
        **content,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".part-{path.name}")
    part.write_text(json.dumps(document, indent=1) + "\n")
    part.replace(path)
