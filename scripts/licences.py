"""Prints the licences of all that an installation brings, as its own metadata state them.

.venv/bin/python scripts/licences.py          # direct and indirect dependencies
.venv/bin/python scripts/licences.py --write  # puts the direct ones into docs/licences.md
"""

from __future__ import annotations

import argparse
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PAGE = Path(__file__).parents[1] / "docs" / "licences.md"
BEGIN, END = "<!-- by scripts/licences.py -->", "<!-- end -->"
# Extras that no user needs, and one that `make setup` does not install, so that it is not read.
LEFT_OUT = {"bench", "dev", "wandb"}


def extras() -> list[str]:
    """Returns mjcollect's extras for users."""
    offered = distribution("mjcollect").metadata.get_all("Provides-Extra", [])
    return [extra for extra in offered if extra not in LEFT_OUT]


def needed(name: str, extra: str = "") -> list[Requirement]:
    """Returns what an installed package requires here: always, or for one of its extras."""
    where = default_environment() | {"extra": extra}
    lines = (Requirement(line) for line in distribution(name).requires or ())
    return [
        line
        for line in lines
        if (line.marker is None and not extra)
        or (line.marker and line.marker.evaluate(where) and bool(extra) == _of_extra(line))
    ]


def _of_extra(line: Requirement) -> bool:
    return "extra ==" in str(line.marker)


def direct() -> dict[str, str]:
    """Returns mjcollect's own dependencies with the extras that need them, blank for none."""
    found = {line.name: "" for line in needed("mjcollect")}
    for extra in extras():
        for line in needed("mjcollect", extra):
            found[line.name] = ", ".join(filter(None, [found.get(line.name), extra]))
    return found


def all_needed() -> list[str]:
    """Returns the names of all installed packages that mjcollect needs, directly or not."""
    queue: list[tuple[str, str]] = [
        ("mjcollect", ""),
        *(("mjcollect", extra) for extra in extras()),
    ]
    seen = set(queue)
    for name, extra in queue:
        try:
            lines = needed(name, extra)
        except PackageNotFoundError:  # an optional one that is not there
            continue
        for line in lines:
            for wanted in ("", *line.extras):
                step = (canonicalize_name(line.name), wanted)
                if step not in seen:
                    seen.add(step)
                    queue.append(step)
    return sorted({name for name, _ in queue} - {"mjcollect"})


def licence(found: Distribution) -> str:
    """Returns what a package's metadata call its licence, in a few words."""
    meta = found.metadata
    if "License-Expression" in meta:
        return str(meta["License-Expression"])
    classified = [
        line.rsplit(" :: ", 1)[-1]
        for line in meta.get_all("Classifier", [])
        if line.startswith("License :: ") and line != "License :: OSI Approved"
    ]
    text = str(meta["License"] or "").strip()
    if text and "\n" not in text and len(text) < 60:  # others hold a whole licence
        return text
    if classified or text:
        return ", ".join(classified) or text.split("\n")[0]
    files = (found.read_text(f"licenses/{name}") for name in meta.get_all("License-File", []))
    return next((text.split("\n")[0] for text in files if text), "not stated")


def rows(names: list[str]) -> list[tuple[str, str, str]]:
    """Returns name, version and licence of those packages that are installed."""
    found = []
    for name in names:
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        version = package.version.split("+")[0]  # without the build, as in 2.13.0+cpu
        found.append((package.metadata["Name"], version, licence(package)))
    return found


def table() -> str:
    """Returns the Markdown table of the direct dependencies that are installed."""
    lines = ["| package | version | extra | licence |", "|---|---|---|---|"]
    for wanted, extra in direct().items():
        for name, version, terms in rows([wanted]):
            lines.append(f"| {name} | {version} | {extra} | {terms} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """Returns the page with the table of today."""
    between = f"{BEGIN}\n{table()}\n{END}"
    return re.sub(f"{re.escape(BEGIN)}.*?{re.escape(END)}", lambda _: between, text, flags=re.S)


def main() -> None:
    """Prints the table of everything, or writes that of the page."""
    parser = argparse.ArgumentParser(description="Prints the licences of all dependencies.")
    parser.add_argument("--write", action="store_true", help="Brings docs/licences.md up to date.")
    if parser.parse_args().write:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
        return
    for name, version, terms in rows(all_needed()):
        print(f"{name}=={version}: {terms}")


if __name__ == "__main__":
    main()
