"""The components of one level of the loop, and the scale of its exposures."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any, NewType

import numpy as np

from photonpano.contracts.attribution import attributing
from photonpano.geometry import Camera, rescaled
from photonpano.motion.recorder import Recorder
from photonpano.protocols import Interpolator, LocatesTurns, Locator, Merger, Resampler
from photonpano.values import FloatArray, Located

FrameHomography = NewType("FrameHomography", FloatArray)
"""A homography in pixels of frames, as the motion graph and trajectories have it."""
ExposureHomography = NewType("ExposureHomography", FloatArray)
"""A homography in pixels of a level's exposures, as locators have it."""


@dataclass(frozen=True, slots=True)
class NamedLocator:
    """A locator of a level.

    Attributes:
        name: as in the spec; the second of a level with the same name is numbered, such as "opencv-sift 2".
        component: the locator.
        origin: who provides it, such as "locator 'opencv-sift' of photonpano 0.1.0".
    """

    name: str
    component: Locator
    origin: str


@dataclass(frozen=True, slots=True)
class Level:
    """The components of one level, built.

    Attributes:
        number: from 1.
        scale: pixels of the level's exposures per pixel of a frame.
        locators: at least one; a pair that one of them does not locate is passed to the next.
        origins: who provides each of the other components, by its kind, such as "merger 'photon-mle' of photonpano 0.1.0".
        recorder: records what they decide.
    """

    number: int
    scale: float
    resampler: Resampler
    merger: Merger
    locators: tuple[NamedLocator, ...]
    interpolator: Interpolator
    origins: Mapping[str, str]
    recorder: Recorder = field(default_factory=Recorder)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel with what merges and locates; groups are chosen, and motions interpolated, where the loop runs."""
        return _for_tasks, (self.number, self.scale, self.merger, self.locators, self.origins, self.recorder)

    def attributing(self, component: str | NamedLocator) -> AbstractContextManager[None]:
        """Attribute errors of the block to a component, given by its kind (such as "merger") or as a locator.

        Raises:
            PluginError: the component failed, or broke its contract.
        """
        origin = self.origins[component] if isinstance(component, str) else component.origin
        return attributing(origin, f"level {self.number}")

    def turning(self, camera: Camera | None) -> Level:
        """Return the level for a camera that only turns, which locators use if they can; None if it is not known."""
        if camera is None:
            return self
        matrix, locators = camera.scaled(self.scale).matrix, []
        for locator in self.locators:
            if isinstance(locator.component, LocatesTurns):
                with self.attributing(locator):
                    locator = replace(locator, component=locator.component.turning(matrix))
            locators.append(locator)
        return replace(self, locators=tuple(locators))

    def in_exposure_px(self, homography: FrameHomography) -> ExposureHomography:
        """Convert a homography from pixels of frames to pixels of the level's exposures."""
        return ExposureHomography(rescaled(homography, self.scale))

    def in_frame_px(self, motion: Located) -> Located:
        """Convert a motion from pixels of the level's exposures to pixels of frames."""
        homography = rescaled(motion.homography, 1 / self.scale)
        information = motion.information
        if information is not None:
            # To first order, the unit of length matters to translation (p5, p6) and perspective (p7, p8) alone.
            units = np.array([1, 1, 1, 1, self.scale, self.scale, 1 / self.scale, 1 / self.scale])
            information = information * np.outer(units, units)
        residual_px = None if motion.residual_px is None else motion.residual_px / self.scale
        return replace(motion, homography=homography, information=information, residual_px=residual_px)


def _for_tasks(
    number: int,
    scale: float,
    merger: Merger,
    locators: tuple[NamedLocator, ...],
    origins: Mapping[str, str],
    recorder: Recorder,
) -> Level:
    nothing: Any = None
    return Level(number, scale, nothing, merger, locators, nothing, origins, recorder)
