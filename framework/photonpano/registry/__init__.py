"""Discovery of plugins and the catalog of what they contribute."""

from photonpano.registry.catalog import BrokenPlugin, Catalog, DisabledPlugin, Entry, Observer, Origin
from photonpano.registry.description import ConfigRow, Description, describe
from photonpano.registry.discovery import discover
from photonpano.registry.kinds import KINDS, Kind

__all__ = [
    "KINDS",
    "BrokenPlugin",
    "Catalog",
    "ConfigRow",
    "Description",
    "DisabledPlugin",
    "Entry",
    "Kind",
    "Observer",
    "Origin",
    "describe",
    "discover",
]
