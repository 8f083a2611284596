"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator

import photonpano_opencv as plugin
from photonpano import LocatorContribution, hookimpl
from photonpano_opencv.configs import OpencvEccConfig, OpencvOrbConfig, OpencvSiftConfig, PhaseCorrelationConfig


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
