"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import TypeVar

import photonpano_core as plugin
from photonpano import (
    ExecutorContext,
    ExecutorContribution,
    ExporterContribution,
    InterpolatorContribution,
    MergerContribution,
    RefinerContribution,
    Renderer,
    RendererContribution,
    Requirement,
    Resampler,
    ResamplerContribution,
    SourceContribution,
    StageContext,
    StreamInfo,
    hookimpl,
)
from photonpano_core import configs
from photonpano_core.resamplers import shortest_of, too_short

Grouped = TypeVar("Grouped", bound=configs.GroupedConfig)


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer .npy captures, packed and not."""
    yield plugin.PACKED_NPY
    yield plugin.NPY
    yield plugin.PACKED_RAW


@hookimpl
def photonpano_resamplers() -> Iterator[ResamplerContribution]:
    """Offer midpoint resampling and its alternatives."""
    yield _resampler(
        "midpoint",
        "Groups of equal size; each level adds one between every two (paper, section 4)",
        configs.MidpointConfig,
        lambda config, _: plugin.MidpointResampler(config),
        densifies=True,
    )
    yield _resampler(
        "stratified",
        "As many groups as midpoint, at random instants, one in each stratum",
        configs.StratifiedConfig,
        lambda config, context: plugin.StratifiedResampler(config, context.seed),
        densifies=True,
    )
    yield _resampler(
        "sliding-window",
        "Groups at a fixed step, the same at each level (the paper's baseline)",
        configs.SlidingWindowConfig,
        lambda config, _: plugin.SlidingWindowResampler(config),
    )
    yield _resampler(
        "constant-groups",
        "The same groups side by side at each level (the paper's failing ablation)",
        configs.GroupedConfig,
        lambda config, _: plugin.ConstantGroupsResampler(config),
    )


@hookimpl
def photonpano_mergers() -> Iterator[MergerContribution]:
    """Offer maximum-likelihood merging: of sums of frames, photon by photon, and along a flow."""
    yield MergerContribution(
        name="photon-mle",
        summary="Maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=configs.PhotonMleConfig,
        build=lambda config, context: plugin.PhotonMleMerger(config, context.decide),
        handles_movers=True,
    )
    yield MergerContribution(
        name="splat",
        summary="Warps each photon along the motion of its own frame: for low light and fast motion",
        config=configs.NoKeys,
        build=lambda _config, _context: plugin.SplatMerger(),
        accepts_corrected_sums=False,
    )
    yield MergerContribution(
        name="local-flow",
        summary="photon-mle, and optical flow where photons contradict the global motion: moving things and parallax are sharp",
        config=configs.LocalFlowConfig,
        build=lambda config, _: plugin.LocalFlowMerger(config),
        handles_movers=True,
    )


@hookimpl
def photonpano_interpolators() -> Iterator[InterpolatorContribution]:
    """Offer the paper's interpolation and its alternatives."""
    yield InterpolatorContribution(
        name="lucas-kanade",
        summary="Cubic spline of the eight parameters of the homography (paper, section 4)",
        config=configs.InterpolatorConfig,
        build=lambda config, _: plugin.LucasKanadeInterpolator(config),
    )
    yield InterpolatorContribution(
        name="smoothing-spline",
        summary="Cubic spline of the eight parameters, whose smoothness follows from the noise",
        config=configs.InterpolatorConfig,
        build=lambda config, context: plugin.SmoothingSplineInterpolator(config, context.stream.frame_shape),
    )
    yield InterpolatorContribution(
        name="geodesic",
        summary="Constant velocity from each located instant to the next, along geodesics",
        config=configs.InterpolatorConfig,
        build=lambda config, _: plugin.GeodesicInterpolator(config),
    )


@hookimpl
def photonpano_refiners() -> Iterator[RefinerContribution]:
    """Offer the refiner that sees what moves inside a group."""
    yield RefinerContribution(
        name="short-spans",
        summary="Tremor inside groups, from the shifts of spans of a few frames against the panorama",
        config=configs.ShortSpansConfig,
        build=lambda config, context: plugin.ShortSpansRefiner(
            config, context.stream.frame_shape, context.stream.frame_rate_hz
        ),
    )


@hookimpl
def photonpano_renderers() -> Iterator[RendererContribution]:
    """Offer the merge of all frames, and super-resolution."""
    yield RendererContribution(
        name="merge",
        summary="Maximum-likelihood flux of all photons of a pixel, along the motion (paper, equation 3)",
        config=configs.NoKeys,
        build=_build_merge,
        divides_by_light=True,
        renders_on_any_canvas=True,
    )
    yield RendererContribution(
        name="super-resolution",
        summary="The most probable flux on a fine grid, with the area of pixels and a denoiser as prior",
        config=configs.SuperResolutionConfig,
        build=lambda config, context: plugin.SuperResolutionRenderer(config, context.threads, context.decide),
        bytes_per_pixel=90,  # as measured by tests/benchmarks/super_resolution.py --large
        divides_by_light=True,
    )


@hookimpl
def photonpano_exporters() -> Iterator[ExporterContribution]:
    """Offer files for pictures of a large range."""
    yield ExporterContribution(
        name="exr",
        summary="OpenEXR: flux, weight, standard deviation and saturated pixels as channels of 32 bits",
        config=configs.ExrConfig,
        suffix=".exr",
        requires=(Requirement("OpenEXR", "photonpano[exr]"),),
        build=lambda config, _: plugin.ExrExporter(config),
    )
    yield ExporterContribution(
        name="hdr",
        summary="Radiance: flux in 8 bits a colour with a common exponent",
        config=configs.NoKeys,
        suffix=".hdr",
        build=lambda _config, _context: plugin.RadianceExporter(),
    )


@hookimpl
def photonpano_executors() -> Iterator[ExecutorContribution]:
    """Offer the threads of this process."""
    yield ExecutorContribution(
        name="threads",
        summary="Threads of this process, as many as run.threads says",
        config=configs.NoKeys,
        build=_build_threads,
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
        return plugin.AutoResampler(
            context, lambda size: of_config(config.model_copy(update={"group_size": size}), context), densifies
        )

    return ResamplerContribution(name=name, summary=summary, config=config, build=build, check=_check_groups)


def _check_groups(config: configs.GroupedConfig, stream: StreamInfo) -> list[str]:
    problem = too_short(shortest_of(stream) if config.group_size == "auto" else config.group_size, stream.n_frames)
    return [problem] if problem else []


def _build_merge(_: configs.NoKeys, context: StageContext) -> Renderer:
    from photonpano.merging import MergeRenderer

    return MergeRenderer(context.in_order)


def _build_threads(_: configs.NoKeys, context: ExecutorContext) -> Executor:
    return ThreadPoolExecutor(context.threads)
