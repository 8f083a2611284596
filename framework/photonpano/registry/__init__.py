"""Discovery of plugins and the catalog of what they contribute."""

from photonpano.contributions import KINDS, Kind
from photonpano.registry.catalog import BrokenPlugin, Catalog, DisabledPlugin, Entry, Observer, Origin
from photonpano.registry.discovery import discover

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
