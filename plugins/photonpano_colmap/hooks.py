"""Hooks of the plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, Requirement, hookimpl
from photonpano_colmap.configs import PycolmapTwoViewConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Locator, StageContext


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer the two-view geometry of COLMAP."""
    yield LocatorContribution(
        name="pycolmap-two-view",
        summary="COLMAP's SIFT and matcher, LO-RANSAC, and a least-squares fit of the inliers",
        config=PycolmapTwoViewConfig,
        build=_build_two_view,
        requires=(Requirement("pycolmap", "photonpano[colmap]"),),
    )


def _build_two_view(config: PycolmapTwoViewConfig, context: StageContext) -> Locator:
    from photonpano_colmap.two_view import TwoViewLocator

    return TwoViewLocator(config, context.seed)
