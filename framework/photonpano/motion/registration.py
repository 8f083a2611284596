"""Describing exposures and registering pairs of them: what the locators are asked, and what is believed of their answers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from numbers import Real
from threading import Lock
from typing import Any

import numpy as np

from photonpano.errors import PluginError
from photonpano.geometry import corner_displacements, inverse, rescaled, why_implausible
from photonpano.motion.closures import agreement
from photonpano.motion.diagnosis import Contrast, contrast_of
from photonpano.motion.level import Level, NamedLocator
from photonpano.motion.merge import VirtualExposures
from photonpano.motion.pairs import independent_share, shared_share
from photonpano.protocols import Trajectory
from photonpano.text import listed
from photonpano.threads import Stopwatch
from photonpano.values import Edge, FloatArray, Homography, Located, NotLocated, VirtualExposure

BRIDGE = 3
"""An exposure that none of its pairs ties to an earlier one is tried against so many predecessors."""
SHARED_PHOTONS = 0.05
"""The least weight of a pair. Photons that two exposures share say where the motion known so far puts them, and nothing new."""
STILL_SHARE = 0.1
"""Where the motion known so far moves the corners by this share of the shorter side of a frame, the identity is no answer. The
first level errs by a few pixels, so a locator of whole pixels may rightly see nothing move where less is expected."""
MIN_AGREEMENT = 0.7
"""Views of one place at different times agree by 0.9 and more where photons tell; different places by less than half."""


@dataclass(slots=True)
class _Described:
    """What is kept of an exposure while pairs of it are due.

    Attributes:
        contrast: how much there is to see in it.
        features: what the locators made of it, by their names.
        lock: held while a locator is asked, so that each is asked once.
        exposure: the exposure itself, where pairs are to be looked at once more.
    """

    contrast: Contrast
    features: dict[str, Any] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)
    exposure: VirtualExposure | None = None


class Registrar:
    """Describes the exposures of a level and registers pairs of them, in px of frames."""

    def __init__(self, level: Level, exposures: VirtualExposures, known: Trajectory | None, clock: Stopwatch) -> None:
        self._level = level
        self._exposures = exposures
        # Of all exposures at once: to ask a trajectory costs about the same for one instant as for a thousand.
        self._to_plane = None if known is None else known.at([group.reference for group in exposures.groups])
        self._from_plane = None if self._to_plane is None else inverse(self._to_plane)
        self._clock = clock
        self._independent = independent_share(exposures.groups)
        self._described: dict[int, _Described] = {}
        self.contrasts: dict[int, Contrast] = {}

    def edges(
        self, pairs: Sequence[tuple[int, int]], pool: ThreadPoolExecutor, threads: int, advance: Callable[[int], None]
    ) -> Iterator[Edge]:
        """Yield the pairs in order, as located or not."""
        partners: dict[int, list[int]] = {moving: [] for moving in range(len(self._exposures))}
        needed_until = {index: index + BRIDGE for index in partners}
        for moving, fixed in pairs:
            partners[moving].append(fixed)
            needed_until[fixed] = max(needed_until[fixed], moving)
        due: deque[tuple[int, list[Future[Edge]]]] = deque()
        try:
            for moving, each in enumerate(_in_order(pool, self._describe, range(len(self._exposures)), threads)):
                self._described[moving], self.contrasts[moving] = each, each.contrast
                jobs = [pool.submit(self._register, moving, fixed, self._initial(moving, fixed)) for fixed in partners[moving]]
                due.append((moving, jobs))
                # Pairs of a few exposures are under way, so that no thread waits for the last pair of one.
                while len(due) > threads:
                    yield from self._finished(*due.popleft(), partners, needed_until)
                    advance(1)
            while due:
                yield from self._finished(*due.popleft(), partners, needed_until)
                advance(1)
        finally:
            for _, jobs in due:
                for job in jobs:
                    job.cancel()

    def _finished(
        self, moving: int, jobs: Sequence[Future[Edge]], partners: Mapping[int, Sequence[int]], needed_until: Mapping[int, int]
    ) -> Iterator[Edge]:
        """Yield the pairs of a moving exposure, and forget what no later one needs."""
        found = [job.result() for job in jobs]
        if found and not any(isinstance(edge.motion, Located) for edge in found):
            found += self._bridge(moving, partners[moving])
        yield from found
        for index in [index for index in self._described if needed_until[index] <= moving]:
            del self._described[index]

    def revisits(self, pairs: Sequence[tuple[int, int]], homographies: FloatArray, pool: ThreadPoolExecutor) -> Iterator[Edge]:
        """Yield pairs of exposures that may see one place at different times; only those that look alike are located.

        Both exposures of a pair are merged and described once more, since they were forgotten.

        Args:
            pairs: (moving, fixed), ordered by the moving exposure.
            homographies: (N, 3, 3) where the level's other pairs put the exposures, frame pixels to a common plane.
            pool: describes the two of a pair at the same time.
        """
        self._described.clear()
        needed_until = {index: position for position, pair in enumerate(pairs) for index in pair}
        for position, (moving, fixed) in enumerate(pairs):
            missing = [index for index in (moving, fixed) if index not in self._described]
            for index, described in zip(missing, pool.map(lambda each: self._describe(each, keep=True), missing), strict=True):
                self._described[index] = described
            yield self._revisit(moving, fixed, inverse(homographies[fixed]) @ homographies[moving])
            for index in [index for index in self._described if needed_until[index] <= position]:
                del self._described[index]

    def _revisit(self, moving: int, fixed: int, expected: Homography) -> Edge:
        edge = self._register(moving, fixed, rescaled(expected, self._level.scale))
        first, second = self._described[moving].exposure, self._described[fixed].exposure
        if isinstance(edge.motion, NotLocated) or first is None or second is None:
            return edge
        with self._clock("locate"):
            alike = agreement(first, second, edge.motion.homography)
        evidence = {**edge.motion.evidence, "revisit_agreement": alike}
        if alike < MIN_AGREEMENT:
            reason = f"they may show one place, but agree by {alike:.2f} only (at least {MIN_AGREEMENT:g} is needed)"
            return Edge(moving, fixed, NotLocated(reason, evidence))
        return replace(edge, motion=replace(edge.motion, evidence=evidence))

    def _bridge(self, moving: int, tried: Sequence[int]) -> Iterator[Edge]:
        for fixed in range(moving - 1, max(moving - BRIDGE, 0) - 1, -1):
            if fixed not in tried:
                edge = self._register(moving, fixed, self._initial(moving, fixed))
                yield edge
                if isinstance(edge.motion, Located):
                    return

    def _describe(self, index: int, keep: bool = False) -> _Described:
        exposure = self._exposures[index]
        with self._clock("locate"):
            contrast = contrast_of(exposure)
        described = _Described(contrast, exposure=exposure if keep else None)
        if not contrast.blank:
            first = self._level.locators[0]
            described.features[first.name] = self._described_by(first, exposure)
        return described

    def _described_by(self, locator: NamedLocator, exposure: VirtualExposure) -> Any:
        with self._clock("locate"), self._level.attributing(locator):
            return locator.component.describe(exposure)

    def _features(self, locator: NamedLocator, index: int) -> Any:
        """Return what a locator makes of an exposure; a fallback is shown only those of pairs that were lost."""
        described = self._described[index]
        with described.lock:
            if locator.name not in described.features:
                described.features[locator.name] = self._described_by(locator, self._exposures[index])
            return described.features[locator.name]

    def _register(self, moving: int, fixed: int, initial: Homography | None) -> Edge:
        """Offer a pair to one locator after the other, until one finds a motion that a camera makes.

        Args:
            moving: number of the exposure that is mapped.
            fixed: number of the exposure that it is mapped to.
            initial: (3, 3) where to start, in px of exposures.
        """
        for index in (moving, fixed):
            if blank := self.contrasts[index].blank:
                return Edge(moving, fixed, NotLocated(f"{self._exposures.groups[index]}: {blank}"))
        lost: dict[str, NotLocated] = {}
        for locator in self._level.locators:
            motion = self._registered_by(locator, moving, fixed, initial)
            if isinstance(motion, Located):
                return Edge(moving, fixed, motion, locator.name)
            lost[locator.name] = motion
        return Edge(moving, fixed, _lost_by_all(lost))

    def _registered_by(
        self, locator: NamedLocator, moving: int, fixed: int, initial: Homography | None
    ) -> Located | NotLocated:
        features = self._features(locator, moving), self._features(locator, fixed)
        with self._clock("locate"):
            with self._level.attributing(locator):
                motion = locator.component.register(*features, initial)
            if broken := broken_promise(motion) or self._standstill(motion, initial):
                raise PluginError(f"{locator.origin} broke its contract at level {self._level.number}: {broken}")
            if isinstance(motion, NotLocated):
                return motion
            return self._checked(motion, moving, fixed)

    def _initial(self, moving: int, fixed: int) -> Homography | None:
        """Return the motion known so far, in px of exposures."""
        if self._to_plane is None or self._from_plane is None:
            return None
        return rescaled(self._from_plane[fixed] @ self._to_plane[moving], self._level.scale)

    def _standstill(self, motion: Located | NotLocated, initial: Homography | None) -> str | None:
        """Tell that a locator gives the identity where the motion known so far is far from it; None if all is well."""
        if initial is None or isinstance(motion, NotLocated) or not is_identity(motion.homography):
            return None
        shape = self._exposures.frame_shape
        moved_px = corner_displacements(rescaled(initial, 1 / self._level.scale), np.eye(3), shape).mean()
        if moved_px < STILL_SHARE * min(shape):
            return None
        return f"got the identity where the motion known so far moves the corners by {moved_px:.0f} px; a failure is NotLocated"

    def _checked(self, motion: Located, moving: int, fixed: int) -> Located | NotLocated:
        """Convert a motion to px of frames, and refuse what no camera does."""
        homography = rescaled(motion.homography, 1 / self._level.scale)
        if reason := why_implausible(homography, self._exposures.frame_shape):
            return NotLocated(reason, motion.evidence)
        groups = self._exposures.groups
        new = self._independent * max(1 - shared_share(groups[moving].span, groups[fixed].span), SHARED_PHOTONS)
        information = motion.information
        if information is not None:
            # p1..p8 in px of exposures to px of frames: to first order only translation and perspective change.
            units = np.array([1, 1, 1, 1, self._level.scale, self._level.scale, 1 / self._level.scale, 1 / self._level.scale])
            information = information * np.outer(units, units) * new
        residual_px = None if motion.residual_px is None else motion.residual_px / self._level.scale
        return replace(motion, homography=homography, information=information, residual_px=residual_px)


def _lost_by_all(lost: Mapping[str, NotLocated]) -> NotLocated:
    """Join what several locators say of a pair, each under its name; what a single one says stays as it is."""
    if len(lost) == 1:
        return next(iter(lost.values()))
    reason = "; ".join(f"{name}: {each.reason}" for name, each in lost.items())
    return NotLocated(reason, {f"{name}.{key}": value for name, each in lost.items() for key, value in each.evidence.items()})


def broken_promise(motion: object) -> str | None:
    """Tell what is wrong with what a locator returns for a pair; None if nothing is."""
    if not isinstance(motion, Located | NotLocated):
        return f"expected Located or NotLocated, got {type(motion).__name__}"
    for key, value in motion.evidence.items():
        if not isinstance(value, Real | np.generic):
            return f"evidence consists of numbers, got {key} = {value!r:.60}"
    if isinstance(motion, NotLocated):
        return None
    matrix, information = np.asarray(motion.homography), motion.information
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or matrix[2, 2] == 0:
        return f"a homography is a finite (3, 3) matrix with h33 = 1, got {matrix.tolist()}; a failure is NotLocated"
    if information is not None and not _is_positive_definite(np.asarray(information)):
        return "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
    return None


def require_motion(level: Level, edges: Sequence[Edge]) -> None:
    """Refuse a level where nothing moves, to the last digit, in any pair: it is what a locator gives that fails unnoticed.

    Photon noise sees to it that a camera which stands still gives nearly, and never exactly, the identity.

    Args:
        level: its locators.
        edges: its pairs.

    Raises:
        PluginError: every located pair is exactly the identity.
    """
    located = [(edge.locator, edge.motion.homography) for edge in edges if isinstance(edge.motion, Located)]
    if not located or not all(is_identity(homography) for _, homography in located):
        return
    names = {name for name, _ in located}
    origins = listed(locator.origin for locator in level.locators if locator.name in names)
    raise PluginError(
        f"{origins} broke {'its' if len(names) == 1 else 'their'} contract at level {level.number}: every pair that was "
        "located is exactly the identity, which a camera that stands still does not give; a failure is NotLocated"
    )


def is_identity(homography: Homography) -> bool:
    """Tell whether a map is the identity to within rounding, which no estimate from photons is."""
    return bool(np.abs(np.asarray(homography) - np.eye(3)).max() < 1e-9)


def _is_positive_definite(matrix: FloatArray) -> bool:
    if matrix.shape != (8, 8) or not np.all(np.isfinite(matrix)):
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _in_order(pool: ThreadPoolExecutor, work: Callable[[int], Any], items: Iterable[int], ahead: int) -> Iterator[Any]:
    """Yield `work(item)` in order, with a few items worked on ahead."""
    running: deque[Future[Any]] = deque()
    try:
        for item in items:
            running.append(pool.submit(work, item))
            if len(running) > ahead:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    finally:
        for future in running:
            future.cancel()
