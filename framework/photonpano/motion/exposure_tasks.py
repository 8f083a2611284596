"""Tasks of the locate step, for any worker: merge exposures and have them described, register pairs, compare a pair."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
from photonpano.values import Decision, Homography, Located, NotLocated, VirtualExposure

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
class Pair:
    """Two exposures to register.

    Attributes:
        moving: number of the later exposure.
        fixed: number of the earlier one.
        expected: the motion known so far, if any.
    """

    moving: int
    fixed: int
    expected: FrameHomography | None


@dataclass(frozen=True, slots=True)
class Notes:
    """What a task brings home beside its result.

    Attributes:
        seconds: in each stage.
        decisions: of components, where it was worked on in another process.
    """

    seconds: dict[str, float]
    decisions: tuple[Decision, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ExposureTasks:
    """The tasks of a level. Each returns notes, too.

    Exposures are given by their numbers, together with mappings in which their descriptions are.

    Attributes:
        exposures: of the level.
    """

    exposures: VirtualExposures

    def describe(
        self, indices: Sequence[int], locator: int, keep: bool
    ) -> tuple[dict[int, Described], tuple[list[Contrast], Notes]]:
        """Merge exposures, and have a locator describe them.

        Args:
            indices: the numbers of the exposures.
            locator: the number of the locator; a blank exposure is not described.
            keep: whether the exposures themselves are kept.

        Returns:
            What stays where the task was done, by exposure, and what is known of each exposure.
        """
        clock, named = Stopwatch(1), self._locator(locator)
        described: dict[int, Described] = {}
        contrasts: list[Contrast] = []
        for index in indices:
            exposure = replace(self.exposures, clock=clock).merged(index)
            with clock("locate"):
                contrasts.append(contrast := contrast_of(exposure))
                features = None
                if not contrast.blank:
                    with self.exposures.level.attributing(named):
                        features = named.component.describe(exposure)
            described[index] = Described(features, exposure if keep else None)
        return described, (contrasts, self._notes(clock))

    def hypotheses(
        self, locator: int, moving: int, fixed: int, *described: Mapping[int, Described]
    ) -> tuple[list[Homography], Notes]:
        """Return what a locator that keeps hypotheses makes of a pair, in pixels of frames."""
        level, named, clock, known = self.exposures.level, self._locator(locator), Stopwatch(1), _joined(described)
        component = named.component
        assert isinstance(component, KeepsHypotheses)
        with clock("locate"), level.attributing(named):
            listed = list(islice(component.hypotheses(known[moving].features, known[fixed].features), MAX_HYPOTHESES))
            found = [require_valid(Located(each)) for each in listed]
        return [level.in_frame_px(each).homography for each in found if isinstance(each, Located)], self._notes(clock)

    def register(
        self, locator: int, pairs: Sequence[Pair], *described: Mapping[int, Described]
    ) -> tuple[list[Located | NotLocated], Notes]:
        """Return the motion of each pair in pixels of frames, as one locator finds it from where it is expected."""
        clock, known = Stopwatch(1), _joined(described)
        with clock("locate"):
            motions = [self._registered(self._locator(locator), pair, known) for pair in pairs]
        return motions, self._notes(clock)

    def _registered(self, named: NamedLocator, pair: Pair, known: Mapping[int, Described]) -> Located | NotLocated:
        level, shape = self.exposures.level, self.exposures.frame_shape
        initial = None if pair.expected is None else level.in_exposure_px(pair.expected)
        with level.attributing(named):
            motion = require_valid(named.component.register(known[pair.moving].features, known[pair.fixed].features, initial))
            if isinstance(motion, Located):
                require_no_standstill(motion, pair.expected, shape)
        if isinstance(motion, Located):
            motion = level.in_frame_px(motion)
            if reason := why_implausible(motion.homography, shape) or why_undetermined(motion, shape):
                motion = NotLocated(reason, motion.evidence)
        return motion

    def similarity(
        self, moving: int, fixed: int, motion: FrameHomography, *described: Mapping[int, Described]
    ) -> tuple[float, Notes]:
        """Return the similarity of two exposures that were kept, along their motion."""
        clock, known = Stopwatch(1), _joined(described)
        one, other = known[moving].exposure, known[fixed].exposure
        assert one is not None
        assert other is not None
        with clock("locate"):
            similarity = exposure_similarity(one, other, motion)
        return similarity, self._notes(clock)

    def _notes(self, clock: Stopwatch) -> Notes:
        return Notes(clock.seconds, self.exposures.level.recorder.taken())

    def _locator(self, number: int) -> NamedLocator:
        return self.exposures.level.locators[number]


def _joined(described: Iterable[Mapping[int, Described]]) -> Mapping[int, Described]:
    return {index: each for mapping in described for index, each in mapping.items()}
