"""Find the installed plugins; a broken one becomes a row, and the others go on."""

from __future__ import annotations

import logging
from importlib.metadata import EntryPoint, entry_points
from importlib.metadata import version as version_of

from photonpano.errors import PluginError
from photonpano.hookspecs import PROJECT
from photonpano.registry.auto import AUTO
from photonpano.registry.catalog import BrokenPlugin, Catalog, DisabledPlugin, make_entry, ordered
from photonpano.registry.chain import CHAIN
from photonpano.registry.disabling import DISABLE, Switch
from photonpano.registry.observers import Observer
from photonpano.registry.plugins import contributions_of, observation_of

logger = logging.getLogger(__name__)


def discover() -> Catalog:
    """Load every plugin in the entry-point group `photonpano` and collect what they and the framework offer.

    Never raises for what a plugin does wrong: see `Catalog.broken`. A plugin is taken whole or not at all. One that the
    environment variable `PHOTONPANO_DISABLE_PLUGINS` names, by its distribution or its entry point, is not even imported: see
    `Catalog.disabled`. Names there that are no plugin's are logged as a warning.
    """
    rows = [make_entry(own, PROJECT, version_of(PROJECT), "built in") for own in (AUTO, CHAIN)]
    broken: list[BrokenPlugin] = []
    disabled: list[DisabledPlugin] = []
    observers: list[Observer] = []
    switch = Switch()
    for entry_point in entry_points(group=PROJECT):
        plugin, version = _distribution(entry_point)
        label = f"{entry_point.name} = {entry_point.value}"
        if word := switch.word_for(entry_point.name, plugin):
            disabled.append(DisabledPlugin(plugin, version, label, f"{DISABLE}={word}"))
            continue
        try:
            loaded = entry_point.load()
            hook = observation_of(loaded)
            rows += [make_entry(contribution, plugin, version, label) for contribution in contributions_of(loaded)]
            if hook:
                observers.append(Observer(plugin, version, label, hook))
        except (Exception, SystemExit) as error:  # whatever the plugin's import does, it is a row
            broken.append(BrokenPlugin(plugin, version, label, _in_a_line(error)))
    if unknown := switch.unknown():
        logger.warning(unknown)
    return Catalog(
        ordered(rows),
        tuple(sorted(broken, key=str)),
        tuple(sorted(disabled, key=str)),
        tuple(sorted(observers, key=lambda observer: observer.origin)),
    )


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
