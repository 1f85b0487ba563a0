"""mjcollect: a MuJoCo suite for UAV item collection among box obstacles.

Importing the package is light: names load on first use, and no GL is touched.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

_EXPORTS = {
    "Scene": "mjcollect.scene",
    "SceneError": "mjcollect.scene",
    "Trajectory": "mjcollect.trajectory",
    "load": "mjcollect.task",
}
__all__ = ["Scene", "SceneError", "Trajectory", "asset_path", "load"]


def asset_path(*parts: str) -> Path:
    """Path of a bundled asset, in a checkout (`assets/`) or in an installed wheel."""
    package = Path(__file__).resolve().parent
    installed = package / "assets"
    root = installed if installed.is_dir() else package.parent / "assets"
    return root.joinpath(*parts)


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'mjcollect' has no attribute {name!r}")
