"""Checks the built site: every link leads to a file and an anchor of it, and nothing is fetched.

mkdocs checks links between Markdown files; this also sees what is in HTML, as in the API reference,
and refuses pages that load anything from the network. Addresses elsewhere are only parsed.
Usage: python scripts/site/check.py SITE
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = ("src", "poster", "data")  # Attributes whose address a browser loads, of any tag.
LINKED = {"canonical", "alternate", "next", "prev", "author", "license"}  # `rel` that loads nothing
URL = re.compile(r"""(?:url\(|@import)\s*["']?([^"')\s;]+)""")  # in styles


class Page(HTMLParser):
    """Collects the anchors of a page, what it links to, and what it loads."""

    def __init__(self, text: str) -> None:
        """Parses the text of a page."""
        super().__init__()
        self.anchors: set[str] = {""}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes what a tag names, links to or loads."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag == "link" and not LINKED & set(values.get("rel", "").split()):
            self.loads.append(values["href"])
        self.loads += [values[name] for name in LOADED if values.get(name)]
        self.loads += [part.split()[0] for part in values.get("srcset", "").split(",") if part]
        self.loads += URL.findall(values.get("style", ""))


def faults(site: Path) -> list[str]:
    """Returns one line for each broken link of the pages below `site`."""
    files = sorted(site.rglob("*.html"))
    if not files:
        return [f"{site}: holds no page; build the site first"]
    pages = {file.resolve(): Page(file.read_text(encoding="utf-8")) for file in files}
    found = []
    for file, page in pages.items():
        name = file.relative_to(site.resolve())
        for link in [*page.links, *page.loads]:
            try:
                address = urlsplit(link)
            except ValueError as error:
                found.append(f"{name}: {link}: is no address: {error}")
                continue
            if address.scheme or address.netloc:
                if link in page.loads and address.scheme != "data":
                    found.append(f"{name}: {link}: is loaded from the network")
                elif address.scheme in ("http", "https") and not address.hostname:
                    found.append(f"{name}: {link}: has no host")
                continue
            if file.name == "404.html":
                continue  # is shown below any address, so its links begin at the site's own
            target = (file.parent / unquote(address.path)).resolve() if address.path else file
            if not target.is_file():
                found.append(f"{name}: {link}: leads to no file")
            elif target in pages and unquote(address.fragment) not in pages[target].anchors:
                found.append(f"{name}: {link}: leads to no anchor")
    for sheet in sorted(site.rglob("*.css")):
        for address in URL.findall(sheet.read_text(encoding="utf-8")):
            if urlsplit(address).netloc:
                found.append(f"{sheet.relative_to(site)}: {address}: is loaded from the network")
    return found


if __name__ == "__main__":
    lines = faults(Path(sys.argv[1]))
    print(*lines, sep="\n", file=sys.stderr)
    print(f"{len(lines)} broken links")
    raise SystemExit(bool(lines))
