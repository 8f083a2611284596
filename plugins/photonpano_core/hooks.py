"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from photonpano import (
    InterpolatorContribution,
    MergerContribution,
    ResamplerContribution,
    SourceContribution,
    hookimpl,
)
from photonpano_core.configs import (
    GeodesicConfig,
    LieConfig,
    LucasKanadeConfig,
    MidpointConfig,
    PhotonMleConfig,
    SmoothingSplineConfig,
)
from photonpano_core.group_size import AutoMidpointResampler
from photonpano_core.midpoint import SHORTEST, MidpointResampler, too_short
from photonpano_core.packed_npy import PACKED_NPY, PackedNpyConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano import Interpolator, Merger, Resampler, StageContext, StreamInfo


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
        build=_build_midpoint,
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
def photonpano_interpolators() -> Iterator[InterpolatorContribution[Any]]:
    """Offer the paper's interpolation, and others."""
    yield InterpolatorContribution(
        name="lucas-kanade",
        summary="Cubic spline of the eight parameters of the homography (paper, section 4)",
        config=LucasKanadeConfig,
        build=_build_lucas_kanade,
    )
    yield InterpolatorContribution(
        name="smoothing-spline",
        summary="Cubic spline of the eight parameters, as smooth as the noise asks for",
        config=SmoothingSplineConfig,
        build=_build_smoothing_spline,
    )
    yield InterpolatorContribution(
        name="geodesic",
        summary="Constant velocity from each located instant to the next, along geodesics",
        config=GeodesicConfig,
        build=_build_geodesic,
    )
    yield InterpolatorContribution(
        name="lie",
        summary="Cubic spline in the group of the homographies",
        config=LieConfig,
        build=_build_lie,
    )


def _build_midpoint(config: MidpointConfig, context: StageContext) -> Resampler:
    return AutoMidpointResampler(config, context) if config.group_size == "auto" else MidpointResampler(config)


def _check_midpoint(config: MidpointConfig, stream: StreamInfo) -> list[str]:
    problem = too_short(SHORTEST if config.group_size == "auto" else config.group_size, stream.n_frames)
    return [problem] if problem else []


def _build_photon_mle(config: PhotonMleConfig, context: StageContext) -> Merger:
    from photonpano_core.photon_mle import PhotonMleMerger

    return PhotonMleMerger(config, context.decide)


def _build_lucas_kanade(config: LucasKanadeConfig, context: StageContext) -> Interpolator:
    from photonpano_core.lucas_kanade import LucasKanadeInterpolator

    del context
    return LucasKanadeInterpolator(config)


def _build_smoothing_spline(config: SmoothingSplineConfig, context: StageContext) -> Interpolator:
    from photonpano_core.smoothing_spline import SmoothingSplineInterpolator

    return SmoothingSplineInterpolator(config, context.stream.frame_shape)


def _build_geodesic(config: GeodesicConfig, context: StageContext) -> Interpolator:
    from photonpano_core.geodesic import GeodesicInterpolator

    del context
    return GeodesicInterpolator(config)


def _build_lie(config: LieConfig, context: StageContext) -> Interpolator:
    from photonpano_core.lie import LieInterpolator

    return LieInterpolator(config, context.stream.frame_shape)
