"""Registration: describe the exposures of a level, and locate pairs of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock
from typing import TypeVar

from photonpano.execution.context import Context, Log
from photonpano.execution.threads import batched, in_order, lagging
from photonpano.geometry import inverse
from photonpano.motion.closures import MIN_SIMILARITY
from photonpano.motion.diagnosis import Contrast
from photonpano.motion.exposure_tasks import Descriptions, ExposureTasks, Notes, Pair
from photonpano.motion.level import FrameHomography, VirtualExposures
from photonpano.motion.pairs import instants_of
from photonpano.motion.tracking import Place, StartingMotion
from photonpano.values import Decision, Edge, Located, NotLocated

ResultT = TypeVar("ResultT")

# Predecessors with which an exposure is registered if none of its own pairs is located.
BRIDGE = 3


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
