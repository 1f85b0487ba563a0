"""Tables in Markdown, for reports, result pages and what the benchmarks print."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table: the names of its columns, a rule, and its rows."""
    head, *body = (f"| {' | '.join(row)} |" for row in (columns, *rows))
    return [head, "|" + "---|" * len(columns), *body]
