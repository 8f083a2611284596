"""Tasks of the locate step, for any worker: merge exposures and have them described, register pairs, compare a pair."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

from photonpano.contracts.attribution import blaming
from photonpano.contracts.requirements import require_no_standstill, why_undetermined
from photonpano.execution.threads import Guard, Stopwatch
from photonpano.geometry import why_implausible
from photonpano.motion.closures import exposure_similarity
from photonpano.motion.diagnosis import Contrast, contrast_of
from photonpano.motion.level import FrameHomography, NamedLocator, VirtualExposures
from photonpano.motion.pairs import shared_share
from photonpano.motion.tracking import Place, StartingMotion, Track
from photonpano.values import Decision, Edge, Homography, Located, NotLocated, VirtualExposure

# Most hypotheses of a pair that are used.
MAX_HYPOTHESES = 100


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """An exposure as it stays in the process that has merged it."""

    contrast: Contrast  # of its image
    exposure: VirtualExposure | None = None  # the exposure itself, for loop closures
    # what locators made of it so far, by their numbers; none of a blank exposure
    features: dict[int, Any] = field(default_factory=dict)
    guard: Guard = field(default_factory=Guard)  # held while a locator describes it, so that each does so once


# Exposures by their numbers.
Descriptions: TypeAlias = Mapping[int, Described]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two exposures to register."""

    moving: int  # number of the later exposure
    fixed: int  # number of the earlier one
    expected: FrameHomography | None  # the motion known so far, if any
    guessed: bool = False  # whether that is a guess of the first level, from which only locators that keep hypotheses start
    # whether it is a candidate for a loop closure. The motion known so far may have drifted between its exposures, and does not
    # predict whether the camera is back where it was.
    closure: bool = False


@dataclass(frozen=True, slots=True)
class Notes:
    """What a task returns beside its result."""

    seconds: dict[str, float]  # in each stage
    decisions: tuple[Decision, ...]  # of components, where it was worked on in another process


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Exposures of the first level that were registered with earlier ones."""

    edges: dict[int, list[Edge]]  # of each exposure, by its number
    places: dict[int, Place]  # where each lies
    alternatives_px: dict[tuple[int, int], float]  # see `Track`


@dataclass(frozen=True, slots=True, eq=False)
class ExposureTasks:
    """The tasks of a level. Each returns notes, too.

    Exposures are given by their numbers, together with mappings in which their descriptions are.

    Convention:
        All homographies are in pixels of frames; only a locator sees pixels of exposures.
    """

    exposures: VirtualExposures  # of the level

    def describe(self, indices: Sequence[int], keep: bool) -> tuple[dict[int, Described], tuple[list[Contrast], Notes]]:
        """Merge exposures, and have the first locator describe them; a blank exposure is not described.

        Return what stays in this process, by exposure, with the exposures themselves if they are to `keep`; and the contrasts.
        """
        clock, described = Stopwatch(1), dict[int, Described]()
        for index in indices:
            exposure = self.exposures.merged(index, clock)
            with clock("locate"):
                contrast = contrast_of(exposure)
            described[index] = Described(contrast, exposure if keep else None)
            if not contrast.blank:
                described[index].features[0] = self._features_of(exposure, 0, clock)
        return described, ([each.contrast for each in described.values()], self._notes(clock))

    def register(self, pairs: Sequence[Pair], *described: Descriptions) -> tuple[list[Edge], Notes]:
        """Pass pairs to one locator after the other, until one locates them."""
        clock = Stopwatch(1)
        return self._registered(pairs, _joined(described), clock), self._notes(clock)

    def register_along(
        self,
        start: StartingMotion | None,
        partners: Mapping[int, Sequence[int]],
        places: Mapping[int, Place],
        *described: Descriptions,
    ) -> tuple[Tracked, Notes]:
        """Register exposures of the first level with earlier ones, in order; the motion to the nearest predicts the others.

        `places` are those of partners that are not among the exposures, and of exposures that were placed before.
        """
        clock, known = Stopwatch(1), _joined(described)
        track = Track(start, self.exposures.groups, self.exposures.frame_shape, places)
        edges = {moving: self._tracked(track, moving, earlier, known, clock) for moving, earlier in partners.items()}
        new = {moving: track.places[moving] for moving in partners}
        return Tracked(edges, new, track.alternatives_px), self._notes(clock)

    def similarity(self, moving: int, fixed: int, motion: FrameHomography, *described: Descriptions) -> tuple[float, Notes]:
        """Return the similarity of two exposures that were kept, along their motion."""
        clock, known = Stopwatch(1), _joined(described)
        one, other = known[moving].exposure, known[fixed].exposure
        assert one is not None
        assert other is not None
        with clock("locate"):
            similarity = exposure_similarity(one, other, motion)
        return similarity, self._notes(clock)

    def _tracked(self, track: Track, moving: int, partners: Sequence[int], known: Descriptions, clock: Stopwatch) -> list[Edge]:
        """Register an exposure with others, and place it."""
        place, foreseen = track.places.get(moving), None
        found: list[Edge] = []
        for fixed in sorted(partners, reverse=True):
            expected = track.expected(place, moving, fixed, partial(self._hypotheses, moving, fixed, known, clock))
            found += self._registered([Pair(moving, fixed, expected, guessed=True)], known, clock)
            if place is None and isinstance(motion := found[-1].motion, Located):
                place = track.placed(moving, fixed, motion.homography)
            elif foreseen is None and expected is not None:
                foreseen = track.placed(moving, fixed, expected)
        track.settle(moving, place or foreseen)
        return found[::-1]

    def _hypotheses(self, moving: int, fixed: int, known: Descriptions, clock: Stopwatch) -> list[Homography]:
        """Return what the first locator that keeps hypotheses makes of a pair; none of blank exposures."""
        level = self.exposures.level
        if known[moving].contrast.blank or known[fixed].contrast.blank:
            return []
        for number, named in enumerate(level.locators):
            if hasattr(named.component, "hypotheses"):
                features = [self._features(index, number, known, clock) for index in (moving, fixed)]
                with clock("locate"):
                    found = named.component.hypotheses(*features)[:MAX_HYPOTHESES]
                return [level.in_frame_px(Located(each)).homography for each in found]
        return []

    def _registered(self, pairs: Sequence[Pair], known: Descriptions, clock: Stopwatch) -> list[Edge]:
        """Pass pairs to one locator after the other, until one locates them."""
        found: dict[Pair, Edge] = {pair: edge for pair in pairs if (edge := self._refused(pair, known))}
        failures: dict[Pair, dict[str, NotLocated]] = {pair: {} for pair in pairs}
        for number, locator in enumerate(self.exposures.level.locators):
            for pair in [pair for pair in pairs if pair not in found]:
                motion = self._located_by(number, locator, pair, known, clock)
                if isinstance(motion, Located):
                    found[pair] = Edge(pair.moving, pair.fixed, motion, locator.name)
                else:
                    failures[pair][locator.name] = motion
        return [found.get(pair) or Edge(pair.moving, pair.fixed, _of_all(failures[pair])) for pair in pairs]

    def _refused(self, pair: Pair, known: Descriptions) -> Edge | None:
        """Return a pair that no locator needs to see, with the reason; None for any other."""
        for index in (pair.moving, pair.fixed):
            if blank := known[index].contrast.blank:
                return Edge(pair.moving, pair.fixed, NotLocated(f"{self.exposures.groups[index]}: {blank}"))
        spans = self.exposures.groups[pair.moving].span, self.exposures.groups[pair.fixed].span
        # The noise of shared frames alone confirms any motion that both exposures were merged along.
        if shared_share(*spans) and not all(map(self.exposures.is_foreseen, (pair.moving, pair.fixed))):
            shares = NotLocated("the exposures share frames, and were merged along a motion that is not known there")
            return Edge(pair.moving, pair.fixed, shares)
        if pair.expected is not None and (reason := why_implausible(pair.expected, self.exposures.frame_shape)):
            return Edge(pair.moving, pair.fixed, NotLocated(f"by the motion known so far, {reason}"))
        return None

    def _located_by(
        self, number: int, named: NamedLocator, pair: Pair, known: Descriptions, clock: Stopwatch
    ) -> Located | NotLocated:
        """Return the motion of a pair as one locator finds it from where it is expected."""
        level, shape = self.exposures.level, self.exposures.frame_shape
        starts = not pair.guessed or hasattr(named.component, "hypotheses")
        expected = pair.expected if starts else None
        initial = None if expected is None else level.in_exposure_px(expected)
        moving, fixed = (self._features(index, number, known, clock) for index in (pair.moving, pair.fixed))
        with clock("locate"):
            motion = named.component.register(moving, fixed, initial)
            if isinstance(motion, NotLocated):
                return motion
            if not pair.closure:
                with blaming(named.component):
                    require_no_standstill(motion, expected, shape)
            motion = level.in_frame_px(motion)
            if reason := why_implausible(motion.homography, shape) or why_undetermined(motion, shape):
                return NotLocated(reason, motion.evidence)
            return motion

    def _features(self, index: int, locator: int, known: Descriptions, clock: Stopwatch) -> Any:
        """Return what a locator makes of an exposure; for a fallback, it is merged again."""
        described = known[index]
        with described.guard:
            if locator not in described.features:
                exposure = self.exposures.merged(index, clock) if described.exposure is None else described.exposure
                described.features[locator] = self._features_of(exposure, locator, clock)
            return described.features[locator]

    def _features_of(self, exposure: VirtualExposure, locator: int, clock: Stopwatch) -> Any:
        named = self.exposures.level.locators[locator]
        with clock("locate"):
            return named.component.describe(exposure)

    def _notes(self, clock: Stopwatch) -> Notes:
        return Notes(clock.seconds, self.exposures.level.recorder.taken())


def _joined(described: Iterable[Descriptions]) -> Descriptions:
    return {index: each for mapping in described for index, each in mapping.items()}


def _of_all(failures: Mapping[str, NotLocated]) -> NotLocated:
    """Join the failures of several locators, each under its name; a single one stays as it is."""
    if len(failures) == 1:
        return next(iter(failures.values()))
    reason = "; ".join(f"{name}: {each.reason}" for name, each in failures.items())
    evidence = {f"{name}.{key}": value for name, each in failures.items() for key, value in each.evidence.items()}
    return NotLocated(reason, evidence)
