"""Baselines that the paper and the benchmarks compare with: the merger `burst` and the interpolator `lie`."""

from __future__ import annotations

from photonpano import Catalog, discover


def catalog() -> Catalog:
    """Return what the installed plugins offer, and the baselines, whether or not they are installed."""
    from photonpano_baselines import hooks

    found = discover()
    return found if found.entries("merger", "burst") else found.including(hooks)
