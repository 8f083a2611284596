"""The hooks that offer what a level does: re-sample, merge, locate and interpolate."""

from __future__ import annotations

from collections.abc import Iterable

from photonpano.plugins.contributions import (
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    ResamplerContribution,
    hookspec,
)


@hookspec
def photonpano_resamplers() -> Iterable[ResamplerContribution]:
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
    return ()


@hookspec
def photonpano_mergers() -> Iterable[MergerContribution]:
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
    return ()


@hookspec
def photonpano_locators() -> Iterable[LocatorContribution]:
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
    return ()


@hookspec
def photonpano_interpolators() -> Iterable[InterpolatorContribution]:
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
    return ()
