"""Registration: describe the exposures of a level, and locate pairs of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import TypeVar

from photonpano.context import Context, Log
from photonpano.geometry import inverse, why_implausible
from photonpano.motion.closures import MIN_SIMILARITY
from photonpano.motion.diagnosis import Contrast
from photonpano.motion.exposure_tasks import Described, ExposureTasks, Notes, Pair
from photonpano.motion.level import FrameHomography
from photonpano.motion.merge import VirtualExposures
from photonpano.motion.pairs import independent_share, instants_of, shared_share
from photonpano.motion.start import starting_motion
from photonpano.motion.tracking import Place, Track
from photonpano.protocols import KeepsHypotheses
from photonpano.threads import batched, in_order, lagging
from photonpano.values import Decision, Edge, FloatArray, Homography, Located, NotLocated

ResultT = TypeVar("ResultT")

BRIDGE = 3
"""If no pair of an exposure with earlier ones is located, pairs with this many predecessors are tried."""
MIN_PAIR_WEIGHT = 0.05
"""Lower bound of a pair's weight. Shared photons carry no new information: their noise agrees with the motion known so far."""


@dataclass(slots=True)
class _Kept:
    """What is kept of an exposure until its last pair is registered.

    Attributes:
        described: what each locator made of it, by the locator's number: stands for a mapping that has it, among others.
        lock: held while a locator describes it, so that each does so once.
    """

    described: dict[int, Mapping[int, Described]] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """What is known of an exposure once its pairs with earlier ones are registered.

    Attributes:
        edges: these pairs.
        contrast: how much there is to see in it.
        place: where it lies, at a first level that is tracked; None at others.
        alternatives_px: the other exposures of pairs that may as well have another motion, and how far away that is.
    """

    edges: tuple[Edge, ...]
    contrast: Contrast
    place: Place | None
    alternatives_px: Mapping[int, float]


class Registrar:
    """Describes the exposures of a level and registers pairs of them.

    Convention:
        All homographies are in pixels of frames; only a locator sees pixels of exposures.

    Attributes:
        contrasts: how much there is to see in each exposure described so far, by its number.
        to_plane: (N, 3, 3) homographies of the exposures by the motion known so far; None at the first level.
    """

    def __init__(self, exposures: VirtualExposures, log: Log, context: Context) -> None:
        """Prepare to register.

        Args:
            exposures: of the level.
            log: the first exposures in order, as `Registered`; receives the others.
            context: its executor merges, describes and registers.
        """
        self._executor, self._tasks = context.executor, context.executor.share(ExposureTasks(exposures))
        self._at_once = context.executor.at_once(len(exposures.groups))
        self._exposures, self._level, self._clock = exposures, exposures.level, exposures.clock
        self._log = log
        # One call for all exposures: a trajectory takes about as long for one instant as for a thousand.
        self.to_plane = None if exposures.previous is None else exposures.previous.at(instants_of(exposures.groups))
        self._from_plane = None if self.to_plane is None else inverse(self.to_plane)
        self._track = self._started(context) if exposures.previous is None else None
        self._independent = independent_share(exposures.groups)
        self._kept: dict[int, _Kept] = {}
        self.contrasts: dict[int, Contrast] = {}
        self._decided, self._lock = set[Decision](), Lock()

    @property
    def alternatives_px(self) -> Mapping[tuple[int, int], float]:
        """Of the pairs that may as well have another motion: how far that is from where their registration started."""
        return {} if self._track is None else self._track.alternatives_px

    def edges(
        self, pairs: Sequence[tuple[int, int]], pool: ThreadPoolExecutor, threads: int, advance: Callable[[int], None]
    ) -> Iterator[Edge]:
        """Register pairs, and yield them in order.

        Args:
            pairs: (moving, fixed), ordered by the moving exposure, which is the later one.
            pool: waits for tasks.
            threads: how many exposures are worked on ahead.
            advance: called with 1 after each moving exposure.
        """
        partners: dict[int, list[int]] = {moving: [] for moving in range(len(self._exposures.groups))}
        needed_until = {index: index + BRIDGE for index in partners}
        for moving, fixed in pairs:
            partners[moving].append(fixed)
            needed_until[fixed] = max(needed_until[fixed], moving)
        known = len(self._log.found)
        for moving, registered in enumerate(self._log.found):
            self._restore(moving, registered)
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
            self._log.add(self._registered(moving, tuple(found)))
            yield from found
            for index in [index for index in self._kept if needed_until[index] <= moving]:
                del self._kept[index]
            advance(1)

    def closures(
        self, pairs: Sequence[tuple[int, int]], homographies: FloatArray, pool: ThreadPoolExecutor, log: Log
    ) -> Iterator[Edge]:
        """Register candidates for loop closures; pairs that are not similar once aligned are not located.

        Both exposures of a pair are merged and described again.

        Args:
            pairs: (moving, fixed), ordered by the moving exposure.
            homographies: (N, 3, 3) solution of the graph without these pairs, frame pixels to a common plane.
            pool: waits for tasks: the two exposures of a pair are described at the same time.
            log: the first pairs in order, as `Edge`; receives the others.
        """
        self._kept.clear()
        needed_until = {index: position for position, pair in enumerate(pairs) for index in pair}
        yield from log.found
        for position, (moving, fixed) in enumerate(pairs):
            if position < len(log.found):
                continue
            missing = [index for index in (moving, fixed) if index not in self._kept]
            for index, [(kept, _)] in zip(missing, pool.map(lambda each: self._describe([each], True), missing), strict=True):
                self._kept[index] = kept
            expected = FrameHomography(inverse(homographies[fixed]) @ homographies[moving])
            closure = self._similar(self._register(moving, fixed, expected))
            log.add(closure)
            yield closure
            for index in [index for index in self._kept if needed_until[index] <= position]:
                del self._kept[index]

    def _registered(self, moving: int, edges: tuple[Edge, ...]) -> Registered:
        alternatives = {edge.fixed: self.alternatives_px.get((moving, edge.fixed)) for edge in edges}
        return Registered(
            edges,
            self.contrasts[moving],
            None if self._track is None else self._track.place(moving),
            {fixed: alternative for fixed, alternative in alternatives.items() if alternative is not None},
        )

    def _restore(self, moving: int, registered: Registered) -> None:
        """Take over what was found before an interruption."""
        self.contrasts[moving] = registered.contrast
        if self._track is not None:
            self._track.settle(moving, registered.place)
            self._track.alternatives_px |= {(moving, fixed): px for fixed, px in registered.alternatives_px.items()}

    def _submitted(
        self, partners: Mapping[int, Sequence[int]], known: int, pool: ThreadPoolExecutor, threads: int
    ) -> Iterator[tuple[int, Future[list[Edge]]]]:
        """Describe exposures in order; yield each new one with a job that registers its pairs, and maybe those of others.

        Args:
            partners: the exposures to describe, with the earlier ones that each is registered with.
            known: the number of exposures whose pairs are registered already.
            pool: waits for tasks.
            threads: how many tasks are worked on ahead.
        """
        bundles = list(batched(partners, self._at_once))
        for bundle, described in zip(bundles, in_order(self._describe, bundles, threads, pool), strict=True):
            for index, (kept, contrast) in zip(bundle, described, strict=True):
                self._kept[index], self.contrasts[index] = kept, contrast
            new = [index for index in bundle if index >= known]
            if self._track is not None:
                for moving in new:
                    yield moving, pool.submit(self._register_along, self._track, moving, partners[moving])
            else:
                pairs = [(moving, fixed) for moving in new for fixed in partners[moving]]
                job = pool.submit(self._register_all, [Pair(*pair, self._expected(*pair)) for pair in pairs])
                yield from ((moving, job) for moving in new)

    def _register_along(self, track: Track, moving: int, partners: Sequence[int]) -> list[Edge]:
        """Register an exposure of the first level with others; the nearest one tells where it lies in those further away."""
        place: Place | None = None
        foreseen: Place | None = None
        found: list[Edge] = []
        try:
            for fixed in sorted(partners, reverse=True):
                expected = track.expected(place, moving, fixed, partial(self._hypotheses, moving, fixed))
                found.append(self._register(moving, fixed, expected, guessed=True))
                if place is None and isinstance(motion := found[-1].motion, Located):
                    place = track.placed(moving, fixed, motion.homography)
                elif foreseen is None and expected is not None:
                    foreseen = track.placed(moving, fixed, expected)
        finally:
            track.settle(moving, place or foreseen)
        return found[::-1]

    def _bridge(self, moving: int, tried: Sequence[int]) -> Iterator[Edge]:
        """Register an exposure with its predecessors, until one is located."""
        for fixed in range(moving - 1, max(moving - BRIDGE, 0) - 1, -1):
            if fixed not in tried:
                edge = self._register(moving, fixed, self._expected(moving, fixed), guessed=self._track is not None)
                yield edge
                if isinstance(edge.motion, Located):
                    return

    def _similar(self, closure: Edge) -> Edge:
        """Return a loop closure with its similarity, not located if that is too small."""
        if isinstance(closure.motion, NotLocated):
            return closure
        pair = closure.moving, closure.fixed
        task = ExposureTasks.similarity, self._tasks, *pair, closure.motion.homography
        similarity = self._noted(self._executor.call(*task, *self._described_by(0, pair)))
        evidence = {**closure.motion.evidence, "closure_similarity": similarity}
        if similarity < MIN_SIMILARITY:
            reason = f"the similarity of the exposures of this loop closure is {similarity:.2f}, less than {MIN_SIMILARITY:g}"
            return Edge(closure.moving, closure.fixed, NotLocated(reason, evidence))
        return replace(closure, motion=replace(closure.motion, evidence=evidence))

    def _describe(self, indices: Sequence[int], keep: bool = False) -> list[tuple[_Kept, Contrast]]:
        """Have the first locator describe exposures."""
        described, known = self._executor.keep(ExposureTasks.describe, self._tasks, indices, 0, keep)
        return [(_Kept({0: described}), contrast) for contrast in self._noted(known)]

    def _described_by(self, locator: int, indices: Iterable[int]) -> Iterable[Mapping[int, Described]]:
        """Return what stands for a locator's descriptions of exposures; for a fallback, they are merged again."""
        found: dict[int, Mapping[int, Described]] = {}
        for index in indices:
            kept = self._kept[index]
            with kept.lock:
                if locator not in kept.described:
                    kept.described[locator], known = self._executor.keep(
                        ExposureTasks.describe, self._tasks, [index], locator, False
                    )
                    self._noted(known)
                described = kept.described[locator]
            found[id(described)] = described
        return found.values()

    def _noted(self, done: tuple[ResultT, Notes]) -> ResultT:
        """Return the result of a task, and take note of its time and of decisions, which workers take alike, once."""
        result, notes = done
        self._clock.add(notes.seconds)
        with self._lock:
            for decision in notes.decisions:
                if decision not in self._decided:
                    self._decided.add(decision)
                    self._level.recorder.add(decision)
        return result

    def _expected(self, moving: int, fixed: int) -> FrameHomography | None:
        """Return the motion of a pair that is known so far; None at the first level, unless both exposures are tracked."""
        if self._track is not None:
            return self._track.expected(self._track.place(moving), moving, fixed, partial(self._hypotheses, moving, fixed))
        if self.to_plane is None or self._from_plane is None:
            return None
        return FrameHomography(self._from_plane[fixed] @ self.to_plane[moving])

    def _started(self, context: Context) -> Track | None:
        """Measure how the image moves, for a first level whose locators make use of it."""
        level, groups = self._level, self._exposures.groups
        if not any(isinstance(locator.component, KeepsHypotheses) for locator in level.locators):
            return None
        with self._clock("locate"):
            complete = len(self._log.found) == len(groups)
            exposures = self._exposures
            start = None if complete else starting_motion(exposures.source, groups, context, exposures.timeline)
        return Track(start, instants_of(groups), self._exposures.frame_shape)

    def _hypotheses(self, moving: int, fixed: int) -> list[Homography]:
        """Return what the first locator that keeps hypotheses makes of a pair, in pixels of frames; none of blank exposures."""
        if self.contrasts[moving].blank or self.contrasts[fixed].blank:
            return []
        for number, locator in enumerate(self._level.locators):
            if isinstance(locator.component, KeepsHypotheses):
                pair = moving, fixed
                described = self._described_by(number, pair)
                return self._noted(self._executor.call(ExposureTasks.hypotheses, self._tasks, number, *pair, *described))
        return []

    def _register(self, moving: int, fixed: int, expected: FrameHomography | None, guessed: bool = False) -> Edge:
        """Register one pair: see `_register_all`."""
        return self._register_all([Pair(moving, fixed, expected)], guessed)[0]

    def _register_all(self, pairs: Sequence[Pair], guessed: bool = False) -> list[Edge]:
        """Pass pairs to one locator after the other, until one locates them.

        Args:
            pairs: with the motion known so far.
            guessed: whether that is a guess of the first level, which only locators that keep hypotheses start from.
        """
        found: dict[Pair, Edge] = {pair: edge for pair in pairs if (edge := self._refused(pair))}
        failures: dict[Pair, dict[str, NotLocated]] = {pair: {} for pair in pairs}
        for number, locator in enumerate(self._level.locators):
            starts = not guessed or isinstance(locator.component, KeepsHypotheses)
            left = [pair for pair in pairs if pair not in found]
            for pair, motion in zip(left, self._located_by(number, left, starts), strict=True):
                if isinstance(motion, Located):
                    found[pair] = Edge(pair.moving, pair.fixed, motion, locator.name)
                else:
                    failures[pair][locator.name] = motion
        return [found.get(pair) or Edge(pair.moving, pair.fixed, _joined(failures[pair])) for pair in pairs]

    def _refused(self, pair: Pair) -> Edge | None:
        """Return a pair that no locator needs to see, with the reason; None for any other."""
        for index in (pair.moving, pair.fixed):
            if blank := self.contrasts[index].blank:
                return Edge(pair.moving, pair.fixed, NotLocated(f"{self._exposures.groups[index]}: {blank}"))
        if pair.expected is not None and (reason := why_implausible(pair.expected, self._exposures.frame_shape)):
            return Edge(pair.moving, pair.fixed, NotLocated(f"by the motion known so far, {reason}"))
        return None

    def _located_by(self, locator: int, pairs: Sequence[Pair], starts: bool) -> list[Located | NotLocated]:
        """Return the motions of pairs as one locator finds them; photons that both exposures share do not count.

        Args:
            locator: its number.
            pairs: none of which is refused.
            starts: whether the locator starts from the motion known so far.
        """
        if not pairs:
            return []
        described = self._described_by(locator, (index for pair in pairs for index in (pair.moving, pair.fixed)))
        sent = pairs if starts else [replace(pair, expected=None) for pair in pairs]
        motions = self._noted(self._executor.call(ExposureTasks.register, self._tasks, locator, sent, *described))
        return [self._of_new_photons(pair, motion) for pair, motion in zip(pairs, motions, strict=True)]

    def _of_new_photons(self, pair: Pair, motion: Located | NotLocated) -> Located | NotLocated:
        """Return a motion whose information counts each photon once."""
        if isinstance(motion, NotLocated) or motion.information is None:
            return motion
        groups = self._exposures.groups
        new = self._independent * max(1 - shared_share(groups[pair.moving].span, groups[pair.fixed].span), MIN_PAIR_WEIGHT)
        return replace(motion, information=motion.information * new)


def _joined(failures: Mapping[str, NotLocated]) -> NotLocated:
    """Join the failures of several locators, each under its name; a single one stays as it is."""
    if len(failures) == 1:
        return next(iter(failures.values()))
    reason = "; ".join(f"{name}: {each.reason}" for name, each in failures.items())
    evidence = {f"{name}.{key}": value for name, each in failures.items() for key, value in each.evidence.items()}
    return NotLocated(reason, evidence)
