"""Prepares the pages that mkdocs renders; mkdocs.yml names this file as a hook.

`build/pages` mirrors the part of the repository that is read: Markdown files and what they link to.
So a relative link leads to the same place on the site as in the repository, and a link to a file
that is not there fails the build. Pages of the API are written from `mjcollect`'s public names.
"""

from __future__ import annotations

import importlib
import re
import shutil
from pathlib import Path
from typing import Any

import mjcollect

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "build" / "pages"
REPLAYS = ROOT / "build" / "replays"  # scripts/site/gallery.py flies them
SOURCES = ["*.md", "assets/**/*.md", "docs/**/*.md", "examples/**/*.md"]
LINK = re.compile(r"\]\((?![a-z]+:)([^)#\s]+)")
# Public, but not on the face of the package.
MORE = {
    "Rules": "mjcollect.envs.episode",
    "fly": "mjcollect.envs.recording",
    "record": "mjcollect.envs.recording",
    "Flight": "mjcollect.envs.recording",
    "generate": "mjcollect.generate",
    "verify": "mjcollect.verify",
    "verify_run": "mjcollect.verify",
    "verify_fleet": "mjcollect.verify",
    "Violation": "mjcollect.verify",
    "Encounter": "mjcollect.verify",
    "FlightEnv": "mjcollect.gym.env",
    "FlightVectorEnv": "mjcollect.gym.vector_env",
    "FlightVecEnv": "mjcollect.gym.sb3",
    "TrainingLog": "mjcollect.learning.logs",
}
ROOMS = ["scene", "envs", "flight", "fleet", "planners", "learning", "gym", "generate", "verify"]


def on_config(config: Any) -> Any:
    """Makes the pages, and has mkdocs read them instead of `docs/`."""
    shutil.rmtree(PAGES, ignore_errors=True)
    for pattern in SOURCES:
        for page in sorted(ROOT.glob(pattern)):
            _copy(page)
            for target in LINK.findall(page.read_text(encoding="utf-8")):
                linked = (page.parent / target).resolve()
                if linked.is_file() and linked.suffix != ".md" and linked.is_relative_to(ROOT):
                    _show(linked) if linked.suffix == ".py" else _copy(linked)
    for name in ("iframe-worker.js", "site.css"):
        shutil.copy(Path(__file__).with_name(name), PAGES)
    if REPLAYS.is_dir():
        shutil.copytree(REPLAYS, PAGES / "docs" / "replays")
    _write_reference()
    config.docs_dir = str(PAGES)
    return config


def on_page_markdown(markdown: str, *, page: Any, **kwargs: Any) -> str:
    """Leads links to Python files to the pages that show them, and lists replays in the gallery."""
    markdown = re.sub(r"(\]\((?![a-z]+:)[^)#\s]+\.py)\)", r"\1.md)", markdown)
    if page.file.src_uri == "docs/gallery.md":
        markdown = markdown.replace("<!-- replays -->", _replays())
    return markdown


def _copy(file: Path) -> None:
    place = PAGES / file.relative_to(ROOT)
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(file, place)


def _show(file: Path) -> None:
    """Writes a page with the source of a Python file."""
    place = PAGES / file.relative_to(ROOT)
    place.parent.mkdir(parents=True, exist_ok=True)
    text = f"# {file.name}\n\n````python\n{file.read_text(encoding='utf-8')}````\n"
    place.with_name(f"{file.name}.md").write_text(text, encoding="utf-8")


def _write_reference() -> None:
    """Writes one page for each room and a page of all names."""
    homes = {f"mjcollect.{name}": home for name, home in mjcollect._HOME.items()}
    homes |= {f"{home}.{name}": home for name, home in MORE.items()}
    folder = PAGES / "api"
    folder.mkdir()
    index = ["# API", "", mjcollect.__doc__ or "", "", "| name | page |", "|---|---|"]
    for room in ROOMS:
        shown = {name: home for name, home in homes.items() if home.split(".")[1] == room}
        doc = importlib.import_module(f"mjcollect.{room}").__doc__ or ""
        lines = [f"# mjcollect.{room}", "", doc, ""]
        for name, home in sorted(shown.items(), key=lambda pair: pair[0].split(".")[-1].lower()):
            path = f"{home}.{name.split('.')[-1]}"
            lines += [f"::: {path}", "    options:", f"      heading: {name}", ""]
            index.append(f"| [`{name}`][{path}] | [{room}]({room}.md) |")
        (folder / f"{room}.md").write_text("\n".join(lines), encoding="utf-8")
    left = {name for name, home in homes.items() if home.split(".")[1] not in ROOMS}
    if left:
        raise SystemExit(f"error: scripts/site/hook.py: ROOMS: {sorted(left)} have no page")
    (folder / "README.md").write_text("\n".join(index) + "\n", encoding="utf-8")


def _replays() -> str:
    found = sorted(REPLAYS.glob("*.html"))
    lines = [f"- [{file.stem.replace('_', ' ')}](replays/{file.name})" for file in found]
    return "\n".join(lines or ["This build has none."])
