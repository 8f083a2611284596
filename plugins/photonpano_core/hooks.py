"""What this plugin contributes."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from photonpano import (
    InterpolatorContribution,
    MergerContribution,
    ResamplerContribution,
    SourceContribution,
    hookimpl,
)
from photonpano_core.configs import (
    ConstantGroupsConfig,
    GeodesicConfig,
    GroupedConfig,
    LieConfig,
    LucasKanadeConfig,
    MidpointConfig,
    PhotonMleConfig,
    RobustMergeConfig,
    SlidingWindowConfig,
    SmoothingSplineConfig,
    SplatConfig,
    StratifiedConfig,
)
from photonpano_core.constant_groups import ConstantGroupsResampler
from photonpano_core.group_size import AutoResampler
from photonpano_core.grouping import shortest_of, too_short
from photonpano_core.midpoint import MidpointResampler
from photonpano_core.packed_npy import PACKED_NPY
from photonpano_core.sliding_window import SlidingWindowResampler
from photonpano_core.stratified import StratifiedResampler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from photonpano import Interpolator, Merger, Resampler, StageContext, StreamInfo

Grouped = TypeVar("Grouped", bound=GroupedConfig)


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer packed .npy captures."""
    yield PACKED_NPY


@hookimpl
def photonpano_resamplers() -> Iterator[ResamplerContribution]:
    """Offer midpoint resampling, and what it is compared with."""
    yield ResamplerContribution(
        name="midpoint",
        summary="Groups of equal size; each level adds one between every two (paper, section 4)",
        config=MidpointConfig,
        build=_build_midpoint,
        check=_check_groups,
    )
    yield ResamplerContribution(
        name="stratified",
        summary="As many groups as midpoint has, at instants by chance, one in each stratum",
        config=StratifiedConfig,
        build=_build_stratified,
        check=_check_groups,
    )
    yield ResamplerContribution(
        name="sliding-window",
        summary="A group every so many frames, at each level (the paper's comparison)",
        config=SlidingWindowConfig,
        build=_build_sliding_window,
        check=_check_groups,
    )
    yield ResamplerContribution(
        name="constant-groups",
        summary="The same groups at each level (the paper's failing ablation)",
        config=ConstantGroupsConfig,
        build=_build_constant_groups,
        check=_check_groups,
    )


@hookimpl
def photonpano_mergers() -> Iterator[MergerContribution]:
    """Offer maximum-likelihood merging: of everything, of what agrees, and frame by frame."""
    yield MergerContribution(
        name="photon-mle",
        summary="One maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=PhotonMleConfig,
        build=_build_photon_mle,
    )
    yield MergerContribution(
        name="robust-merge",
        summary="photon-mle without ghosts: what moves by itself counts less (Ma and others 2020)",
        config=RobustMergeConfig,
        build=_build_robust_merge,
    )
    yield MergerContribution(
        name="splat",
        summary="Puts each lit pixel where the motion of its own frame says: for the dark, and for fast motion",
        config=SplatConfig,
        build=_build_splat,
    )


@hookimpl
def photonpano_interpolators() -> Iterator[InterpolatorContribution]:
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
    return _of_size(config, context, MidpointResampler, densifies=True)


def _build_stratified(config: StratifiedConfig, context: StageContext) -> Resampler:
    return _of_size(config, context, lambda sized: StratifiedResampler(sized, context.seed), densifies=True)


def _build_sliding_window(config: SlidingWindowConfig, context: StageContext) -> Resampler:
    return _of_size(config, context, SlidingWindowResampler, densifies=False)


def _build_constant_groups(config: ConstantGroupsConfig, context: StageContext) -> Resampler:
    return _of_size(config, context, ConstantGroupsResampler, densifies=False)


def _of_size(
    config: Grouped, context: StageContext, resampler: Callable[[Grouped], Resampler], *, densifies: bool
) -> Resampler:
    """Build a resampler now, or once the capture has told its group size."""
    if config.group_size != "auto":
        return resampler(config)
    return AutoResampler(context, lambda size: resampler(config.model_copy(update={"group_size": size})), densifies)


def _check_groups(config: GroupedConfig, stream: StreamInfo) -> list[str]:
    problem = too_short(shortest_of(stream) if config.group_size == "auto" else config.group_size, stream.n_frames)
    return [problem] if problem else []


def _build_photon_mle(config: PhotonMleConfig, context: StageContext) -> Merger:
    from photonpano_core.photon_mle import PhotonMleMerger

    return PhotonMleMerger(config, context.decide)


def _build_robust_merge(config: RobustMergeConfig, context: StageContext) -> Merger:
    from photonpano_core.robust_merge import RobustMerger

    del context
    return RobustMerger(config)


def _build_splat(config: SplatConfig, context: StageContext) -> Merger:
    from photonpano_core.splat import SplatMerger

    del config, context
    return SplatMerger()


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
