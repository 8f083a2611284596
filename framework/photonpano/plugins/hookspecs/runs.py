"""The hooks that offer what a run has around its levels, from sources to files."""

from __future__ import annotations

from collections.abc import Iterable

from photonpano.plugins.contributions import (
    ExecutorContribution,
    ExporterContribution,
    PoseEstimatorContribution,
    RefinerContribution,
    RendererContribution,
    SourceContribution,
    hookspec,
)


@hookspec
def photonpano_sources() -> Iterable[SourceContribution]:
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
    return ()


@hookspec
def photonpano_refiners() -> Iterable[RefinerContribution]:
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
    return ()


@hookspec
def photonpano_renderers() -> Iterable[RendererContribution]:
    """Offer renderers: they render flux and weight on a canvas.

    Example:
        ```python
        import numpy as np
        from pydantic import Field

        from photonpano import Config, FrameSpan, Panorama, RendererContribution, capture_of, hookimpl
        from photonpano.geometry import transform_points


        class NearestConfig(Config):
            every: int = Field(1, ge=1, description="frames from one that is used to the next")


        class Nearest:
            def __init__(self, every):
                self.every = every

            def render(self, source, trajectory, span, canvas, tolerance_px, advance):
                lit, weight = np.zeros(canvas.shape, np.float32), np.zeros(canvas.shape, np.float32)
                y, x = np.nonzero(source.valid)
                for frame in range(span.start, span.stop, self.every):
                    counts = capture_of(source).corrected_counts(FrameSpan(frame, frame + 1))
                    to_canvas = canvas.transform @ trajectory.at([frame])[0]
                    column, row = np.rint(transform_points(to_canvas, np.stack([x, y], axis=1))).astype(int).T
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
    return ()


@hookspec
def photonpano_exporters() -> Iterable[ExporterContribution]:
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
    return ()


@hookspec
def photonpano_pose_estimators() -> Iterable[PoseEstimatorContribution]:
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
    return ()


@hookspec
def photonpano_executors() -> Iterable[ExecutorContribution]:
    """Offer executors: they work on the tasks of a run, such as those of a level. Experimental.

    One for other processes is a `photonpano.execution.Remote` around something that passes tasks on: see `Workers`.

    Example:
        ```python
        from photonpano import Config, ExecutorContribution, hookimpl


        class OneByOne:
            under_way = 1

            def at_once(self, number):
                return 1

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
    return ()
