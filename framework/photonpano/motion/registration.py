"""Registration of a level: describe its exposures, locate pairs of them, and find loop closures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.attribution import blaming
from photonpano.contracts.requirements import require_no_standstill, why_undetermined
from photonpano.execution.context import Context, Log
from photonpano.execution.threads import Guard, Stopwatch, batched, in_order, lagging
from photonpano.geometry import corners, inverse, rescaled, rescaling, transform_points, translation, why_implausible
from photonpano.motion.diagnosis import Contrast, contrast_of
from photonpano.motion.graph import GraphOptions, GraphSolution
from photonpano.motion.level import FrameHomography, NamedLocator, VirtualExposures
from photonpano.motion.pairs import instants_of, lengths_of, shared_share
from photonpano.motion.tracking import Place, StartingMotion, Track
from photonpano.photometry import noise_free_correlation
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
    values = np.where(seen, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(np.nan))
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
        start: StartingMotion | None = None,
        excluded: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        """Prepare to register; `log` has the first exposures in order, as `Registered`, and receives the others.

        `start` is what short spans show of the motion, at the first level; `excluded` are pairs that are not to be registered.
        """
        self._excluded = excluded
        self._executor, self._exposures, self._clock, self._log = context.executor, exposures, exposures.clock, log
        self._at_once = context.executor.at_once(len(exposures.groups))
        tasks = ExposureTasks(exposures)
        self._tasks = context.executor.share(tasks)
        # One call for all exposures: a trajectory takes about as long for one instant as for a thousand.
        # (N, 3, 3) homographies of the exposures by the motion known so far; None at the first level
        self.to_plane = None if exposures.previous is None else exposures.previous.at(instants_of(exposures.groups))
        self._from_plane = None if self.to_plane is None else inverse(self.to_plane)
        # Only locators that keep hypotheses start from a motion at the first level.
        self._tracks = exposures.previous is None and any(
            hasattr(locator.component, "hypotheses") for locator in exposures.level.locators
        )
        self._start = context.executor.share(start) if self._tracks else None
        self._places: dict[int, Place] = {}
        self._kept: dict[int, Descriptions] = {}
        self.contrasts: dict[int, Contrast] = {}  # of the exposures described so far, by their numbers
        # by pair, the distance of a second motion that fits as well from where its registration started
        self.alternatives_px: dict[tuple[int, int], float] = {}
        self._decided, self._lock = set[Decision](), Lock()

    def edges(
        self, pairs: Sequence[tuple[int, int]], pool: ThreadPoolExecutor, threads: int, advance: Callable[[int], None]
    ) -> Iterator[Edge]:
        """Register pairs (moving, fixed), ordered by the moving exposure, the later one, and yield them in order.

        `threads` exposures are worked on ahead, and `advance` is called with 1 after each moving exposure.
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
        needed = {index: partners[index] for index in partners if max(index, needed_until[index]) >= known}
        if known == len(partners):
            return
        # Pairs of several exposures are under way at once, so that no thread waits for the last pair of one.
        for moving, job in lagging(self._submitted(needed, known, pool, threads), threads * self._at_once):
            found = [edge for edge in job.result() if edge.moving == moving]
            if found and not any(isinstance(edge.motion, Located) for edge in found):
                found += self._bridge(moving, partners[moving])
            second = {edge.fixed: self.alternatives_px.get((moving, edge.fixed)) for edge in found}
            alternatives = {fixed: px for fixed, px in second.items() if px is not None}
            self._log.add(Registered(tuple(found), self.contrasts[moving], self._places.get(moving), alternatives))
            yield from found
            for index in [index for index in self._kept if needed_until[index] <= moving]:
                del self._kept[index]
            advance(1)

    def closures(self, pairs: Sequence[Pair], pool: ThreadPoolExecutor, log: Log) -> Iterator[Edge]:
        """Register candidates for loop closures, and tied pairs; pairs that are not similar once aligned are not located.

        Both exposures of a pair are merged and described again, at the same time. The pairs are ordered by the moving exposure.
        `log` has the first pairs in order, as `Edge`, and receives the others.
        """
        self._kept.clear()
        needed_until = {index: position for position, pair in enumerate(pairs) for index in (pair.moving, pair.fixed)}
        yield from log.found
        for position, pair in enumerate(pairs):
            if position < len(log.found):
                continue
            missing = [index for index in (pair.moving, pair.fixed) if index not in self._kept]
            for index, [(kept, _)] in zip(missing, pool.map(lambda each: self._describe([each], True), missing), strict=True):
                self._kept[index] = kept
            closure = self._similar(self._register([pair])[0])
            log.add(closure)
            yield closure
            for index in [index for index in self._kept if needed_until[index] <= position]:
                del self._kept[index]

    def _submitted(
        self, partners: Mapping[int, Sequence[int]], known: int, pool: ThreadPoolExecutor, threads: int
    ) -> Iterator[tuple[int, Future[list[Edge]]]]:
        """Describe exposures in order; yield each from number `known` on with a job that registers its pairs."""
        bundles = list(batched(partners, self._at_once))
        job: Future[list[Edge]] | None = None
        for bundle, described in zip(bundles, in_order(self._describe, bundles, threads, pool), strict=True):
            for index, (kept, contrast) in zip(bundle, described, strict=True):
                self._kept[index], self.contrasts[index] = kept, contrast
            new = {index: partners[index] for index in bundle if index >= known}
            if self._tracks:
                # In order: each exposure starts from where those before it lie.
                job = pool.submit(self._register_along, new, job)
            else:
                pairs = [Pair(moving, fixed, self._expected(moving, fixed)) for moving in new for fixed in new[moving]]
                job = pool.submit(self._register, pairs)
            yield from ((moving, job) for moving in new)

    def _register_along(self, partners: Mapping[int, Sequence[int]], before: Future[list[Edge]] | None = None) -> list[Edge]:
        """Register exposures of the first level with earlier ones, once the job of those before them is done."""
        if before is not None:
            before.result()
        involved = {*partners, *(fixed for earlier in partners.values() for fixed in earlier)}
        places = {index: self._places[index] for index in involved if index in self._places}
        task = ExposureTasks.register_along, self._tasks, self._start, partners, places
        tracked = self._noted(self._executor.call(*task, *self._descriptions(involved)))
        self._places |= tracked.places
        self.alternatives_px |= tracked.alternatives_px
        return [edge for edges in tracked.edges.values() for edge in edges]

    def _bridge(self, moving: int, tried: Sequence[int]) -> Iterator[Edge]:
        """Register an exposure with its predecessors, until one is located."""
        for fixed in range(moving - 1, max(moving - BRIDGE, 0) - 1, -1):
            if fixed not in tried and (moving, fixed) not in self._excluded:
                pair = Pair(moving, fixed, self._expected(moving, fixed))
                [edge] = self._register_along({moving: [fixed]}) if self._tracks else self._register([pair])
                yield edge
                if isinstance(edge.motion, Located):
                    return

    def _similar(self, closure: Edge) -> Edge:
        """Return a loop closure with its similarity, not located if that is too small."""
        if isinstance(closure.motion, NotLocated):
            return closure
        pair = closure.moving, closure.fixed
        task = ExposureTasks.similarity, self._tasks, *pair, closure.motion.homography
        similarity = self._noted(self._executor.call(*task, *self._descriptions(pair)))
        evidence = {**closure.motion.evidence, "closure_similarity": similarity}
        if similarity < MIN_SIMILARITY:
            reason = f"the similarity of the exposures of this loop closure is {similarity:.2f}, less than {MIN_SIMILARITY:g}"
            return Edge(closure.moving, closure.fixed, NotLocated(reason, evidence))
        return replace(closure, motion=replace(closure.motion, evidence=evidence))

    def _describe(self, indices: Sequence[int], keep: bool = False) -> list[tuple[Descriptions, Contrast]]:
        """Have exposures described; return what stands for that, and the contrast of each."""
        described, known = self._executor.keep(ExposureTasks.describe, self._tasks, indices, keep)
        return [(described, contrast) for contrast in self._noted(known)]

    def _register(self, pairs: Sequence[Pair]) -> list[Edge]:
        """Have pairs registered from where they are expected."""
        if not pairs:
            return []
        described = self._descriptions(index for pair in pairs for index in (pair.moving, pair.fixed))
        return self._noted(self._executor.call(ExposureTasks.register, self._tasks, pairs, *described))

    def _descriptions(self, indices: Iterable[int]) -> Iterable[Descriptions]:
        """Return what stands for the descriptions of exposures; of those that were described together, once."""
        return {id(kept): kept for kept in (self._kept[index] for index in indices)}.values()

    def _noted(self, done: tuple[ResultT, Notes]) -> ResultT:
        """Return the result of a task; add up its time, and record its decisions once, since all workers take the same."""
        result, notes = done
        self._clock.add(notes.seconds)
        with self._lock:
            for decision in notes.decisions:
                if decision not in self._decided:
                    self._decided.add(decision)
                    self._exposures.level.recorder.add(decision)
        return result

    def _expected(self, moving: int, fixed: int) -> FrameHomography | None:
        """Return the motion of a pair that is known so far; None at the first level."""
        if self.to_plane is None or self._from_plane is None:
            return None
        return FrameHomography(self._from_plane[fixed] @ self.to_plane[moving])
