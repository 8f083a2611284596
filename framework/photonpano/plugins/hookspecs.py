"""The extension points: a hook for each kind of component, which takes no arguments, and hooks that watch runs.

A plugin is a module with these hooks, named in the entry-point group `photonpano` of its distribution:

    [project.entry-points.photonpano]
    my-plugin = "my_plugin.hooks"

The hook module imports no heavy library; the component does so when it is built. `examples/third_party_plugin` is such a
distribution, and `docs/tutorial/first-plugin.md` writes it step by step. `docs/reference/plugins.md` has a section for each
hook, with an example that the tests run.

`discover` calls the hooks that offer components. If one raises, or yields anything but its contributions, the plugin becomes
a row of `Catalog.broken`. A run builds the components of its spec; what breaks the contract of a component, and any error that
is not for users, becomes a `PluginError` that names the plugin.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from photonpano.plugins.contributions import (
    ExecutorContribution,
    ExporterContribution,
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    RefinerContribution,
    RendererContribution,
    ResamplerContribution,
    RunKindContribution,
    SourceContribution,
    hookspec,
)


@hookspec
def photonpano_sources() -> Iterable[SourceContribution]:
    """Offer sources: they open a capture and give the summed counts, or the frames, of a span.

    A run builds its source first. A capture that cannot be read is an `InputError`.
    Example: `docs/reference/plugins.md#photonpano_sources`.
    """
    return ()


@hookspec
def photonpano_resamplers() -> Iterable[ResamplerContribution]:
    """Offer resamplers: they choose the groups of frames of each level.

    A level calls its resampler first. A capture that is too short is an `InputError`.
    Example: `docs/reference/plugins.md#photonpano_resamplers`.
    """
    return ()


@hookspec
def photonpano_mergers() -> Iterable[MergerContribution]:
    """Offer mergers: they merge the frames of a group into a virtual exposure.

    A level calls its merger for each group, from several threads. An exposure of another group or scale is a `PluginError`.
    Example: `docs/reference/plugins.md#photonpano_mergers`.
    """
    return ()


@hookspec
def photonpano_locators() -> Iterable[LocatorContribution]:
    """Offer locators: they find the motion between two virtual exposures.

    A level calls its locator for each exposure and each pair, from several threads. A pair that cannot be located is no error:
    the locator returns `NotLocated`. Example: `docs/reference/plugins.md#photonpano_locators`.
    """
    return ()


@hookspec
def photonpano_interpolators() -> Iterable[InterpolatorContribution]:
    """Offer interpolators: they turn located instants into a trajectory.

    A level calls its interpolator last, more than once. A trajectory far from what it was fitted to is a `PluginError`.
    Example: `docs/reference/plugins.md#photonpano_interpolators`.
    """
    return ()


@hookspec
def photonpano_refiners() -> Iterable[RefinerContribution]:
    """Offer refiners: they correct the motion after the last level, from residuals of short spans of frames.

    A run calls each of its refiners for some rounds, until it returns None. A motion that explains the photons worse is not
    used, and no error. Example: `docs/reference/plugins.md#photonpano_refiners`.
    """
    return ()


@hookspec
def photonpano_renderers() -> Iterable[RendererContribution]:
    """Offer renderers: they render flux and weight on a canvas.

    A run calls its renderer once the motion is known, for each tile of a large canvas. Flux that is not NaN exactly where the
    weight is 0 is a `PluginError`. Example: `docs/reference/plugins.md#photonpano_renderers`.
    """
    return ()


@hookspec
def photonpano_exporters() -> Iterable[ExporterContribution]:
    """Offer exporters: they write the panorama as a file of another format.

    A run calls its exporters at the end. An `OSError` becomes an `OutputError`; another file than the one asked for is a
    `PluginError`. Example: `docs/reference/plugins.md#photonpano_exporters`.
    """
    return ()


@hookspec
def photonpano_run_kinds() -> Iterable[RunKindContribution]:
    """Offer kinds of runs that find something else than a panorama, such as poses. Experimental.

    A spec with the section of such a kind asks for it, and a run calls it once. The kind of component that finds it has a hook
    as well, without arguments. Example: `docs/reference/plugins.md#photonpano_run_kinds`.
    """
    return ()


@hookspec
def photonpano_executors() -> Iterable[ExecutorContribution]:
    """Offer executors: they work on the tasks of a run, such as those of a level. Experimental.

    A run builds its executor once its source is open, and closes it at the end. An executor raises what a task raised.
    Example: `docs/reference/plugins.md#photonpano_executors`.
    """
    return ()


@hookspec
def photonpano_run_started(directory: Path, spec: Mapping[str, Any]) -> None:
    """Watch a run begin, before its capture is opened.

    The hooks that watch look and do not touch: what they are given is frozen, what they return is ignored, and what they raise
    is logged, while the run goes on. Arguments and example: `docs/reference/plugins.md#photonpano_run_started`.
    """


@hookspec
def photonpano_stage_finished(
    directory: Path, level: int | None, stage: str, seconds: float, summary: Mapping[str, float | None]
) -> None:
    """Watch a stage end: all four when a level is done, then "render"; a kind of run has stages of its own.

    Arguments, what `summary` has for each stage, and example: `docs/reference/plugins.md#photonpano_stage_finished`.
    """


@hookspec
def photonpano_run_finished(directory: Path, record: Mapping[str, Any] | None, error: str | None) -> None:
    """Watch a run end, well or not: called once for each run that started.

    Arguments and example: `docs/reference/plugins.md#photonpano_run_finished`.
    """
