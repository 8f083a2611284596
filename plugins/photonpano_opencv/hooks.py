"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, hookimpl
from photonpano_opencv.configs import OpencvSiftConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Locator, StageContext


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution[OpencvSiftConfig]]:
    """Offer SIFT."""
    yield LocatorContribution(
        name="opencv-sift",
        summary="SIFT keypoints, ratio test, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvSiftConfig,
        build=_build_sift,
    )


def _build_sift(config: OpencvSiftConfig, context: StageContext) -> Locator:
    from photonpano_opencv.sift import SiftLocator

    return SiftLocator(config, context.seed)
