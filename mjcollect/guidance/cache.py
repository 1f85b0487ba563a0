"""Guidance in files, so that what takes a second to build is built once for all processes of a run.

A file is called by a digest of all that decides its content: the scene, the leg and the code that
builds. So another scene, another leg or another version never finds it, and nothing goes stale.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from functools import cache
from pathlib import Path

import numpy as np

from mjcollect.geometry import compiled
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.way import Way
from mjcollect.scene.scene import Scene

ROOMS = ("geometry", "scene", "flight", "guidance")  # what builds guidance stands in these


def file_name(scene: Scene, node: int, start: Array, next_goal: Array | None = None) -> str:
    """Name of the file of a guidance with these arguments, see `Guidance`."""
    leg = {"node": node, "start": start.tolist()}
    leg["next_goal"] = None if next_goal is None else next_goal.tolist()
    text = json.dumps(scene.to_dict() | leg, sort_keys=True) + _code()
    return f"guidance-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"


@cache
def _code() -> str:
    """Digest of the rooms that guidance is built from."""
    package = Path(__file__).parents[1]
    return compiled.digest(path for room in ROOMS for path in package.glob(f"{room}/*.py"))


def save(built: Guidance, folder: Path) -> Path:
    """Write a guidance into `folder` unless it is there; the file's path.

    Raises:
        OSError: it cannot be written.
    """
    path = folder / file_name(built.scene, built.node, built.start, built.next_goal)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        # Whole or not at all, also if another process writes the same.
        draft = path.with_suffix(f".{os.getpid()}.tmp")
        with draft.open("wb") as file:
            np.savez(file, path=built.path, **built.way._asdict())
        draft.replace(path)
    return path


def load(
    folder: Path, scene: Scene, node: int, start: Array, next_goal: Array | None = None
) -> Guidance | None:
    """The guidance saved in `folder`, the same as one built anew; None if it has no whole file."""
    try:
        with np.load(
            folder / file_name(scene, node, start, next_goal), allow_pickle=False
        ) as saved:
            way = Way(**{name: saved[name] for name in Way._fields})
            return Guidance(scene, node, start, next_goal, built=(saved["path"], way))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None
