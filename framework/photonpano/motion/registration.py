"""Registration of a level: describe its exposures, locate pairs of them, and find loop closures."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import groupby
from operator import attrgetter
from typing import Any, Generic, TypeAlias, TypeVar
from uuid import uuid4

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.attribution import blaming
from photonpano.contracts.requirements import require_no_standstill, why_undetermined
from photonpano.execution.context import Context, Log
from photonpano.execution.threads import Stopwatch, batched, in_order, lagging, submitted
from photonpano.geometry import corners, inverse, rescaled, rescaling, transform_points, translation, why_implausible
from photonpano.motion.diagnosis import Contrast, contrast_of
from photonpano.motion.graph import GraphOptions, GraphSolution
from photonpano.motion.level import FrameHomography, NamedLocator, VirtualExposures
from photonpano.motion.pairs import instants_of, lengths_of, shared_share
from photonpano.motion.tracking import Place, StartingMotion, Track
from photonpano.photometry import noise_free_correlation, stabilised_flux
from photonpano.values import Decision, Edge, FloatArray, FluxImage, Group, Homography, Located, NotLocated, VirtualExposure

# Least similarity of a loop closure: that of one place is 0.9 and more in enough light, that of different places below 0.5.
MIN_SIMILARITY = 0.7
_GRID = 8  # the overlap of two fields of view is counted on a grid of this many points along each axis
_MIN_SKIP = 2.0  # the exposures of a loop closure are at least this many times as far apart in time as the longest skip
# Between two visits of a place the overlap falls by at least this share, two columns of the grid; a tremor does not count.
_PROMINENCE = 0.25
_MAX_CLOSURES = 3  # most loop closures of an exposure with earlier ones; those of the largest overlap are taken
# Most exposures of a level with loop closures to earlier ones, spread over the capture. Neighbours tie the others to them.
_MAX_EXPOSURES = 64
# Exposures are compared by averages of blocks of this side, px: these have less noise, and hide differences of motion blur.
_BLOCK = 4
# Most hypotheses of a pair that are used.
MAX_HYPOTHESES = 100
# Predecessors with which an exposure is registered if none of its own pairs is located.
BRIDGE = 3
ResultT = TypeVar("ResultT")


def closure_candidates(
    groups: Sequence[Group], solution: GraphSolution, frame_shape: tuple[int, int], graph: GraphOptions
) -> list[tuple[int, int]]:
    """Return pairs (moving, fixed) of exposures that overlap at different times, ordered by the moving one.

    An exposure is paired with the best view of each earlier visit: a prominent maximum of the overlap, as a function of time.
    Exposures that are denser than their length are thinned out.
    """
    if graph.closure_overlap is None:
        return []
    instants, lengths = instants_of(groups), lengths_of(groups)
    length = float(np.quantile(lengths, 0.5, method="lower"))  # one that occurs
    spacing = float(np.median(np.diff(instants))) if len(groups) > 1 else length
    chosen = np.flatnonzero(solution.located & (lengths == length))[:: max(1, round(length / spacing))]
    min_interval = _MIN_SKIP * max([1.0, *graph.skips]) * length
    pairs: list[tuple[int, int]] = []
    for position, moving in list(enumerate(chosen))[:: max(1, -(-len(chosen) // _MAX_EXPOSURES))]:
        earlier = chosen[:position]
        overlap = _overlaps(solution.homographies[moving], solution.homographies[earlier], frame_shape)
        peaks = _visits(overlap, graph.closure_overlap)
        peaks = peaks[instants[earlier[peaks]] <= instants[moving] - min_interval]
        best = peaks[np.argsort(-overlap[peaks], kind="stable")[:_MAX_CLOSURES]]
        pairs += [(int(moving), int(fixed)) for fixed in np.sort(earlier[best])]
    return pairs


def exposure_similarity(moving: VirtualExposure, fixed: VirtualExposure, homography: FrameHomography) -> float:
    """Return the correlation of two exposures of one scale that they would have without photon noise, under a motion.

    It is 1 for the same place and around 0 for different ones; 0 where the overlap is small, or the scene does not stand out
    from the noise.
    """
    height, width = (side // _BLOCK for side in moving.flux.shape)
    if not height * width:
        return 0.0
    # From block numbers to the top left pixels of the nearest blocks of the other exposure: interpolation between averages
    # would change their noise.
    half = (_BLOCK - 1) / 2
    to_fixed = translation(-half, -half) @ rescaled(homography, moving.scale) @ rescaling(_BLOCK)
    first, first_variance = (image[::_BLOCK, ::_BLOCK][:height, :width] for image in _averages(moving))
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    second, second_variance = (
        cv2.warpPerspective(image, to_fixed, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        for image in _averages(fixed)
    )
    both = np.isfinite(first) & np.isfinite(second)
    if not both.any():
        return 0.0
    noise = float(first_variance[both].mean()), float(second_variance[both].mean())
    return noise_free_correlation(np.cov(first[both], second[both].astype(np.float32)), noise, float(both.sum()))


def _averages(exposure: VirtualExposure) -> tuple[FluxImage, FluxImage]:
    """Return the average of the block that starts at each pixel, on the scale where noise is uniform, and its variance.

    Both are NaN where part of the block was not seen.
    """
    seen = exposure.weight > 0
    values = np.where(seen, stabilised_flux(exposure), np.float32(np.nan))
    variance = np.full_like(values, np.nan)
    variance[seen] = exposure.response.stabilised_std(exposure.weight[seen]) ** 2 / _BLOCK**2
    kernel = np.full((_BLOCK, _BLOCK), 1 / _BLOCK**2)
    rows, columns = (side - _BLOCK + 1 for side in values.shape)
    mean, mean_variance = (
        np.asarray(cv2.filter2D(image, -1, kernel, anchor=(0, 0))[:rows, :columns], np.float32) for image in (values, variance)
    )
    return mean, mean_variance


def _visits(overlap: FloatArray, min_overlap: float) -> NDArray[np.integer]:
    """Return the positions of the prominent maxima of the overlap: the best view of each earlier visit.

    Equal to `scipy.signal.find_peaks`, whose import takes a second.
    """
    # Bounded by no overlap before the first exposure, and the full overlap of the exposure with itself.
    profile = np.concatenate([[0.0], overlap, [1.0]])
    peaks = []
    inner = profile[1:-1]
    for peak in np.flatnonzero((inner >= min_overlap) & (inner > profile[:-2]) & (inner >= profile[2:])) + 1:
        higher_before, higher_after = (np.flatnonzero(side > profile[peak]) for side in (profile[:peak], profile[peak:]))
        start = higher_before[-1] if higher_before.size else 0
        stop = peak + (higher_after[0] if higher_after.size else len(profile) - peak)
        prominence = profile[peak] - max(profile[start:peak].min(), profile[peak:stop].min())
        if prominence >= _PROMINENCE:
            plateau = int(np.argmax(profile[peak:] != profile[peak]))
            peaks.append(peak - 1 + (plateau - 1) // 2)
    return np.array(peaks, dtype=int)


def _overlaps(moving: FloatArray, fixed: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the share of one field of view that each of N others sees: (N,)."""
    low, high = corners(frame_shape)[[0, 2]]
    # Centres of cells: points on the border would leave the field of view at the least motion.
    x, y = (low[axis] + (high[axis] - low[axis]) * (np.arange(_GRID) + 0.5) / _GRID for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    between = inverse(fixed) @ moving
    seen = transform_points(between, points)
    ahead = points @ between[:, 2, :2, None] + between[:, 2:, 2, None] > 0
    with np.errstate(invalid="ignore"):
        inside = np.all((seen >= low) & (seen <= high), axis=-1) & ahead[..., 0]
    return np.asarray(inside.mean(axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """An exposure, described."""

    contrast: Contrast  # of its image
    # what locators made of it so far, by their numbers; none of a blank exposure
    features: dict[int, Any] = field(default_factory=dict)
    exposure: VirtualExposure | None = None  # the exposure itself, within a task of loop closures


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


@dataclass(frozen=True, slots=True, eq=False)
class Partners:
    """Pairs of an exposure with earlier ones."""

    pairs: Sequence[Pair]
    bridges: Sequence[Pair]  # with its predecessors: tried one after the other if none of its pairs is located


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What a task finds of exposures and their partners."""

    edges: Mapping[int, Sequence[Edge]]  # of each exposure, by its number
    # where each lies, and the distances of second motions, see `Track`; nothing at levels that are not tracked
    places: Mapping[int, Place]
    alternatives_px: Mapping[tuple[int, int], float]


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[ResultT]):
    """What a task returns."""

    result: ResultT
    seconds: Mapping[str, float]  # in each stage
    decisions: Sequence[Decision]  # of components while it was worked on


@dataclass(frozen=True, slots=True)
class ExposureTasks:
    """The tasks of a level. Exposures are given by their numbers.

    Convention:
        All homographies are in pixels of frames; only a locator sees pixels of exposures.
    """

    exposures: VirtualExposures = field(compare=False)  # of the level
    start: StartingMotion | None = field(compare=False)  # what short spans show of the motion, at a first level
    tracks: bool = field(compare=False)  # whether each exposure starts from where those before it lie
    process: int = field(default_factory=os.getpid, compare=False)  # that of the loop
    key: str = field(default_factory=lambda: uuid4().hex)  # the same for all copies

    def describe(self, clock: Stopwatch, indices: Sequence[int], keep: bool = False) -> dict[int, Described]:
        """Merge exposures, and have the first locator describe them, if they are not blank; `keep` also the exposures."""
        found = dict[int, Described]()
        for index in indices:
            exposure = self.exposures.merged(index, clock)
            with clock("locate"):
                contrast = contrast_of(exposure)
            features = {} if contrast.blank else {0: self._features_of(exposure, 0, clock)}
            found[index] = Described(contrast, features, exposure if keep else None)
        return found

    def register(
        self, clock: Stopwatch, known: Descriptions, partners: Mapping[int, Partners], places: Mapping[int, Place]
    ) -> Found:
        """Register exposures with earlier ones, in order.

        At a level that is tracked, the motion to the nearest predicts the others. `places` are those of exposures before.
        """
        track = Track(self.start, self.exposures.groups, self.exposures.frame_shape, places) if self.tracks else None
        edges = dict[int, list[Edge]]()
        for moving, each in partners.items():
            found = edges[moving] = self._paired(track, moving, each.pairs, known, clock)
            if found and not any(isinstance(edge.motion, Located) for edge in found):
                for bridge in each.bridges:
                    found += self._paired(track, moving, [bridge], known, clock)
                    if isinstance(found[-1].motion, Located):
                        break
        if track is None:
            return Found(edges, {}, {})
        return Found(edges, {moving: track.places[moving] for moving in partners}, track.alternatives_px)

    def closures(self, clock: Stopwatch, pairs: Sequence[Pair]) -> list[Edge]:
        """Register loop closures; those whose exposures are not similar once aligned are not located."""
        known = self.describe(clock, sorted({index for pair in pairs for index in (pair.moving, pair.fixed)}), keep=True)
        return [self._similar(edge, known, clock) for edge in self._registered(pairs, known, clock)]

    def _similar(self, closure: Edge, known: Descriptions, clock: Stopwatch) -> Edge:
        """Return a loop closure with its similarity, not located if that is too small."""
        one, other = known[closure.moving].exposure, known[closure.fixed].exposure
        if isinstance(closure.motion, NotLocated) or one is None or other is None:
            return closure
        with clock("locate"):
            similarity = exposure_similarity(one, other, FrameHomography(closure.motion.homography))
        evidence = {**closure.motion.evidence, "closure_similarity": similarity}
        if similarity < MIN_SIMILARITY:
            reason = f"the similarity of the exposures of this loop closure is {similarity:.2f}, less than {MIN_SIMILARITY:g}"
            return Edge(closure.moving, closure.fixed, NotLocated(reason, evidence))
        return replace(closure, motion=replace(closure.motion, evidence=evidence))

    def _paired(
        self, track: Track | None, moving: int, pairs: Sequence[Pair], known: Descriptions, clock: Stopwatch
    ) -> list[Edge]:
        """Register an exposure with others; along a track, place it."""
        if track is None:
            return self._registered(pairs, known, clock)
        place, foreseen = track.places.get(moving), None
        found: list[Edge] = []
        for fixed in sorted((pair.fixed for pair in pairs), reverse=True):
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
        if locator not in described.features:
            exposure = self.exposures.merged(index, clock) if described.exposure is None else described.exposure
            described.features[locator] = self._features_of(exposure, locator, clock)
        return described.features[locator]

    def _features_of(self, exposure: VirtualExposure, locator: int, clock: Stopwatch) -> Any:
        named = self.exposures.level.locators[locator]
        with clock("locate"):
            return named.component.describe(exposure)


def worked(tasks: ExposureTasks, work: Callable[..., ResultT], *given: Any) -> Done[ResultT]:
    """Work on a task of a level: a method of `ExposureTasks`, and what it is given after the clock."""
    # A merger computes what all exposures of a level share once: in another process, that of the first copy is used.
    tasks = tasks if tasks.process == os.getpid() else _first_copy(tasks)
    clock, decisions = Stopwatch(), tasks.exposures.level.recorder.decisions
    before = len(decisions)
    result = work(tasks, clock, *given)
    return Done(result, clock.seconds, decisions[before:])


@lru_cache(maxsize=1)
def _first_copy(tasks: ExposureTasks) -> ExposureTasks:
    """Return the copy that came to this process first, as long as tasks of its level come."""
    return tasks


def _of_all(failures: Mapping[str, NotLocated]) -> NotLocated:
    """Join the failures of several locators, each under its name; a single one stays as it is."""
    if len(failures) == 1:
        return next(iter(failures.values()))
    reason = "; ".join(f"{name}: {each.reason}" for name, each in failures.items())
    evidence = {f"{name}.{key}": value for name, each in failures.items() for key, value in each.evidence.items()}
    return NotLocated(reason, evidence)


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """An exposure whose pairs with earlier ones are registered."""

    edges: tuple[Edge, ...]  # these pairs
    contrast: Contrast  # of its image
    place: Place | None  # where it lies, at a first level that is tracked; None at others
    alternatives_px: Mapping[int, float]  # distance of a second motion that fits as well, by the other exposure of the pair


class Registrar:
    """Has the exposures of a level described and pairs of them registered: see `ExposureTasks`."""

    def __init__(
        self,
        exposures: VirtualExposures,
        log: Log,
        context: Context,
        *,
        pool: Executor,
        start: StartingMotion | None = None,
        excluded: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        """Prepare to register; `log` has the first exposures in order, as `Registered`, and receives the others.

        `pool` works on the tasks. `start` is what short spans show of the motion, at the first level; `excluded` are pairs that
        are not to be registered.
        """
        self._exposures, self._log, self._pool, self._excluded = exposures, log, pool, excluded
        self._threads, self._at_once = context.threads, context.at_once(len(exposures.groups))
        # One call for all exposures: a trajectory takes about as long for one instant as for a thousand.
        # (N, 3, 3) homographies of the exposures by the motion known so far; None at the first level
        self.to_plane = None if exposures.previous is None else exposures.previous.at(instants_of(exposures.groups))
        self._from_plane = None if self.to_plane is None else inverse(self.to_plane)
        # Only locators that keep hypotheses start from a motion at the first level.
        locators = exposures.level.locators
        tracks = exposures.previous is None and any(hasattr(each.component, "hypotheses") for each in locators)
        self._tasks = ExposureTasks(replace(exposures, level=exposures.level.of_tasks()), start if tracks else None, tracks)
        self._places: dict[int, Place] = {}
        self._known: dict[int, Described] = {}
        self.contrasts: dict[int, Contrast] = {}  # of the exposures described so far, by their numbers
        # by pair, the distance of a second motion that fits as well from where its registration started
        self.alternatives_px: dict[tuple[int, int], float] = {}
        self._decided = len(exposures.level.recorder.decisions)

    def edges(self, pairs: Sequence[tuple[int, int]], advance: Callable[[int], None]) -> Iterator[Edge]:
        """Register pairs (moving, fixed), ordered by the moving exposure, the later one, and yield them in order.

        `advance` is called with 1 after each moving exposure.
        """
        partners: dict[int, list[int]] = {moving: [] for moving in range(len(self._exposures.groups))}
        needed_until = {index: index + BRIDGE for index in partners}
        for moving, fixed in pairs:
            partners[moving].append(fixed)
            needed_until[fixed] = max(needed_until[fixed], moving)
        known = len(self._log.found)
        for moving, registered in enumerate(self._log.found):  # before an interruption
            self.contrasts[moving] = registered.contrast
            if registered.place is not None:
                self._places[moving] = registered.place
            self.alternatives_px |= {(moving, fixed): px for fixed, px in registered.alternatives_px.items()}
            yield from registered.edges
            advance(1)
        if known == len(partners):
            return
        needed = {index: partners[index] for index in partners if max(index, needed_until[index]) >= known}
        # Pairs of several exposures are under way at once, so that no thread waits for the last pair of one.
        for job in lagging(self._submitted(needed, known), self._threads):
            done = self._noted(job.result())
            self.alternatives_px |= done.alternatives_px
            for moving, found in done.edges.items():
                second = {edge.fixed: self.alternatives_px.get((moving, edge.fixed)) for edge in found}
                alternatives = {fixed: px for fixed, px in second.items() if px is not None}
                self._log.add(Registered(tuple(found), self.contrasts[moving], done.places.get(moving), alternatives))
                yield from found
                for index in [index for index in self._known if needed_until[index] <= moving]:
                    del self._known[index]
                advance(1)

    def closures(self, pairs: Sequence[Pair], log: Log) -> Iterator[Edge]:
        """Register candidates for loop closures, and tied pairs; pairs that are not similar once aligned are not located.

        Both exposures of a pair are merged and described again. The pairs are ordered by the moving exposure. `log` has the
        first pairs in order, as `Edge`, and receives the others.
        """
        left = pairs[len(log.found) :]
        yield from log.found
        of_exposures = [list(same) for _, same in groupby(left, attrgetter("moving"))]
        for done in self._in_order(ExposureTasks.closures, of_exposures):
            for closure in self._noted(done):
                log.add(closure)
                yield closure

    def _submitted(self, partners: Mapping[int, Sequence[int]], known: int) -> Iterator[Future[Done[Found]]]:
        """Describe exposures in order; yield a job for some exposures after the other from number `known` on."""
        job: Future[Done[Found]] | None = None
        for described in self._in_order(ExposureTasks.describe, batched(partners, self._at_once)):
            self._known |= (new := self._noted(described))
            self.contrasts |= {index: each.contrast for index, each in new.items()}
            if job is not None and self._tasks.tracks:
                # In order: each exposure starts from where those before it lie.
                self._places |= job.result().result.places
            tried = {moving: self._partners(moving, partners[moving]) for moving in new if moving >= known}
            pairs = [pair for each in tried.values() for pair in (*each.pairs, *each.bridges)]
            involved = {index for pair in pairs for index in (pair.moving, pair.fixed)}
            places = {index: self._places[index] for index in involved if index in self._places}
            descriptions = {index: self._known[index] for index in involved}
            task = self._tasks, ExposureTasks.register, descriptions, tried, places
            job = submitted(self._pool, worked, *task)
            yield job

    def _in_order(self, work: Callable[..., ResultT], items: Iterable[Any]) -> Iterator[Done[ResultT]]:
        return in_order(partial(worked, self._tasks, work), items, self._threads, self._pool)

    def _partners(self, moving: int, fixed: Sequence[int]) -> Partners:
        before = range(moving - 1, max(moving - BRIDGE, 0) - 1, -1)
        bridges = [each for each in before if each not in fixed and (moving, each) not in self._excluded] if fixed else []
        return Partners(*([Pair(moving, each, self._expected(moving, each)) for each in some] for some in (fixed, bridges)))

    def _noted(self, done: Done[ResultT]) -> ResultT:
        """Return the result of a task; add up its time, and record decisions that were taken in another process.

        All processes take the same, which are recorded once.
        """
        self._exposures.clock.add(done.seconds, self._threads)
        decisions = self._exposures.level.recorder.decisions
        decisions += [each for each in done.decisions if each not in decisions[self._decided :]]
        return done.result

    def _expected(self, moving: int, fixed: int) -> FrameHomography | None:
        """Return the motion of a pair that is known so far; None at the first level."""
        if self.to_plane is None or self._from_plane is None:
            return None
        return FrameHomography(self._from_plane[fixed] @ self.to_plane[moving])
