"""List and describe the components of the installed plugins."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import typer

from photonpano.api.command import command, component_names, json_lines
from photonpano.plugins.contributions import KINDS, install_command
from photonpano.plugins.description import config_rows, snippet
from photonpano.plugins.registry import Catalog, Entry, Origin, discover
from photonpano.text import columns


def _kinds() -> list[str]:
    """Return all kinds of components; plugins that are found may define some."""
    discover()
    return list(KINDS)


def _kind(text: str) -> str:
    if text in (kinds := _kinds()):
        return text
    raise typer.BadParameter(f"{text!r} is not one of {', '.join(map(repr, kinds))}.")


def kind_option(help_text: str) -> Any:
    """Return the option `--kind`."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in _kinds() if name.startswith(incomplete)]

    return typer.Option(metavar="KIND", parser=_kind, autocompletion=complete, help=f"{help_text}: {', '.join(_kinds())}.")


def _lines_of_list(catalog: Catalog, *, kind: str | None = None, broken: bool = False, as_json: bool = False) -> Iterator[str]:
    rows = [] if broken else [entry for entry in catalog.rows if kind in (None, entry.kind)]
    if as_json:
        yield from json_lines(
            {
                "components": [facts(entry) for entry in rows],
                "broken": [asdict(each.origin) | {"error": each.error} for each in catalog.broken],
                "disabled": [asdict(each.origin) | {"by": each.by} for each in catalog.disabled],
                "observers": [asdict(each.origin) | {"hooks": each.watches} for each in catalog.observers],
            }
        )
    elif broken:
        yield from map(str, catalog.broken or ["no plugin is broken"])
    else:
        if table := _table(rows, catalog, with_observers=kind is None):
            yield columns([["KIND", "NAME", "PLUGIN", "SUMMARY"], *table])
        if catalog.broken:
            are = "plugin is" if len(catalog.broken) == 1 else "plugins are"
            typer.echo(f"{len(catalog.broken)} {are} broken, see: photonpano plugins list --broken", err=True)


@command(
    "--kind locator",
    _lines_of_list,
    kind=kind_option("Only components of this kind"),
    broken=typer.Option(help="Only plugins that cannot be loaded, with the error."),
)
def plugins_list(catalog: Catalog) -> Catalog:
    """List components that a spec can use, with their plugins."""
    return catalog


def _table(rows: list[Entry], catalog: Catalog, with_observers: bool) -> list[list[str]]:
    """Return the rows of the list: components, plugins that watch runs, disabled plugins."""
    return [
        *([entry.kind, entry.name, _release(entry.origin), _summary(entry, catalog)] for entry in rows),
        *(
            ["observer", _label(each.origin), _release(each.origin), f"Watches runs: {', '.join(each.watches)}"]
            for each in (catalog.observers if with_observers else ())
        ),
        *(["disabled", _label(each.origin), _release(each.origin), f"By {each.by}"] for each in catalog.disabled),
    ]


def _release(origin: Origin) -> str:
    return f"{origin.plugin} {origin.version}"


def _label(origin: Origin) -> str:
    return origin.entry_point.partition(" = ")[0]


def _summary(entry: Entry, catalog: Catalog) -> str:
    """Return the summary of a component, after the reason why it cannot be used, if there is one."""
    if entry.unavailable:
        return f"[not installed: {' '.join(each.install for each in entry.missing)}] {entry.contribution.summary}"
    taken_twice = len(catalog.entries(entry.kind, entry.name)) > 1
    return f"{'[name taken twice] ' if taken_twice else ''}{entry.contribution.summary}"


def facts(entry: Entry) -> dict[str, Any]:
    """Return what a component is, and where it comes from."""
    named = {"kind": entry.kind, "name": entry.name, "summary": entry.contribution.summary}
    return named | asdict(entry.origin) | {"unavailable": entry.unavailable}


def _lines_of_components(entries: list[Entry], *, as_json: bool = False) -> Iterator[str]:
    if as_json:
        yield from json_lines({"components": [_details(entry) for entry in entries]})
    else:
        yield "\n\n".join(map(_page, entries))


@command(
    "opencv-sift",
    _lines_of_components,
    name=typer.Argument(metavar="NAME", autocompletion=component_names()),
    kind=kind_option("The kind, if components of several kinds share the name"),
)
def _plugins_show(name: str, kind: str | None = None, *, catalog: Catalog) -> list[Entry]:
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
