"""Describe a component: its keys, and YAML to paste."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import typer

from photonpano.api.command import command, component_names, json_lines
from photonpano.api.plugins.list import facts, kind_option
from photonpano.plugins.contributions import install_command
from photonpano.plugins.registry import Catalog, Entry
from photonpano.plugins.registry.description import config_rows, snippet
from photonpano.text import columns


def _lines(entries: list[Entry], *, as_json: bool = False) -> Iterator[str]:
    if as_json:
        yield from json_lines({"components": [_details(entry) for entry in entries]})
    else:
        yield "\n\n".join(map(_page, entries))


@command(
    "opencv-sift",
    _lines,
    name=typer.Argument(metavar="NAME", autocompletion=component_names()),
    kind=kind_option("The kind, if components of several kinds share the name"),
)
def _show(name: str, kind: str | None = None, *, catalog: Catalog) -> list[Entry]:
    """Describe a component: its keys, and YAML to paste.

    Args:
        name: the name of the component in specs.
        kind: the kind, if components of several kinds share the name.
        catalog: what can be chosen.
    """
    kinds = dict.fromkeys(entry.kind for entry in catalog.rows if entry.name == name and kind in (None, entry.kind))
    if not kinds:
        raise typer.BadParameter(catalog.unknown(kind, name), param_hint="'NAME'")
    return [catalog.find(each, name) for each in kinds]


def _details(entry: Entry) -> dict[str, Any]:
    return facts(entry) | {
        "api_version": entry.contribution.api_version,
        "requires": [asdict(each) for each in entry.contribution.requires],
        "keys": [asdict(row) for row in config_rows(entry.contribution.config)],
        "snippet": snippet(entry.contribution),
    }


def _page(entry: Entry) -> str:
    facts = [["kind", entry.kind], ["plugin", str(entry.origin)]]
    if modules := ", ".join(each.module for each in entry.contribution.requires):
        state = f"(not installed): {install_command(entry.missing)}" if entry.missing else "(installed)"
        facts.append(["needs", f"{modules} {state}"])
    table = [
        [row.key, row.type, "required" if row.default is None else row.default, row.bounds, row.description]
        for row in config_rows(entry.contribution.config)
    ]
    parts = [f"{entry.name}: {entry.contribution.summary}", columns(facts)]
    if table:
        parts.append(columns([["KEY", "TYPE", "DEFAULT", "BOUNDS", "MEANING"], *table]))
    return "\n\n".join([*parts, snippet(entry.contribution).rstrip()])
