"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, hookimpl
from photonpano_opencv.configs import DirectConfig, OpencvSiftConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Locator, StageContext


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution[OpencvSiftConfig] | LocatorContribution[DirectConfig]]:
    """Offer SIFT and direct alignment."""
    yield LocatorContribution(
        name="opencv-sift",
        summary="SIFT keypoints, ratio test, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvSiftConfig,
        build=_build_sift,
    )
    yield LocatorContribution(
        name="direct",
        summary="Inverse-compositional alignment of brightness, coarse to fine, weighted by photon statistics",
        config=DirectConfig,
        build=_build_direct,
    )


def _build_sift(config: OpencvSiftConfig, context: StageContext) -> Locator:
    from photonpano_opencv.sift import SiftLocator

    return SiftLocator(config, context.seed)


def _build_direct(config: DirectConfig, context: StageContext) -> Locator:
    from photonpano_opencv.direct import DirectLocator

    del context
    return DirectLocator(config)
