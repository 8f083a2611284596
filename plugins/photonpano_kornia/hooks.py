"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import photonpano_kornia as plugin
from photonpano import LocatorContribution, Requirement, StreamInfo, hookimpl
from photonpano_kornia.configs import KorniaFeaturesConfig, KorniaLoftrConfig, KorniaRegistratorConfig

REQUIRES = (Requirement("kornia", "photonpano[kornia]"),)  # kornia installs torch


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer alignment by brightness, features, and learned matches."""
    yield LocatorContribution(
        name="kornia-registrator",
        summary="Alignment of brightness by L-BFGS through kornia's warps, coarse to fine, on a CPU or GPU",
        config=KorniaRegistratorConfig,
        build=lambda config, _: plugin.RegistratorLocator(config),
        requires=REQUIRES,
    )
    yield LocatorContribution(
        name="kornia-features",
        summary="kornia's SIFT keypoints, SMNN or AdaLAM, RANSAC, and a least-squares fit of the inliers",
        config=KorniaFeaturesConfig,
        build=lambda config, context: plugin.FeatureLocator(config, context.seed),
        requires=REQUIRES,
    )
    yield LocatorContribution(
        name="kornia-loftr",
        summary="LoFTR's learned matches with weights from your file, RANSAC, and a least-squares fit of the inliers",
        config=KorniaLoftrConfig,
        build=lambda config, context: plugin.LoftrLocator(config, context.seed),
        check=_check_loftr,
        requires=REQUIRES,
    )


def _check_loftr(config: KorniaLoftrConfig, _: StreamInfo) -> Sequence[str]:
    if config.weights.is_file():
        return ()
    return (f"there is no file {config.weights} with weights of LoFTR, and nothing is downloaded: set `weights` to your file",)
