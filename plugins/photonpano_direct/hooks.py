"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator

import photonpano_direct as plugin
from photonpano import LocatorContribution, hookimpl
from photonpano_direct.configs import DirectConfig


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer direct alignment."""
    yield LocatorContribution(
        name="direct",
        summary="Inverse-compositional alignment of brightness, coarse to fine, weighted by photon statistics",
        config=DirectConfig,
        build=lambda config, _: plugin.DirectLocator(config),
    )
