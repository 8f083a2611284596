"""Configs and hooks of the plugin; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from pydantic import Field

import photonpano_kornia as plugin
from photonpano import Config, LocatorContribution, Requirement, SpecPath, StreamInfo, hookimpl
from photonpano.locating import AlignmentConfig, KeypointConfig, MatchingConfig, PyramidConfig


class TorchConfig(Config):
    """Keys that all locators of this plugin share."""

    device: Literal["cpu", "cuda"] = Field("cpu", description="device of torch")


class KorniaRegistratorConfig(TorchConfig, PyramidConfig, AlignmentConfig):
    """Minimisation of the squared difference in brightness, coarse to fine."""

    max_iterations: int = Field(20, ge=1, le=1000, description="largest number of L-BFGS steps on a level of the pyramid")
    converged_px: float = Field(0.01, gt=0, le=1, description="converged when a step moves no corner further than this")


class KorniaFeaturesConfig(TorchConfig, KeypointConfig):
    """SIFT keypoints, matched by SMNN or AdaLAM, RANSAC, least squares."""

    upright: bool = Field(
        True,
        description="keypoints without an orientation, for cameras that roll by less than about 15 degrees",
    )
    matcher: Literal["smnn", "adalam"] = Field(
        "smnn", description="smnn keeps mutual nearest neighbours, adalam those whose neighbours move consistently"
    )
    ratio: float = Field(
        0.85,
        gt=0,
        le=1,
        description="smnn: Lowe's ratio test in both directions: a match is kept if its distance is below this fraction of "
        "that of the second best",
    )


class KorniaLoftrConfig(TorchConfig, MatchingConfig):
    """LoFTR with weights from a file, RANSAC, least squares."""

    weights: SpecPath = Field(description="file with the weights of LoFTR; nothing is downloaded")
    corrected_positions: bool = Field(
        False, description="whether the weights were trained with the corrected positional encoding, as `indoor_ds_new` was"
    )
    min_confidence: float = Field(0.2, ge=0, le=1, description="matches with a lower confidence are dropped")


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
