"""The locate step: register pairs of exposures, and find where all of them lie."""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.errors import PluginError
from photonpano.geometry import implausibility, inverse, rescaled
from photonpano.pipeline.diagnosis import Contrast, contrast_of, require_tied
from photonpano.pipeline.graph import largest_component, solve
from photonpano.pipeline.pairs import pairs_of, shared_share
from photonpano.values import Edge, Located, NotLocated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from concurrent.futures import Future

    from photonpano.pipeline.components import Level, NamedLocator
    from photonpano.pipeline.graph import GraphSolution
    from photonpano.pipeline.merge import VirtualExposures
    from photonpano.pipeline.progress import Progress
    from photonpano.pipeline.stopwatch import Stopwatch
    from photonpano.protocols import Trajectory
    from photonpano.spec.settings import GraphSettings
    from photonpano.values import FloatArray, Group, Homography, VirtualExposure

BRIDGE = 3
"""An exposure that none of its pairs ties to an earlier one is tried against so many predecessors."""
SHARED_PHOTONS = 0.05
"""The least weight of a pair. Photons that two exposures share say where the motion known so far puts them, and nothing new."""


@dataclass(frozen=True, slots=True, eq=False)
class LocatedLevel:
    """Where the exposures of a level lie.

    Attributes:
        groups: the groups of the level.
        edges: every pair that was tried, with its motion or the reason why there is none.
        solution: one homography an exposure.
    """

    groups: Sequence[Group]
    edges: tuple[Edge, ...]
    solution: GraphSolution

    @property
    def instants(self) -> FloatArray:
        """The reference instants of the located exposures: (N,)."""
        return np.array([group.reference for group in self.groups])[self.solution.located]

    @property
    def homographies(self) -> FloatArray:
        """Their homographies to the plane of one of them: (N, 3, 3)."""
        return self.solution.homographies[self.solution.located]

    @property
    def n_located(self) -> int:
        """How many exposures are tied together."""
        return int(self.solution.located.sum())

    @property
    def failures(self) -> tuple[Edge, ...]:
        """The pairs that were not located."""
        return tuple(edge for edge in self.edges if isinstance(edge.motion, NotLocated))


def locate(
    level: Level,
    exposures: VirtualExposures,
    known: Trajectory | None,
    graph: GraphSettings,
    threads: int,
    clock: Stopwatch,
    progress: Progress,
) -> LocatedLevel:
    """Register the pairs of a level, and solve the motion graph.

    Each exposure is merged and described once, in order, a few ahead of the pairs that need it, and forgotten after the last.
    What the first locator loses is offered to the next; only for these pairs are exposures merged and described once more.

    Raises:
        LocationError: exposures cannot be tied to each other, and the settings do not allow to go on without them.
        PluginError: a locator failed in its own way, or returned what is no motion.
    """
    groups = exposures.groups
    registrar = _Registrar(level, exposures, known, clock)
    pairs = pairs_of(groups, graph.skips)
    title = f"level {level.number}: merge and locate"
    with ThreadPoolExecutor(threads) as pool, progress.stage(title, len(groups), "exposures") as advance:
        edges = tuple(registrar.edges(pairs, pool, threads, advance))
    with clock("locate"):
        tied = largest_component(len(groups), edges)
        require_tied(level.number, groups, edges, tied, registrar.contrasts, graph.disconnected)
        candidates = np.flatnonzero(tied)
        anchor = int(candidates[len(candidates) // 2])
        solution = solve(len(groups), edges, anchor, exposures.frame_shape)
    return LocatedLevel(groups, edges, solution)


@dataclass(slots=True)
class _Described:
    """What is kept of an exposure while pairs of it are due.

    Attributes:
        contrast: how much there is to see in it.
        features: what the locators made of it, by their names.
        lock: held while a locator is asked, so that each is asked once.
    """

    contrast: Contrast
    features: dict[str, Any] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)


class _Registrar:
    """Describes exposures and registers pairs of them, in px of frames."""

    def __init__(self, level: Level, exposures: VirtualExposures, known: Trajectory | None, clock: Stopwatch) -> None:
        self._level = level
        self._exposures = exposures
        self._known = known
        self._clock = clock
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
        described = _in_order(pool, self._describe, range(len(self._exposures)), threads)
        for moving, each in enumerate(described):
            self._described[moving], self.contrasts[moving] = each, each.contrast
            found = list(pool.map(lambda fixed, moving=moving: self._register(moving, fixed), partners[moving]))
            if not any(isinstance(edge.motion, Located) for edge in found):
                found += self._bridge(moving, partners[moving])
            yield from found
            for index in [index for index in self._described if needed_until[index] <= moving]:
                del self._described[index]
            advance(1)

    def _bridge(self, moving: int, tried: Sequence[int]) -> Iterator[Edge]:
        for fixed in range(moving - 1, max(moving - BRIDGE, 0) - 1, -1):
            if fixed not in tried:
                edge = self._register(moving, fixed)
                yield edge
                if isinstance(edge.motion, Located):
                    return

    def _describe(self, index: int) -> _Described:
        exposure = self._exposures[index]
        with self._clock("locate"):
            contrast = contrast_of(exposure)
        described = _Described(contrast)
        if not contrast.blank:
            first = self._level.locators[0]
            described.features[first.name] = self._described_by(first, exposure)
        return described

    def _described_by(self, locator: NamedLocator, exposure: VirtualExposure) -> Any:
        with self._clock("locate"), self._level.blaming(locator):
            return locator.component.describe(exposure)

    def _features(self, locator: NamedLocator, index: int) -> Any:
        """Return what a locator makes of an exposure; a fallback is shown only those of pairs that were lost."""
        described = self._described[index]
        with described.lock:
            if locator.name not in described.features:
                described.features[locator.name] = self._described_by(locator, self._exposures[index])
            return described.features[locator.name]

    def _register(self, moving: int, fixed: int) -> Edge:
        """Offer a pair to one locator after the other, until one finds a motion that a camera makes."""
        for index in (moving, fixed):
            if blank := self.contrasts[index].blank:
                return Edge(moving, fixed, NotLocated(f"{self._exposures.groups[index]}: {blank}"))
        with self._clock("locate"):
            initial = self._initial(moving, fixed)
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
            with self._level.blaming(locator):
                motion = locator.component.register(*features, initial)
            if isinstance(motion, NotLocated):
                return motion
            if broken := broken_promise(motion):
                raise PluginError(f"{locator.origin} broke its contract at level {self._level.number}: {broken}")
            return self._checked(motion, moving, fixed)

    def _initial(self, moving: int, fixed: int) -> Homography | None:
        """Return the motion known so far, in px of exposures."""
        if self._known is None:
            return None
        instants = [self._exposures.groups[index].reference for index in (moving, fixed)]
        to_plane = self._known.at(instants)
        return rescaled(inverse(to_plane[1]) @ to_plane[0], self._level.scale)

    def _checked(self, motion: Located, moving: int, fixed: int) -> Located | NotLocated:
        """Convert a motion to px of frames, and refuse what no camera does."""
        homography = rescaled(motion.homography, 1 / self._level.scale)
        if reason := implausibility(homography, self._exposures.frame_shape):
            return NotLocated(reason, motion.evidence)
        groups = self._exposures.groups
        new = max(1 - shared_share(groups[moving].span, groups[fixed].span), SHARED_PHOTONS)
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
    """Tell what is wrong with what a locator calls a located pair; None if nothing is."""
    if not isinstance(motion, Located):
        return f"expected Located or NotLocated, got {type(motion).__name__}"
    matrix, information = np.asarray(motion.homography), motion.information
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or matrix[2, 2] == 0:
        return f"a homography is a finite (3, 3) matrix with h33 = 1, got {matrix.tolist()}; a failure is NotLocated"
    if information is not None and not _is_positive_definite(np.asarray(information)):
        return "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
    return None


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
