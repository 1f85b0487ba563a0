"""Keeps guidance in files, so that what takes a second is built once for all processes of a run.

A file is named by a digest of all that decides its content: the scene, the segment and the code
that builds. So another scene, segment or version never finds it, and no file goes stale.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from functools import cache
from pathlib import Path

import numpy as np

from mjcollect.geometry import compiled
from mjcollect.geometry.compiled import Array
from mjcollect.guidance.guidance import Guidance
from mjcollect.guidance.way import Way
from mjcollect.scene.scene import Scene

# Reading a file that is damaged, or is none, ends in one of these; nothing in it is unpickled.
DAMAGED = (
    OSError, KeyError, ValueError, EOFError, RuntimeError, TypeError, SyntaxError, OverflowError,
    MemoryError, IndexError, AttributeError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip
ROOMS = ("geometry", "scene", "flight", "guidance")  # The code that builds guidance is in these.


def file_name(scene: Scene, node: int, start: Array, next_goal: Array | None = None) -> str:
    """Returns the name of the file of a `Guidance` with these arguments."""
    segment = {"node": node, "start": start.tolist()}
    segment["next_goal"] = None if next_goal is None else next_goal.tolist()
    text = json.dumps(scene.to_dict() | segment, sort_keys=True) + _code()
    return f"guidance-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"


@cache
def _code() -> str:
    """Returns a digest of the code that guidance is built by."""
    package = Path(__file__).parents[1]
    return compiled.digest(path for room in ROOMS for path in package.glob(f"{room}/*.py"))


def save(built: Guidance, folder: Path) -> Path:
    """Writes a guidance into `folder` unless it is there; returns the file's path.

    Raises:
        OSError: the file cannot be written.
    """
    path = folder / file_name(built.scene, built.node, built.start, built.next_goal)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        # The file appears whole or not at all, also if another process writes the same.
        draft = path.with_suffix(f".{os.getpid()}.tmp")
        with draft.open("wb") as file:
            numbers = built.way._asdict()
            del numbers["tree"]  # It is the scene's.
            np.savez(file, path=built.path, **numbers)
        draft.replace(path)
    return path


def load(
    folder: Path, scene: Scene, node: int, start: Array, next_goal: Array | None = None
) -> Guidance | None:
    """Returns the guidance saved in `folder`, equal to one built anew, or None if none is whole."""
    try:
        with np.load(
            folder / file_name(scene, node, start, next_goal), allow_pickle=False
        ) as saved:
            numbers = {name: saved[name] for name in Way._fields if name != "tree"}
            way = Way(tree=scene.tree, **numbers)
            return Guidance(scene, node, start, next_goal, built=(saved["path"], way))
    except DAMAGED:
        return None
