"""Find the installed plugins; a broken one becomes a row, and the others go on."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from importlib.metadata import version as version_of

from photonpano.errors import PluginError
from photonpano.hookspecs import PROJECT
from photonpano.registry.catalog import BrokenPlugin, Catalog, make_entry, ordered
from photonpano.registry.chain import CHAIN
from photonpano.registry.plugins import contributions_of


def discover() -> Catalog:
    """Load every plugin in the entry-point group `photonpano` and collect what they and the framework offer.

    Never raises for what a plugin does wrong: see `Catalog.broken`. A plugin is taken whole or not at all.
    """
    rows = [make_entry(CHAIN, PROJECT, version_of(PROJECT), "built in")]
    broken: list[BrokenPlugin] = []
    for entry_point in entry_points(group=PROJECT):
        plugin, version = _distribution(entry_point)
        label = f"{entry_point.name} = {entry_point.value}"
        try:
            offered = contributions_of(entry_point.load())
            rows += [make_entry(contribution, plugin, version, label) for contribution in offered]
        except (Exception, SystemExit) as error:  # whatever the plugin's import does, it is a row
            broken.append(BrokenPlugin(plugin, version, label, _in_a_line(error)))
    return Catalog(ordered(rows), tuple(sorted(broken, key=str)))


def _in_a_line(error: BaseException) -> str:
    head = "" if isinstance(error, PluginError) else f"{type(error).__name__}: "
    return head + " ".join(str(error).split())


def _distribution(entry_point: EntryPoint) -> tuple[str, str]:
    """Return name and version; the metadata of a damaged installation may lack either."""
    if entry_point.dist is None:
        return "unknown", "unknown"
    metadata = entry_point.dist.metadata
    name, version = (metadata.get_all(key, ["unknown"])[0] for key in ("Name", "Version"))
    return name, version
