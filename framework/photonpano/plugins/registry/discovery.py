"""Find the installed plugins: a broken one becomes a row of the catalog, and the others go on."""

from __future__ import annotations

import logging
import os
import re
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points

from photonpano.errors import PluginError, described
from photonpano.plugins.contributions import PROJECT
from photonpano.plugins.registry.catalog import (
    BrokenPlugin,
    Catalog,
    DisabledPlugin,
    Entry,
    Observer,
    Origin,
    make_entry,
    ordered,
)
from photonpano.plugins.registry.plugins import contributions_of, observation_of
from photonpano.text import listed, suggestion

logger = logging.getLogger(__name__)

DISABLE = "PHOTONPANO_DISABLE_PLUGINS"  # an environment variable: names of distributions or entry points, separated by commas


def discover() -> Catalog:
    """Load every plugin in the entry-point group `photonpano` and collect what they offer.

    Never raises for what a plugin does wrong: see `Catalog.broken`. A plugin is taken whole or not at all. A plugin that the
    environment variable `PHOTONPANO_DISABLE_PLUGINS` names, by its distribution or its entry point, is not imported: see
    `Catalog.disabled`. Names in the variable that are no plugin's are logged as a warning.
    """
    rows: list[Entry] = []
    broken: list[BrokenPlugin] = []
    disabled: list[DisabledPlugin] = []
    observers: list[Observer] = []
    words = [word.strip() for word in os.environ.get(DISABLE, "").split(",")]
    disabling = {_canonical(word): word for word in words if word}
    names: set[str] = set()
    for entry_point in entry_points(group=PROJECT):
        origin = _origin(entry_point)
        names |= {entry_point.name, origin.plugin}
        if by := disabling.get(_canonical(entry_point.name)) or disabling.get(_canonical(origin.plugin)):
            disabled.append(DisabledPlugin(origin, f"{DISABLE}={by}"))
            continue
        try:
            loaded = entry_point.load()
            hook = observation_of(loaded)
            rows += [make_entry(contribution, origin) for contribution in contributions_of(loaded)]
            if hook:
                observers.append(Observer(origin, hook))
        except Exception as error:  # whatever is wrong with a plugin, it is a row
            message = str(error) if isinstance(error, PluginError) else described(error)
            broken.append(BrokenPlugin(origin, " ".join(message.split())))
    if unknown := [word for key, word in disabling.items() if key not in set(map(_canonical, names))]:
        hint = suggestion(unknown[0], names) if len(unknown) == 1 else f"known: {listed(sorted(names))}"
        are = "is no installed plugin" if len(unknown) == 1 else "are no installed plugins"
        logger.warning("%s names %s, which %s; %s", DISABLE, listed(map(repr, unknown)), are, hint)
    return Catalog(
        ordered(rows),
        tuple(sorted(broken, key=str)),
        tuple(sorted(disabled, key=str)),
        tuple(sorted(observers, key=lambda observer: observer.origin)),
    )


def _canonical(name: str) -> str:
    """Return a name as those of packages are compared: without regard to case, and to the choice of `-`, `_` and `.`."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _origin(entry_point: EntryPoint) -> Origin:
    """Return the origin of a plugin; the metadata of a damaged installation may lack name or version."""
    metadata = None
    with suppress(OSError):  # where a library has brought importlib_metadata, that raises for missing metadata
        metadata = entry_point.dist.metadata if entry_point.dist else None
    name, version = (metadata.get_all(key, ["unknown"])[0] if metadata else "unknown" for key in ("Name", "Version"))
    return Origin(name, version, f"{entry_point.name} = {entry_point.value}")
