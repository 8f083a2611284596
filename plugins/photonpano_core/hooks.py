"""Hooks: the components that this plugin offers."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from photonpano import (
    ExecutorContribution,
    ExporterContribution,
    InterpolatorContribution,
    MergerContribution,
    RefinerContribution,
    RendererContribution,
    Requirement,
    ResamplerContribution,
    SourceContribution,
    hookimpl,
)
from photonpano_core.configs import (
    BurstConfig,
    ExrConfig,
    GroupedConfig,
    InterpolatorConfig,
    LocalFlowConfig,
    MergeConfig,
    MidpointConfig,
    PhotonMleConfig,
    RadianceConfig,
    RobustMergeConfig,
    ShortSpansConfig,
    SlidingWindowConfig,
    SplatConfig,
    StratifiedConfig,
    SuperResolutionConfig,
    ThreadsConfig,
)
from photonpano_core.constant_groups import ConstantGroupsResampler
from photonpano_core.group_size import AutoResampler
from photonpano_core.grouping import shortest_of, too_short
from photonpano_core.midpoint import MidpointResampler
from photonpano_core.npy import NPY
from photonpano_core.packed_npy import PACKED_NPY
from photonpano_core.packed_raw import PACKED_RAW
from photonpano_core.sliding_window import SlidingWindowResampler
from photonpano_core.stratified import StratifiedResampler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from photonpano import (
        Executor,
        ExecutorContext,
        Exporter,
        Interpolator,
        Merger,
        Refiner,
        Renderer,
        Resampler,
        StageContext,
        StreamInfo,
    )

Grouped = TypeVar("Grouped", bound=GroupedConfig)


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer .npy captures, packed and not."""
    yield PACKED_NPY
    yield NPY
    yield PACKED_RAW


@hookimpl
def photonpano_resamplers() -> Iterator[ResamplerContribution]:
    """Offer midpoint resampling and its alternatives."""
    yield _resampler(
        "midpoint",
        "Groups of equal size; each level adds one between every two (paper, section 4)",
        MidpointConfig,
        lambda config, _: MidpointResampler(config),
        densifies=True,
    )
    yield _resampler(
        "stratified",
        "As many groups as midpoint, at random instants, one in each stratum",
        StratifiedConfig,
        lambda config, context: StratifiedResampler(config, context.seed),
        densifies=True,
    )
    yield _resampler(
        "sliding-window",
        "Groups at a fixed step, the same at each level (the paper's baseline)",
        SlidingWindowConfig,
        lambda config, _: SlidingWindowResampler(config),
    )
    yield _resampler(
        "constant-groups",
        "The same groups side by side at each level (the paper's failing ablation)",
        GroupedConfig,
        lambda config, _: ConstantGroupsResampler(config),
    )


@hookimpl
def photonpano_mergers() -> Iterator[MergerContribution]:
    """Offer maximum-likelihood merging: of all frames, without moving objects, and photon by photon."""
    yield MergerContribution(
        name="photon-mle",
        summary="Maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=PhotonMleConfig,
        build=_build_photon_mle,
    )
    yield MergerContribution(
        name="robust-merge",
        summary="photon-mle without ghosts: moving objects get less weight (Ma et al. 2020)",
        config=RobustMergeConfig,
        build=_build_robust_merge,
    )
    yield MergerContribution(
        name="splat",
        summary="Warps each photon along the motion of its own frame: for low light and fast motion",
        config=SplatConfig,
        build=_build_splat,
        accepts_corrected_sums=False,
    )
    yield MergerContribution(
        name="local-flow",
        summary="photon-mle, and optical flow where photons contradict the global motion: moving things and parallax are sharp",
        config=LocalFlowConfig,
        build=_build_local_flow,
    )
    yield MergerContribution(
        name="burst",
        summary="Quanta burst photography (Ma et al. 2020): blocks of frames aligned patch by patch in one shot, a baseline",
        config=BurstConfig,
        build=_build_burst,
    )


@hookimpl
def photonpano_interpolators() -> Iterator[InterpolatorContribution]:
    """Offer the paper's interpolation and its alternatives."""
    yield InterpolatorContribution(
        name="lucas-kanade",
        summary="Cubic spline of the eight parameters of the homography (paper, section 4)",
        config=InterpolatorConfig,
        build=_build_lucas_kanade,
    )
    yield InterpolatorContribution(
        name="smoothing-spline",
        summary="Cubic spline of the eight parameters, whose smoothness follows from the noise",
        config=InterpolatorConfig,
        build=_build_smoothing_spline,
    )
    yield InterpolatorContribution(
        name="geodesic",
        summary="Constant velocity from each located instant to the next, along geodesics",
        config=InterpolatorConfig,
        build=_build_geodesic,
    )
    yield InterpolatorContribution(
        name="lie",
        summary="Cubic spline in the group of the homographies",
        config=InterpolatorConfig,
        build=_build_lie,
    )


@hookimpl
def photonpano_refiners() -> Iterator[RefinerContribution]:
    """Offer the refiner that sees what moves inside a group."""
    yield RefinerContribution(
        name="short-spans",
        summary="Tremor inside groups, from the shifts of spans of a few frames against the panorama",
        config=ShortSpansConfig,
        build=_build_short_spans,
    )


@hookimpl
def photonpano_renderers() -> Iterator[RendererContribution]:
    """Offer the merge of all frames, and super-resolution."""
    yield RendererContribution(
        name="merge",
        summary="Maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=MergeConfig,
        build=_build_merge,
        divides_by_light=True,
        renders_on_any_canvas=True,
    )
    yield RendererContribution(
        name="super-resolution",
        summary="The most probable flux on a fine grid, with the area of pixels and a denoiser as prior",
        config=SuperResolutionConfig,
        build=_build_super_resolution,
        bytes_per_pixel=90,  # as measured by tests/benchmarks/super_resolution.py --large
        divides_by_light=True,
    )


def _resampler(
    name: str,
    summary: str,
    config: type[Grouped],
    of_config: Callable[[Grouped, StageContext], Resampler],
    *,
    densifies: bool = False,
) -> ResamplerContribution:
    def build(config: Grouped, context: StageContext) -> Resampler:
        if config.group_size != "auto":
            return of_config(config, context)
        return AutoResampler(
            context, lambda size: of_config(config.model_copy(update={"group_size": size}), context), densifies
        )

    return ResamplerContribution(name=name, summary=summary, config=config, build=build, check=_check_groups)


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


def _build_local_flow(config: LocalFlowConfig, context: StageContext) -> Merger:
    from photonpano_core.dense_motion.local_flow import LocalFlowMerger

    del context
    return LocalFlowMerger(config)


def _build_burst(config: BurstConfig, context: StageContext) -> Merger:
    from photonpano_core.dense_motion.burst import BurstMerger

    del context
    return BurstMerger(config)


def _build_lucas_kanade(config: InterpolatorConfig, context: StageContext) -> Interpolator:
    from photonpano_core.lucas_kanade import LucasKanadeInterpolator

    del context
    return LucasKanadeInterpolator(config)


def _build_smoothing_spline(config: InterpolatorConfig, context: StageContext) -> Interpolator:
    from photonpano_core.smoothing_spline import SmoothingSplineInterpolator

    return SmoothingSplineInterpolator(config, context.stream.frame_shape)


def _build_geodesic(config: InterpolatorConfig, context: StageContext) -> Interpolator:
    from photonpano_core.geodesic import GeodesicInterpolator

    del context
    return GeodesicInterpolator(config)


def _build_lie(config: InterpolatorConfig, context: StageContext) -> Interpolator:
    from photonpano_core.lie import LieInterpolator

    return LieInterpolator(config, context.stream.frame_shape)


def _build_short_spans(config: ShortSpansConfig, context: StageContext) -> Refiner:
    from photonpano_core.short_spans import ShortSpansRefiner

    return ShortSpansRefiner(config, context.stream.frame_shape, context.stream.frame_rate_hz)


def _build_merge(config: MergeConfig, context: StageContext) -> Renderer:
    from photonpano.merging import MergeRenderer

    del config
    return MergeRenderer(context.in_order)


def _build_super_resolution(config: SuperResolutionConfig, context: StageContext) -> Renderer:
    from photonpano_core.super_resolution.renderer import SuperResolutionRenderer

    return SuperResolutionRenderer(config, context.threads, context.decide)


@hookimpl
def photonpano_exporters() -> Iterator[ExporterContribution]:
    """Offer files for pictures of a large range."""
    yield ExporterContribution(
        name="exr",
        summary="OpenEXR: flux, weight, standard deviation and saturated pixels as channels of 32 bits",
        config=ExrConfig,
        suffix=".exr",
        requires=(Requirement("OpenEXR", "photonpano[exr]"),),
        build=_exr,
    )
    yield ExporterContribution(
        name="hdr",
        summary="Radiance: flux in 8 bits a colour with a common exponent",
        config=RadianceConfig,
        suffix=".hdr",
        build=_radiance,
    )


@hookimpl
def photonpano_executors() -> Iterator[ExecutorContribution]:
    """Offer the threads of this process."""
    yield ExecutorContribution(
        name="threads",
        summary="Threads of this process, as many as run.threads says",
        config=ThreadsConfig,
        build=_threads,
    )


def _threads(_: ThreadsConfig, context: ExecutorContext) -> Executor:
    from photonpano.execution import LocalExecutor

    return LocalExecutor(context.threads)


def _exr(config: ExrConfig, _: StageContext) -> Exporter:
    from photonpano_core.exr import ExrExporter

    return ExrExporter(config)


def _radiance(_: RadianceConfig, __: StageContext) -> Exporter:
    from photonpano_core.radiance import RadianceExporter

    return RadianceExporter()
