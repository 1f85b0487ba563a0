"""Puts a replay's document, the page's own code and three.js into one file of HTML."""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjcollect.render.runs import load_run, shown_name
from mjcollect.replay.payload import ReplayError, document

FILE = "replay.html"  # What a run's own replay is called.
PARTS = Path(__file__).parent / "assets"
# The page's code in this order; names that one file defines are known to those after it.
SCRIPTS = ("flight.js", "world.js", "uavs.js", "cameras.js", "hover.js", "panel.js", "main.js")


def replay_in(folder: str | os.PathLike[str]) -> Path:
    """Writes the replay of a run into its folder, over an older one; returns its path.

    Raises:
        UnreadableRun: the folder is no finished run.
        OSError: it cannot be written.
    """
    path = Path(folder) / FILE
    write_replay([folder], path)
    return path


def write_replay(folders: Sequence[str | os.PathLike[str]], out: Path) -> None:
    """Writes one page for the runs in folders, all of one scene; it appears whole or not at all.

    Raises:
        UnreadableRun: a folder is no finished run.
        ReplayError: the runs were flown in different scenes.
        OSError: the file cannot be written.
    """
    runs = [load_run(folder) for folder in folders]
    text = page(document(runs, distinct_names([Path(folder).resolve() for folder in folders])))
    part = out.with_name(f".part-{os.getpid()}-{out.name}")  # another process may write it too
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, out)
    finally:
        part.unlink(missing_ok=True)


def distinct_names(folders: Sequence[Path]) -> list[str]:
    """Returns the last parts of folders' paths, as many as tell them apart.

    Raises:
        ReplayError: a folder is named twice.
    """
    for depth in range(1, max(len(folder.parts) for folder in folders) + 1):
        names = [shown_name("/".join(folder.parts[-depth:])) for folder in folders]
        if len(set(names)) == len(names):
            return names
    twice = next(folder for folder in folders if folders.count(folder) > 1)
    raise ReplayError(f"{twice.name}: is given twice; name each run once")


def page(shown: dict[str, Any]) -> str:
    """Returns the HTML of a replay; `shown` is the document of `payload.document`."""
    title = " and ".join(run["name"] for run in shown["runs"]) + " · " + shown["scene"]["name"]
    filled = {
        "title": html.escape(title),
        "style": _read("replay.css"),
        "licence": _read("three.LICENSE"),
        "library": _read("three.min.js"),
        "data": script_json(shown),
        "script": "\n".join(_read(name) for name in SCRIPTS),
    }
    # In one pass, so that nothing that is put in is taken for a place to fill.
    return re.sub(r"@@(\w+)@@", lambda found: filled[found[1]], _read("replay.html"))


def script_json(shown: object) -> str:
    """Returns JSON that no HTML parser takes for the end of the script that it stands in."""
    text = json.dumps(shown, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _read(name: str) -> str:
    return (PARTS / name).read_text(encoding="utf-8")
