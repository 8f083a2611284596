"""Discovery of plugins and the catalog of what they contribute."""

from photonpano.registry.catalog import BrokenPlugin, Catalog, DisabledPlugin, Entry, Observer, Origin
from photonpano.registry.discovery import discover
from photonpano.registry.kinds import KINDS, Kind

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
