"""Configs and hooks of the plugin; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

import photonpano_opencv as plugin
from photonpano import LocatorContribution, hookimpl
from photonpano.locating import AlignmentConfig, KeypointConfig, PyramidConfig


class OpencvSiftConfig(KeypointConfig):
    """SIFT keypoints, ratio test, MAGSAC, least squares."""

    contrast_threshold: float = Field(
        0.02,
        ge=0,
        le=1,
        description="keypoints with less contrast after a blur of 1 px are dropped; OpenCV's own default is 0.04",
    )


class OpencvOrbConfig(KeypointConfig):
    """ORB keypoints, ratio test on bits, MAGSAC, least squares."""

    fast_threshold: int = Field(
        20,
        ge=1,
        le=255,
        description="least difference between a corner and the circle around it; black is 0, white is 255",
    )
    pyramid_levels: int = Field(8, ge=1, le=16, description="number of scales on which corners are detected")
    pyramid_scale: float = Field(1.2, gt=1, le=2, description="ratio of one scale to the one before")


class OpencvEccConfig(PyramidConfig, AlignmentConfig):
    """Alignment that maximises the enhanced correlation coefficient, coarse to fine."""

    max_iterations: int = Field(50, ge=1, le=1000, description="largest number of steps on a level of the pyramid")
    converged: float = Field(
        1e-5, gt=0, le=0.1, description="converged when a step changes the correlation coefficient by less than this"
    )


class PhaseCorrelationConfig(AlignmentConfig):
    """Shift by phase correlation."""

    peak_px: float = Field(
        1.5,
        ge=0.5,
        le=16,
        description="standard deviation of the correlation peak, in px: wider is more robust against noise",
    )
    max_rounds: int = Field(
        5,
        ge=1,
        le=20,
        description="largest number of rounds, each of which shifts the images and correlates them again",
    )
    converged_px: float = Field(0.05, gt=0, le=1, description="converged when a round changes the shift by less than this")


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer keypoints and alignment of brightness."""
    yield LocatorContribution(
        name="opencv-sift",
        summary="SIFT keypoints, ratio test, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvSiftConfig,
        build=lambda config, context: plugin.SiftLocator(config, context.seed),
    )
    yield LocatorContribution(
        name="opencv-orb",
        summary="ORB keypoints, ratio test on bits, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvOrbConfig,
        build=lambda config, context: plugin.OrbLocator(config, context.seed),
    )
    yield LocatorContribution(
        name="opencv-ecc",
        summary="Alignment that maximises the enhanced correlation coefficient, coarse to fine",
        config=OpencvEccConfig,
        build=lambda config, _: plugin.EccLocator(config),
    )
    yield LocatorContribution(
        name="phase-correlation",
        summary="The shift between two exposures, for cameras that turn without rolling",
        config=PhaseCorrelationConfig,
        build=lambda config, _: plugin.PhaseCorrelationLocator(config),
    )
