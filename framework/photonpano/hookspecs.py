"""The extension points: one hook a kind, no arguments, each returns contributions; and hooks that watch runs.

A plugin is a module with these hooks, named in the entry-point group `photonpano` of its distribution:

    [project.entry-points.photonpano]
    my-plugin = "my_plugin.hooks"

The hook module imports no heavy library; the component does so when it is built. `examples/third_party_plugin` is such a
distribution, and `docs/tutorial/first-plugin.md` writes it step by step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pluggy

from photonpano.contributions import (
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

PROJECT = "photonpano"
"""The pluggy project name, and the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def photonpano_sources() -> Iterable[SourceContribution]:  # type: ignore[empty-body]
    """Offer sources: they open a capture and give the summed counts, or the frames, of a span.

    Example:
        ```python
        from photonpano import Config, SourceContribution, SpecPath, hookimpl


        class MyCameraConfig(Config):
            path: SpecPath


        def build(config, context):
            from my_plugin.camera import MyCameraSource

            return MyCameraSource(config.path)


        @hookimpl
        def photonpano_sources():
            yield SourceContribution(name="my-camera", summary="Files of my camera", config=MyCameraConfig, build=build)
        ```
    """


@hookspec
def photonpano_resamplers() -> Iterable[ResamplerContribution]:  # type: ignore[empty-body]
    """Offer resamplers: they choose the groups of frames of each level.

    Example:
        ```python
        from photonpano import Config, FrameSpan, Group, InputError, ResamplerContribution, hookimpl


        class Halves:
            def groups(self, n_frames, level):
                if n_frames < 2:
                    raise InputError("a capture of one frame has no halves")
                half = n_frames // 2
                spans = (FrameSpan(0, half), FrameSpan(half, n_frames))
                return tuple(Group(span, span.centre) for span in spans)


        class HalvesConfig(Config):
            pass


        @hookimpl
        def photonpano_resamplers():
            yield ResamplerContribution(
                name="halves",
                summary="Two groups, whatever the level",
                config=HalvesConfig,
                build=lambda config, context: Halves(),
                check=lambda config, stream: ["a capture of one frame has no halves"] if stream.n_frames < 2 else [],
            )
        ```
    """


@hookspec
def photonpano_mergers() -> Iterable[MergerContribution]:  # type: ignore[empty-body]
    """Offer mergers: they merge the frames of a group into a virtual exposure.

    Example:
        ```python
        import numpy as np

        from photonpano import Config, MergerContribution, VirtualExposure, hookimpl


        class NaiveSum:
            def merge(self, source, group, trajectory, scale):
                frames = len(group.span)
                flux = source.response.flux((source.counts(group.span) / frames).astype(np.float32), frames)
                weight = np.full(flux.shape, frames, np.float32)
                flux[~source.valid], weight[~source.valid] = np.nan, 0
                return VirtualExposure(flux, weight, group, 1.0, source.response)


        class NaiveSumConfig(Config):
            pass


        @hookimpl
        def photonpano_mergers():
            yield MergerContribution(
                name="naive-sum",
                summary="Sums the frames where they lie",
                config=NaiveSumConfig,
                build=lambda config, context: NaiveSum(),
            )
        ```
    """


@hookspec
def photonpano_locators() -> Iterable[LocatorContribution]:  # type: ignore[empty-body]
    """Offer locators: they find the motion between two virtual exposures.

    Example:
        ```python
        from photonpano import Config, LocatorContribution, NotLocated, hookimpl


        class NeverFound:
            def describe(self, exposure):
                return None

            def register(self, moving, fixed, initial):
                return NotLocated("this example looks at nothing")


        class NeverFoundConfig(Config):
            pass


        @hookimpl
        def photonpano_locators():
            yield LocatorContribution(
                name="never-found",
                summary="Locates nothing, and says so",
                config=NeverFoundConfig,
                build=lambda config, context: NeverFound(),
            )
        ```
    """


@hookspec
def photonpano_interpolators() -> Iterable[InterpolatorContribution]:  # type: ignore[empty-body]
    """Offer interpolators: they turn located instants into a trajectory.

    Example:
        ```python
        import numpy as np

        from photonpano import Config, InterpolatorContribution, hookimpl


        class NearestKnot:
            def __init__(self, instants, homographies):
                self.instants, self.homographies = instants, homographies

            def at(self, frame_indices):
                frames = np.atleast_1d(np.asarray(frame_indices, dtype=float))
                return self.homographies[np.abs(frames[:, None] - self.instants).argmin(axis=1)]


        class Nearest:
            def fit(self, instants, homographies, information):
                return NearestKnot(instants, homographies)


        class NearestConfig(Config):
            pass


        @hookimpl
        def photonpano_interpolators():
            yield InterpolatorContribution(
                name="nearest",
                summary="The homography of the nearest located instant",
                config=NearestConfig,
                build=lambda config, context: Nearest(),
            )
        ```
    """


@hookspec
def photonpano_refiners() -> Iterable[RefinerContribution]:  # type: ignore[empty-body]
    """Offer refiners: they correct the motion after the last level, from residuals of short spans of frames.

    Example:
        ```python
        import numpy as np
        from pydantic import Field

        from photonpano import Config, Refined, RefinerContribution, hookimpl
        from photonpano.geometry import inverse, normalised


        class JumpConfig(Config):
            sigmas: float = Field(6.0, gt=0, description="smallest jump that is corrected, in standard deviations")


        class Jump:
            def __init__(self, sigmas):
                self.sigmas = sigmas

            def refine(self, source, trajectory, std_px, residuals, view):
                covariances = np.linalg.pinv(residuals.information, hermitian=True)[:, :2, :2]
                shifts = residuals.steps[:, :2]
                variances = np.trace(covariances, axis1=1, axis2=2)
                far = (variances > 0) & ((shifts**2).sum(axis=1) > self.sigmas**2 * variances)
                if not far.any():
                    return None
                steps, std_px = np.tile(np.eye(3), (len(std_px), 1, 1)), std_px.copy()
                for index in np.flatnonzero(far):
                    frames = slice(residuals.spans[index].start, residuals.spans[index].stop)
                    steps[frames, :2, 2], std_px[frames] = shifts[index], np.sqrt(variances[index])
                motion = trajectory.at(np.arange(len(std_px)))
                reference = np.abs(motion - np.eye(3)).sum(axis=(1, 2)).argmin()
                moved = normalised(motion @ steps)
                summary = f"jumps of up to {np.hypot(*shifts[far].T).max():.1f} px in {far.sum()} spans"
                return Refined(normalised(inverse(moved[reference]) @ moved), std_px, summary)


        @hookimpl
        def photonpano_refiners():
            yield RefinerContribution(
                name="jump",
                summary="Corrects single spans that are far off",
                config=JumpConfig,
                build=lambda config, context: Jump(config.sigmas),
            )
        ```
    """


@hookspec
def photonpano_renderers() -> Iterable[RendererContribution]:  # type: ignore[empty-body]
    """Offer renderers: they render flux and weight on a canvas.

    Example:
        ```python
        import numpy as np
        from pydantic import Field

        from photonpano import Config, FrameSpan, LinearlyCorrectedSource, Panorama, RendererContribution, hookimpl
        from photonpano.geometry import apply


        class NearestConfig(Config):
            every: int = Field(1, ge=1, description="frames from one that is used to the next")


        class Nearest:
            def __init__(self, every):
                self.every = every

            def render(self, source, trajectory, span, canvas, tolerance_px, advance):
                lit, weight = np.zeros(canvas.shape, np.float32), np.zeros(canvas.shape, np.float32)
                y, x = np.nonzero(source.valid)
                for frame in range(span.start, span.stop, self.every):
                    counts = source.counts(FrameSpan(frame, frame + 1))
                    if isinstance(source, LinearlyCorrectedSource):
                        counts = source.corrected(counts, 1)
                    to_canvas = canvas.transform @ trajectory.at([frame])[0]
                    column, row = np.rint(apply(to_canvas, np.stack([x, y], axis=1))).astype(int).T
                    inside = (column >= 0) & (column < canvas.width) & (row >= 0) & (row < canvas.height)
                    at = row[inside], column[inside]
                    np.add.at(weight, at, 1)
                    np.add.at(lit, at, counts[y[inside], x[inside]])
                advance(len(span))
                mean = np.divide(lit, weight, out=np.full_like(lit, np.nan), where=weight > 0)
                return Panorama(source.response.flux(mean, weight), weight, canvas.transform)


        @hookimpl
        def photonpano_renderers():
            yield RendererContribution(
                name="nearest-pixel",
                summary="Adds each photon to the nearest pixel",
                config=NearestConfig,
                build=lambda config, context: Nearest(config.every),
            )
        ```
    """


@hookspec
def photonpano_exporters() -> Iterable[ExporterContribution]:  # type: ignore[empty-body]
    """Offer exporters: they write the panorama as a file of another format.

    Example:
        ```python
        import numpy as np

        from photonpano import Config, ExporterContribution, hookimpl


        class PgmConfig(Config):
            pass


        class Pgm:
            def export(self, panorama, path):
                height, width = panorama.shape
                with path.open("wb") as file:
                    file.write(f"P5 {width} {height} 255 ".encode())
                    for row in range(height):
                        flux = panorama.rows(row, row + 1).flux.reshape(1, width, -1).mean(axis=-1)
                        level = np.clip(np.nan_to_num(flux) / panorama.white_flux, 0, 1)
                        file.write((255 * level + 0.5).astype(np.uint8).tobytes())


        @hookimpl
        def photonpano_exporters():
            yield ExporterContribution(
                name="pgm",
                summary="Grey levels of 8 bits, proportional to the flux",
                config=PgmConfig,
                suffix=".pgm",
                build=lambda config, context: Pgm(),
            )
        ```
    """


@hookspec
def photonpano_pose_estimators() -> Iterable[PoseEstimatorContribution]:  # type: ignore[empty-body]
    """Offer pose estimators: they find the pose of each frame of a camera that travels through a scene. Experimental.

    Example:
        ```python
        from photonpano import Config, LocationError, PoseEstimatorContribution, hookimpl


        class NeverFound:
            def estimate(self, source, camera, progress):
                raise LocationError("this is an example; choose another pose estimator")


        class NeverFoundConfig(Config):
            pass


        @hookimpl
        def photonpano_pose_estimators():
            yield PoseEstimatorContribution(
                name="never-posed",
                summary="Finds no pose at all",
                config=NeverFoundConfig,
                build=lambda config, context: NeverFound(),
            )
        ```
    """


@hookspec
def photonpano_executors() -> Iterable[ExecutorContribution]:  # type: ignore[empty-body]
    """Offer executors: they work on the tasks of a run, such as those of a level. Experimental.

    One for other processes is a `photonpano.execution.Remote` around something that passes tasks on: see `Workers`.

    Example:
        ```python
        from photonpano import Config, ExecutorContribution, hookimpl


        class OneByOne:
            under_way = 1

            def share(self, value):
                return value

            def call(self, work, *given):
                return work(*given)

            def keep(self, work, *given):
                return work(*given)

            def close(self):
                pass


        class OneByOneConfig(Config):
            pass


        @hookimpl
        def photonpano_executors():
            yield ExecutorContribution(
                name="one-by-one",
                summary="Works on one task after the other",
                config=OneByOneConfig,
                build=lambda config, context: OneByOne(),
            )
        ```
    """


@hookspec
def photonpano_run_started(directory: Path, spec: Mapping[str, Any]) -> None:
    """Watch a run begin, before its capture is opened.

    Observation hooks look and do not touch: what they are given is frozen, what they return is ignored, and what they raise is
    logged with the name of their plugin, while the run goes on. They are called in the thread that runs, one after the other. A
    plugin takes those of the arguments that it needs, by name.

    Args:
        directory: the run folder. It may not be there yet, and belongs to the run: write elsewhere.
        spec: the resolved spec, defaults filled in.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_run_started(directory, spec):
            print(f"{directory}: begins with {spec['source']['use']}, seed {spec['run']['seed']}", file=sys.stderr)
        ```
    """


@hookspec
def photonpano_stage_finished(
    directory: Path, level: int | None, stage: str, seconds: float, summary: Mapping[str, float | None]
) -> None:
    """Watch a stage end. Merging and locating alternate, so the hook is called for all four stages when the level is done.

    A run with `pose` has the stage "pose" only: levels belong to the pose estimator.

    Args:
        directory: the run folder, by which runs can be distinguished.
        level: from 1; None for the panorama and for poses.
        stage: "resample", "merge", "locate" or "interpolate"; at the end of the run "render"; with `pose` only "pose".
        seconds: how long it took.
        summary: its results. resample: `groups`; merge: `exposures`; locate: `pairs`, `failed` pairs and `located`
            exposures; interpolate: `change_px` (None at level 1) and `std_px` (None if not known), as in `run.json`; render:
            `height` and `width` of the panorama; pose: numbers of `located` frames, of `exposures` and of `points`.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_stage_finished(level, stage, seconds):
            where = "" if level is None else f"level {level}: "
            print(f"{where}{stage} took {seconds:.1f} s", file=sys.stderr)
        ```
    """


@hookspec
def photonpano_run_finished(directory: Path, record: Mapping[str, Any] | None, error: str | None) -> None:
    """Watch a run end, well or not: called once for each run that started.

    Args:
        directory: the run folder; complete if the run ended well, else as it was before.
        record: the content of `run.json`; None if the run failed.
        error: the class of what ended the run, and its message; None if it ended well.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_run_finished(directory, record, error):
            print(f"{directory}: {error or 'done'}", file=sys.stderr)
        ```
    """
