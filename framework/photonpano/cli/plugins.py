"""photonpano plugins list, and photonpano plugins show."""

import json
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from photonpano.registry import Catalog, Entry

plugins = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="See what the installed plugins offer.")


class KindName(StrEnum):
    """The kinds of components."""

    SOURCE = "source"
    RESAMPLER = "resampler"
    MERGER = "merger"
    LOCATOR = "locator"
    INTERPOLATOR = "interpolator"


_KIND_NAMES = ", ".join(KindName)


@plugins.command("list")
def list_plugins(
    kind: Annotated[
        KindName | None, typer.Option(metavar="KIND", help=f"Only components of this kind: {_KIND_NAMES}.", show_default=False)
    ] = None,
    broken: Annotated[bool, typer.Option("--broken", help="Only plugins that could not be loaded, and why.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """List what can be chosen in a spec, and who offers it.

    Example: photonpano plugins list --kind locator
    """
    from photonpano.cli.wording import columns
    from photonpano.registry import discover

    catalog = discover()
    rows = [] if broken else [entry for entry in catalog.rows if kind is None or entry.kind == kind.value]
    if as_json:
        typer.echo(json.dumps(_data(rows, catalog), indent=2))
        return
    if rows:
        table = [[entry.kind, entry.name, f"{entry.plugin} {entry.version}", _summary(entry, catalog)] for entry in rows]
        typer.echo(columns([["KIND", "NAME", "PLUGIN", "SUMMARY"], *table]))
    if broken:
        for plugin in catalog.broken:
            typer.echo(plugin)
        if not catalog.broken:
            typer.echo("no plugin is broken")
    elif catalog.broken:
        are = "plugin is" if len(catalog.broken) == 1 else "plugins are"
        typer.echo(f"{len(catalog.broken)} {are} broken, see: photonpano plugins list --broken", err=True)


@plugins.command("show")
def show_plugin(
    name: Annotated[str, typer.Argument(metavar="NAME", help="What specs call the component.", show_default=False)],
    kind: Annotated[
        KindName | None,
        typer.Option(
            metavar="KIND", help=f"Its kind, if components of several have the name: {_KIND_NAMES}.", show_default=False
        ),
    ] = None,
) -> None:
    """Show a component, its keys, and YAML to paste.

    Example: photonpano plugins show opencv-sift
    """
    from photonpano.registry import discover
    from photonpano.registry.suggestions import suggestion

    catalog = discover()
    offered = [entry for entry in catalog.rows if kind is None or entry.kind == kind.value]
    kinds = dict.fromkeys(entry.kind for entry in offered if entry.name == name)
    if not kinds:
        what = "component" if kind is None else kind.value
        hint = suggestion(name, [entry.name for entry in offered])
        raise typer.BadParameter(f"there is no {what} {name!r}; {hint or 'no plugin offers any'}", param_hint="'NAME'")
    typer.echo("\n\n".join(_page(catalog.find(each, name)) for each in kinds))


def _summary(entry: "Entry", catalog: "Catalog") -> str:
    """Return the summary of a component, after what keeps it from being used."""
    if entry.unavailable:
        return f"[not installed: {' '.join(each.install for each in entry.missing)}] {entry.contribution.summary}"
    same = [each for each in catalog.rows if (each.kind, each.name) == (entry.kind, entry.name)]
    return f"{'[name taken twice] ' if len(same) > 1 else ''}{entry.contribution.summary}"


def _data(rows: list["Entry"], catalog: "Catalog") -> dict[str, Any]:
    return {
        "components": [
            {
                "kind": entry.kind,
                "name": entry.name,
                "summary": entry.contribution.summary,
                "plugin": entry.plugin,
                "version": entry.version,
                "entry_point": entry.entry_point,
                "unavailable": entry.unavailable,
            }
            for entry in rows
        ],
        "broken": [
            {"plugin": each.plugin, "version": each.version, "entry_point": each.entry_point, "error": each.error}
            for each in catalog.broken
        ],
    }


def _page(entry: "Entry") -> str:
    from photonpano.cli.wording import columns
    from photonpano.registry import describe

    description = describe(entry.contribution)
    facts = [["kind", entry.kind], ["plugin", entry.origin]]
    if description.install:
        needs = " ".join(f'"{each}"' for each in description.install)
        facts.append(["needs", f"pip install {needs} ({'not installed' if entry.missing else 'installed'})"])
    table = [
        [row.key, row.type, "required" if row.default is None else row.default, row.bounds, row.description]
        for row in description.rows
    ]
    parts = [f"{entry.name}: {description.summary}", columns(facts)]
    if table:
        parts.append(columns([["KEY", "TYPE", "DEFAULT", "BOUNDS", "MEANING"], *table]))
    return "\n\n".join([*parts, description.snippet.rstrip()])
