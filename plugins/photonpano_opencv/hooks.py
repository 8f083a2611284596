"""Hooks of the plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import LocatorContribution, hookimpl
from photonpano_opencv.configs import OpencvEccConfig, OpencvOrbConfig, OpencvSiftConfig, PhaseCorrelationConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Locator, StageContext


@hookimpl
def photonpano_locators() -> Iterator[LocatorContribution]:
    """Offer keypoints and alignment of brightness."""
    yield LocatorContribution(
        name="opencv-sift",
        summary="SIFT keypoints, ratio test, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvSiftConfig,
        build=_build_sift,
    )
    yield LocatorContribution(
        name="opencv-orb",
        summary="ORB keypoints, ratio test on bits, MAGSAC, and a least-squares fit of the inliers",
        config=OpencvOrbConfig,
        build=_build_orb,
    )
    yield LocatorContribution(
        name="opencv-ecc",
        summary="Alignment that maximises the enhanced correlation coefficient, coarse to fine",
        config=OpencvEccConfig,
        build=_build_ecc,
    )
    yield LocatorContribution(
        name="phase-correlation",
        summary="The shift between two exposures, for cameras that turn without rolling",
        config=PhaseCorrelationConfig,
        build=_build_phase_correlation,
    )


def _build_sift(config: OpencvSiftConfig, context: StageContext) -> Locator:
    from photonpano_opencv.sift import SiftLocator

    return SiftLocator(config, context.seed)


def _build_orb(config: OpencvOrbConfig, context: StageContext) -> Locator:
    from photonpano_opencv.orb import OrbLocator

    return OrbLocator(config, context.seed)


def _build_ecc(config: OpencvEccConfig, context: StageContext) -> Locator:
    from photonpano_opencv.ecc import EccLocator

    del context
    return EccLocator(config)


def _build_phase_correlation(config: PhaseCorrelationConfig, context: StageContext) -> Locator:
    from photonpano_opencv.phase import PhaseCorrelationLocator

    del context
    return PhaseCorrelationLocator(config)
