"""Offer the baselines to specs, once `pip install -e tests/benchmarks/baselines` has installed them."""

from __future__ import annotations

from typing import Any

from photonpano import Interpolator, InterpolatorContribution, Merger, MergerContribution, StageContext, hookimpl
from photonpano_baselines.configs import BurstConfig
from photonpano_core.configs import InterpolatorConfig


@hookimpl
def photonpano_mergers() -> MergerContribution:
    """Offer the baseline of the paper's supplement S1."""
    return MergerContribution(
        name="burst",
        summary="Quanta burst photography (Ma et al. 2020): blocks of frames aligned patch by patch in one shot, a baseline",
        config=BurstConfig,
        build=_burst,
    )


@hookimpl
def photonpano_interpolators() -> InterpolatorContribution:
    """Offer the smooth curve that the page about interpolation compares with."""
    return InterpolatorContribution(
        name="lie", summary="Cubic spline in the group of the homographies", config=InterpolatorConfig, build=_lie
    )


def _burst(config: Any, _: StageContext) -> Merger:
    from photonpano_baselines.burst import BurstMerger

    return BurstMerger(config)


def _lie(config: Any, context: StageContext) -> Interpolator:
    from photonpano_baselines.lie import LieInterpolator

    return LieInterpolator(config, context.stream.frame_shape)
