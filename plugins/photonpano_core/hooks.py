"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import (
    InterpolatorContribution,
    MergerContribution,
    ResamplerContribution,
    SourceContribution,
    hookimpl,
)
from photonpano_core.configs import LucasKanadeConfig, MidpointConfig, PhotonMleConfig
from photonpano_core.midpoint import MidpointResampler, too_short
from photonpano_core.packed_npy import PACKED_NPY, PackedNpyConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Interpolator, Merger, StageContext, StreamInfo


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution[PackedNpyConfig]]:
    """Offer packed .npy captures."""
    yield PACKED_NPY


@hookimpl
def photonpano_resamplers() -> Iterator[ResamplerContribution[MidpointConfig]]:
    """Offer midpoint resampling."""
    yield ResamplerContribution(
        name="midpoint",
        summary="Groups of equal size; each level adds one between every two (paper, section 4)",
        config=MidpointConfig,
        build=lambda config, _: MidpointResampler(config),
        check=_check_midpoint,
    )


@hookimpl
def photonpano_mergers() -> Iterator[MergerContribution[PhotonMleConfig]]:
    """Offer maximum-likelihood merging."""
    yield MergerContribution(
        name="photon-mle",
        summary="One maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=PhotonMleConfig,
        build=_build_photon_mle,
    )


@hookimpl
def photonpano_interpolators() -> Iterator[InterpolatorContribution[LucasKanadeConfig]]:
    """Offer the paper's interpolation."""
    yield InterpolatorContribution(
        name="lucas-kanade",
        summary="Cubic spline of the eight parameters of the homography (paper, section 4)",
        config=LucasKanadeConfig,
        build=_build_lucas_kanade,
    )


def _check_midpoint(config: MidpointConfig, stream: StreamInfo) -> list[str]:
    problem = too_short(config.group_size, stream.n_frames)
    return [problem] if problem else []


def _build_photon_mle(config: PhotonMleConfig, context: StageContext) -> Merger:
    from photonpano_core.photon_mle import PhotonMleMerger

    del context
    return PhotonMleMerger(config)


def _build_lucas_kanade(config: LucasKanadeConfig, context: StageContext) -> Interpolator:
    from photonpano_core.lucas_kanade import LucasKanadeInterpolator

    del context
    return LucasKanadeInterpolator(config)
