"""Write measured tables into pages, between the comments that mark their places."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path


def require_places(page: Path, names: Iterable[str]) -> None:
    """Refuse a page that lacks the place of a table, before hours are spent on measuring it."""
    text = page.read_text(encoding="utf-8")
    for name in names:
        begin, end = _marks(name)
        if not 0 <= text.find(begin) < text.find(end):
            raise SystemExit(f"{page}: there is no place for the table {name}; mark it with {begin} and {end}")


def write_tables(page: Path, tables: Mapping[str, Iterable[str]]) -> None:
    """Replace tables, each given by its name and its lines."""
    require_places(page, tables)
    text = page.read_text(encoding="utf-8")
    for name, lines in tables.items():
        begin, end = _marks(name)
        before, rest = text.split(begin)
        text = "\n".join([f"{before}{begin}", *lines, end]) + rest.split(end)[1]
    page.write_text(text, encoding="utf-8")


def _marks(name: str) -> tuple[str, str]:
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
