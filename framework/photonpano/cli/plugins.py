"""photonpano plugins list, and photonpano plugins show."""

import json
from dataclasses import asdict
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from photonpano.cli.command import Command
from photonpano.cli.options import Json, component_names

if TYPE_CHECKING:
    from photonpano.registry import Catalog, Entry, Origin

plugins = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="List and describe the components of the installed plugins."
)


class KindName(StrEnum):
    """The kinds of components."""

    SOURCE = "source"
    RESAMPLER = "resampler"
    MERGER = "merger"
    LOCATOR = "locator"
    INTERPOLATOR = "interpolator"
    REFINER = "refiner"
    RENDERER = "renderer"
    EXPORTER = "exporter"
    POSE_ESTIMATOR = "pose-estimator"
    EXECUTOR = "executor"


_KIND_NAMES = ", ".join(KindName)


@plugins.command("list", cls=Command)
def list_plugins(
    kind: Annotated[
        KindName | None, typer.Option(metavar="KIND", help=f"Only components of this kind: {_KIND_NAMES}.", show_default=False)
    ] = None,
    broken: Annotated[bool, typer.Option("--broken", help="Only plugins that cannot be loaded, with the error.")] = False,
    as_json: Json = False,
) -> None:
    """List components that a spec can use, with their plugins.

    Example: photonpano plugins list --kind locator
    """
    from photonpano.cli.tables import columns
    from photonpano.registry import discover

    catalog = discover()
    rows = [] if broken else [entry for entry in catalog.rows if kind is None or entry.kind == kind.value]
    if as_json:
        typer.echo(json.dumps(_data(rows, catalog), indent=2))
        return
    table = [] if broken else _table(rows, catalog, with_observers=kind is None)
    if table:
        typer.echo(columns([["KIND", "NAME", "PLUGIN", "SUMMARY"], *table]))
    if broken:
        for plugin in catalog.broken:
            typer.echo(plugin)
        if not catalog.broken:
            typer.echo("no plugin is broken")
    elif catalog.broken:
        are = "plugin is" if len(catalog.broken) == 1 else "plugins are"
        typer.echo(f"{len(catalog.broken)} {are} broken, see: photonpano plugins list --broken", err=True)


@plugins.command("show", cls=Command)
def show_plugin(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="The name of the component in specs.", show_default=False, autocompletion=component_names()
        ),
    ],
    kind: Annotated[
        KindName | None,
        typer.Option(
            metavar="KIND", help=f"The kind, if components of several kinds share the name: {_KIND_NAMES}.", show_default=False
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Describe a component: its keys, and YAML to paste.

    Example: photonpano plugins show opencv-sift
    """
    from photonpano.registry import discover

    catalog = discover()
    wanted = None if kind is None else kind.value
    kinds = dict.fromkeys(entry.kind for entry in catalog.rows if entry.name == name and wanted in (None, entry.kind))
    if not kinds:
        raise typer.BadParameter(catalog.unknown(wanted, name), param_hint="'NAME'")
    entries = [catalog.find(each, name) for each in kinds]
    if as_json:
        typer.echo(json.dumps({"components": [_details(entry) for entry in entries]}, indent=2))
    else:
        typer.echo("\n\n".join(map(_page, entries)))


def _table(rows: list["Entry"], catalog: "Catalog", with_observers: bool) -> list[list[str]]:
    """Return the rows of the list: components, plugins that watch runs, disabled plugins."""
    return [
        *([entry.kind, entry.name, _release(entry.origin), _summary(entry, catalog)] for entry in rows),
        *(
            ["observer", _label(each.origin), _release(each.origin), f"Watches runs: {', '.join(each.watches)}"]
            for each in (catalog.observers if with_observers else ())
        ),
        *(["disabled", _label(each.origin), _release(each.origin), f"By {each.by}"] for each in catalog.disabled),
    ]


def _release(origin: "Origin") -> str:
    return f"{origin.plugin} {origin.version}"


def _label(origin: "Origin") -> str:
    return origin.entry_point.partition(" = ")[0]


def _summary(entry: "Entry", catalog: "Catalog") -> str:
    """Return the summary of a component, after the reason why it cannot be used, if there is one."""
    if entry.unavailable:
        return f"[not installed: {' '.join(each.install for each in entry.missing)}] {entry.contribution.summary}"
    taken_twice = len(catalog.entries(entry.kind, entry.name)) > 1
    return f"{'[name taken twice] ' if taken_twice else ''}{entry.contribution.summary}"


def _data(rows: list["Entry"], catalog: "Catalog") -> dict[str, Any]:
    return {
        "components": [_facts(entry) for entry in rows],
        "broken": [asdict(each.origin) | {"error": each.error} for each in catalog.broken],
        "disabled": [asdict(each.origin) | {"by": each.by} for each in catalog.disabled],
        "observers": [asdict(each.origin) | {"hooks": each.watches} for each in catalog.observers],
    }


def _facts(entry: "Entry") -> dict[str, Any]:
    named = {"kind": entry.kind, "name": entry.name, "summary": entry.contribution.summary}
    return named | asdict(entry.origin) | {"unavailable": entry.unavailable}


def _details(entry: "Entry") -> dict[str, Any]:
    from photonpano.registry.description import config_rows, snippet

    return _facts(entry) | {
        "api_version": entry.contribution.api_version,
        "requires": [asdict(each) for each in entry.contribution.requires],
        "keys": [asdict(row) for row in config_rows(entry.contribution.config)],
        "snippet": snippet(entry.contribution),
    }


def _page(entry: "Entry") -> str:
    from photonpano.cli.tables import columns
    from photonpano.contributions import install_command
    from photonpano.registry.description import config_rows, snippet

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
