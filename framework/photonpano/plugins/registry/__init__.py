"""Discovery of plugins and the catalog of what they contribute."""

from photonpano.plugins.contributions import KINDS, Kind
from photonpano.plugins.registry.catalog import BrokenPlugin, Catalog, DisabledPlugin, Entry, Observer, Origin
from photonpano.plugins.registry.discovery import discover

__all__ = [
    "KINDS",
    "BrokenPlugin",
    "Catalog",
    "DisabledPlugin",
    "Entry",
    "Kind",
    "Observer",
    "Origin",
    "discover",
]
