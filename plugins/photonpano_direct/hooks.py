"""Hooks of the plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, hookimpl
from photonpano_direct.configs import DirectConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Locator, StageContext


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer direct alignment."""
    yield LocatorContribution(
        name="direct",
        summary="Inverse-compositional alignment of brightness, coarse to fine, weighted by photon statistics",
        config=DirectConfig,
        build=_build_direct,
    )


def _build_direct(config: DirectConfig, context: StageContext) -> Locator:
    from photonpano_direct.locator import DirectLocator

    del context
    return DirectLocator(config)
