"""The kinds of components, and what each is called in hooks and in specs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from photonpano.contributions import (
    Contribution,
    ExecutorContribution,
    ExporterContribution,
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    PoseEstimatorContribution,
    RefinerContribution,
    RendererContribution,
    ResamplerContribution,
    SourceContribution,
)

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of component.

    Attributes:
        name: what a component of this kind is, such as `locator`.
        section: where a spec chooses it, such as `locate` or `output.formats`.
        hook: the hook that offers it, such as `photonpano_locators`.
        contribution: the record that the hook yields.
        methods: what the component does.
    """

    name: str
    section: str
    hook: str
    contribution: type[Contribution]
    methods: tuple[str, ...]


KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("source", "source", "photonpano_sources", SourceContribution, ("counts", "frames", "close")),
        Kind("resampler", "resample", "photonpano_resamplers", ResamplerContribution, ("groups",)),
        Kind("merger", "merge", "photonpano_mergers", MergerContribution, ("merge",)),
        Kind("locator", "locate", "photonpano_locators", LocatorContribution, ("describe", "register")),
        Kind("interpolator", "interpolate", "photonpano_interpolators", InterpolatorContribution, ("fit",)),
        Kind("refiner", "refine", "photonpano_refiners", RefinerContribution, ("refine",)),
        Kind("renderer", "render", "photonpano_renderers", RendererContribution, ("render",)),
        Kind("exporter", "output.formats", "photonpano_exporters", ExporterContribution, ("export",)),
        Kind("pose-estimator", "pose", "photonpano_pose_estimators", PoseEstimatorContribution, ("estimate",)),
        Kind("executor", "run.executor", "photonpano_executors", ExecutorContribution, ("share", "call", "keep", "close")),
    )
}
"""All kinds by name, in the order in which a run needs them."""
