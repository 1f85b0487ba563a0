"""What checks the links of the built documentation."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

FAULTS = runpy.run_path(str(Path(__file__).parents[1] / "scripts/site/check.py"))["faults"]


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ('<a href="other.html#there">x</a><img src="sub/picture.png">', None),
        ('<a href="#top">x</a><h1 id="top">y</h1>', None),
        ('<a href="https://example.org/page">x</a>', None),
        ('<a href="missing.html">x</a>', "leads to no file"),
        ('<a href="sub">x</a>', "leads to no file"),
        ('<a href="other.html#elsewhere">x</a>', "leads to no anchor"),
        ('<a href="#nowhere">x</a>', "leads to no anchor"),
        ('<img src="missing.png">', "leads to no file"),
        ('<script src="https://example.org/x.js"></script>', "is loaded from the network"),
        ('<link rel="stylesheet" href="//example.org/x.css">', "is loaded from the network"),
        ('<a href="https:///page">x</a>', "has no host"),
        ('<link rel="canonical" href="https://example.org/page">', None),
        ('<link rel="shortcut icon" href="https://example.org/x.ico">', "loaded from the network"),
        ('<audio src="https://example.org/x.ogg"></audio>', "loaded from the network"),
        ('<p style="background: url(https://example.org/x.png)">x</p>', "loaded from the network"),
        ('<img srcset="https://example.org/x.png 2x" src="sub/picture.png">', "from the network"),
        ('<a href="http://[page">x</a>', "is no address"),
    ],
)
def test_a_link_is_followed_to_its_file_and_anchor(
    body: str, fault: str | None, tmp_path: Path
) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "picture.png").write_bytes(b"")
    (tmp_path / "other.html").write_text('<h2 id="there">x</h2>')
    (tmp_path / "index.html").write_text(body)
    found = FAULTS(tmp_path)
    assert len(found) == (0 if fault is None else 1), found
    assert fault is None or (found[0].startswith("index.html: ") and fault in found[0])


def test_a_site_without_pages_is_a_fault(tmp_path: Path) -> None:
    assert "holds no page" in FAULTS(tmp_path / "nowhere")[0]


def test_a_style_sheet_loads_nothing_from_the_network(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("x")
    (tmp_path / "x.css").write_text(
        '@import "https://example.org/y.css"; p { background: url(y.png) url(data:image/png,x) }'
    )
    assert FAULTS(tmp_path) == ["x.css: https://example.org/y.css: is loaded from the network"]
