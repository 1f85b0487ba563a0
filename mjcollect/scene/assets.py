"""Finds bundled files: scenes, the quadrotor, the shipped policy."""

from __future__ import annotations

from pathlib import Path


def asset_path(*parts: str) -> Path:
    """Returns the path of a bundled asset, in a checkout (`assets/`) or in an installed wheel."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "assets"
    root = installed if installed.is_dir() else package.parent / "assets"
    return root.joinpath(*parts)
