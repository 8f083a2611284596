"""Hooks of the plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, Requirement, hookimpl
from photonpano_kornia.configs import KorniaFeaturesConfig, KorniaLoftrConfig, KorniaRegistratorConfig

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from photonpano import Locator, StageContext, StreamInfo

REQUIRES = (Requirement("kornia", "photonpano[kornia]"),)  # kornia installs torch


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer alignment by brightness, features, and learned matches."""
    yield LocatorContribution(
        name="kornia-registrator",
        summary="Alignment of brightness by L-BFGS through kornia's warps, coarse to fine, on a CPU or GPU",
        config=KorniaRegistratorConfig,
        build=_build_registrator,
        requires=REQUIRES,
    )
    yield LocatorContribution(
        name="kornia-features",
        summary="kornia's SIFT keypoints, SMNN or AdaLAM, RANSAC, and a least-squares fit of the inliers",
        config=KorniaFeaturesConfig,
        build=_build_features,
        requires=REQUIRES,
    )
    yield LocatorContribution(
        name="kornia-loftr",
        summary="LoFTR's learned matches with weights from your file, RANSAC, and a least-squares fit of the inliers",
        config=KorniaLoftrConfig,
        build=_build_loftr,
        check=_check_loftr,
        requires=REQUIRES,
    )


def _build_registrator(config: KorniaRegistratorConfig, context: StageContext) -> Locator:
    from photonpano_kornia.registrator import RegistratorLocator

    del context
    return RegistratorLocator(config)


def _build_features(config: KorniaFeaturesConfig, context: StageContext) -> Locator:
    from photonpano_kornia.features import FeatureLocator

    return FeatureLocator(config, context.seed)


def _build_loftr(config: KorniaLoftrConfig, context: StageContext) -> Locator:
    from photonpano_kornia.loftr import LoftrLocator

    return LoftrLocator(config, context.seed)


def _check_loftr(config: KorniaLoftrConfig, stream: StreamInfo) -> Sequence[str]:
    del stream
    if config.weights.is_file():
        return ()
    return (f"there is no file {config.weights} with weights of LoFTR, and nothing is downloaded: set `weights` to your file",)
