"""Tasks of the locate step, for any worker: merge an exposure and have it described, register a pair, compare a pair."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from photonpano.geometry import why_implausible
from photonpano.motion.checks import require_no_standstill, require_valid, why_undetermined
from photonpano.motion.closures import exposure_similarity
from photonpano.motion.diagnosis import Contrast, contrast_of
from photonpano.motion.level import FrameHomography, NamedLocator
from photonpano.motion.merge import VirtualExposures
from photonpano.protocols import KeepsHypotheses
from photonpano.threads import Stopwatch
from photonpano.values import Homography, Located, NotLocated, VirtualExposure

MAX_HYPOTHESES = 100
"""Most hypotheses of a pair that are used."""


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """What stays of an exposure where it was merged.

    Attributes:
        features: what a locator made of it; None of a blank exposure.
        exposure: the exposure itself, for loop closures.
    """

    features: Any
    exposure: VirtualExposure | None


@dataclass(frozen=True, slots=True, eq=False)
class ExposureTasks:
    """The tasks of a level. Each returns its seconds in each stage, too.

    Attributes:
        exposures: of the level.
    """

    exposures: VirtualExposures

    def describe(self, index: int, locator: int, keep: bool) -> tuple[Described, tuple[Contrast, dict[str, float]]]:
        """Merge an exposure, and have a locator describe it.

        Args:
            index: the number of the exposure.
            locator: the number of the locator; a blank exposure is not described.
            keep: whether the exposure itself is kept.

        Returns:
            What stays where the task was done, and what is known of the exposure.
        """
        clock = Stopwatch(1)
        exposure = replace(self.exposures, clock=clock).merged(index)
        with clock("locate"):
            contrast = contrast_of(exposure)
            features = None
            if not contrast.blank:
                named = self._locator(locator)
                with self.exposures.level.attributing(named):
                    features = named.component.describe(exposure)
        return Described(features, exposure if keep else None), (contrast, clock.seconds)

    def hypotheses(self, locator: int, moving: Described, fixed: Described) -> tuple[list[Homography], dict[str, float]]:
        """Return what a locator that keeps hypotheses makes of a pair, in pixels of frames."""
        level, named, clock = self.exposures.level, self._locator(locator), Stopwatch(1)
        component = named.component
        assert isinstance(component, KeepsHypotheses)
        with clock("locate"), level.attributing(named):
            listed = list(islice(component.hypotheses(moving.features, fixed.features), MAX_HYPOTHESES))
            found = [require_valid(Located(each)) for each in listed]
        return [level.in_frame_px(each).homography for each in found if isinstance(each, Located)], clock.seconds

    def register(
        self, locator: int, moving: Described, fixed: Described, expected: FrameHomography | None
    ) -> tuple[Located | NotLocated, dict[str, float]]:
        """Return the motion of a pair in pixels of frames, as one locator finds it from where it is expected."""
        level, shape, named, clock = self.exposures.level, self.exposures.frame_shape, self._locator(locator), Stopwatch(1)
        initial = None if expected is None else level.in_exposure_px(expected)
        with clock("locate"):
            with level.attributing(named):
                motion = require_valid(named.component.register(moving.features, fixed.features, initial))
                if isinstance(motion, Located):
                    require_no_standstill(motion, expected, shape)
            if isinstance(motion, Located):
                motion = level.in_frame_px(motion)
                if reason := why_implausible(motion.homography, shape) or why_undetermined(motion, shape):
                    motion = NotLocated(reason, motion.evidence)
        return motion, clock.seconds

    def similarity(self, moving: Described, fixed: Described, motion: FrameHomography) -> tuple[float, dict[str, float]]:
        """Return the similarity of two exposures that were kept, along their motion."""
        assert moving.exposure is not None
        assert fixed.exposure is not None
        clock = Stopwatch(1)
        with clock("locate"):
            similarity = exposure_similarity(moving.exposure, fixed.exposure, motion)
        return similarity, clock.seconds

    def _locator(self, number: int) -> NamedLocator:
        return self.exposures.level.locators[number]
