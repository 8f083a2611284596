"""The locate step: register pairs of exposures, and solve for the homography of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from photonpano.contracts.attribution import label_of
from photonpano.contracts.protocols import Source, camera_of
from photonpano.contracts.requirements import why_still
from photonpano.errors import PluginError
from photonpano.execution.context import Context
from photonpano.geometry import corner_displacements, corners, inverse, transform_points, translation
from photonpano.motion.adjustment import Assessment, std_of
from photonpano.motion.diagnosis import require_tied, solving
from photonpano.motion.graph import GraphOptions, GraphSolution, Rival, components, solve
from photonpano.motion.gyroscope import Gyroscope
from photonpano.motion.level import FrameHomography, Timeline, VirtualExposures
from photonpano.motion.models import HOMOGRAPHIES, MotionModel
from photonpano.motion.pairs import TiedPair, alike, excluded_pairs, instants_of, pairs_of, tied_pairs, ties_of
from photonpano.motion.registration import MIN_SIMILARITY, Pair, Registrar, closure_candidates, exposure_similarity
from photonpano.motion.tracking import StartingMotion
from photonpano.text import listed
from photonpano.values import Ambiguity, Edge, FloatArray, FrameSpan, Group, Located, NotLocated

# A fallback contradicts the first locator beyond this fraction of the shorter side of a frame.
_CONTRADICTION = 0.05
_COMPARED = 200  # exposures whose errors are compared with those of others that see the same


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopSetting:
    """What all levels of the loop have in common."""

    source: Source
    graph: GraphOptions
    context: Context
    reference: int  # the frame whose homography is the identity
    timeline: Timeline  # where the image jumps, and which frames show something
    finest: float = 1.0  # pixels of the last level's exposures per pixel of a frame
    model: MotionModel = HOMOGRAPHIES
    gyroscope: Gyroscope | None = None  # ties exposures, and knows how they tremble


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LocatedLevel:
    """The exposures of a level, located."""

    groups: Sequence[Group]
    edges: tuple[Edge, ...]  # every pair that was tried, with its motion or the reason why there is none
    closures: tuple[Edge, ...]  # the candidates for loop closures among them, which stand at the end
    solution: GraphSolution  # one homography for each exposure
    assessed: Assessment  # how well the located exposures are determined
    frame_shape: tuple[int, int]  # (height, width) of a frame
    compare: Callable[[], Mapping[str, Rival]]  # that of `GraphSolution`, before loop closures
    ambiguity: Ambiguity | None = None  # pairs that fit the scene at more than one place; None where there are none

    @property
    def rivals(self) -> Mapping[str, Rival]:
        """How well models of the motion explain the pairs, by their names."""
        return self.compare()

    @property
    def std_px(self) -> FloatArray:
        """The expected error of the corners of each located exposure, (N,); NaN for a single one."""
        return self.assessed.std_px

    @property
    def drift_share(self) -> float:
        """The share of its variance that exposures have in common with those that see half of what they see.

        It is that of homographies; 0 for a camera that turns, whose frames may have no place on a plane.
        """
        errors, middle = self.assessed.errors_px, corners(self.frame_shape).mean(axis=0)
        if self.solution.rotations is not None or len(errors) < 2:
            return 0.0
        places = transform_points(self.homographies, middle[None])[:, 0]
        some = np.unique(np.linspace(0, len(places) - 1, _COMPARED).astype(int))
        near = np.linalg.norm(places[some, None] - places, axis=2) <= max(self.frame_shape) / 2
        last = len(places) - 1 - near[:, ::-1].argmax(axis=1)
        beside = std_of((errors[last] - errors[some])[last > some])
        return max(float(1 - np.mean(beside**2) / 2 / np.mean(self.std_px**2)), 0.0)

    @property
    def information(self) -> FloatArray | None:
        """That of the assessment; None for a single exposure."""
        return self.assessed.information if len(self.assessed.information) > 1 else None

    @property
    def instants(self) -> FloatArray:
        """The reference instants of the located exposures: (N,)."""
        return instants_of(self.groups)[self.solution.located]

    @property
    def homographies(self) -> FloatArray:
        """The homographies of the located exposures to the plane of one of them: (N, 3, 3)."""
        return self.solution.homographies[self.solution.located]

    @property
    def covered(self) -> FrameSpan:
        """The frames from the first to the last of all located exposures; trajectories are extrapolated to the outermost."""
        spans = [group.span for group, located in zip(self.groups, self.solution.located, strict=True) if located]
        return FrameSpan(min(span.start for span in spans), max(span.stop for span in spans))

    @property
    def n_located(self) -> int:
        """How many exposures are located."""
        return int(self.solution.located.sum())

    @property
    def failures(self) -> tuple[Edge, ...]:
        """The pairs that were not located."""
        return tuple(edge for edge in self.edges if isinstance(edge.motion, NotLocated))


def locate(exposures: VirtualExposures, setting: LoopSetting, start: StartingMotion | None = None) -> LocatedLevel:
    """Register the pairs of a level, and solve the motion graph (paper, section 4, "Locate").

    Each exposure is merged and described once, in order, a few ahead of the pairs that need it, and released after its last
    pair. At the first level, pairs begin with the `start` that short spans show, if any. A pair that the first locator does not
    locate is passed to the next. Pairs that are tied by hand are registered from there, and those of a gyroscope are added.
    Once the graph is solved, pairs of exposures that overlap at different times are registered as loop closures, and the graph
    is solved again. Fallback locators and loop closures need exposures that were released; these are merged again.

    Raises:
        LocationError: exposures cannot be tied to each other, and `graph.disconnected` is "error".
        PluginError: a locator failed, or broke its contract.
    """
    level, groups, shape = exposures.level, exposures.groups, exposures.frame_shape
    graph, context, model, gyroscope = setting.graph, setting.context, setting.model, setting.gyroscope
    excluded, previous = excluded_pairs(groups, graph.exclude), exposures.previous
    by_hand = tied_pairs(ties_of(graph.tie, exposures.source), groups, previous or exposures.start)
    excluded |= {(each.moving, each.fixed) for each in by_hand}
    pairs = [pair for pair in pairs_of(groups, graph.skips) if pair not in excluded]
    if previous is not None:
        pairs = alike(pairs, previous.at(instants_of(groups)), shape)
    known = None if previous is None else previous.at(np.arange(exposures.source.info.n_frames))
    camera, decisions = camera_of(exposures.source), level.recorder.decisions
    log = context.checkpoints.log(
        f"level-{level.number}", groups, pairs, known, exposures.timeline, camera, decisions=decisions
    )
    with context.pool() as pool:
        registrar = Registrar(exposures, log, context, pool=pool, start=start, excluded=excluded)
        title = f"level {level.number}: merge and locate"
        with context.progress.stage(title, len(groups), "exposures") as advance:
            edges = tuple(registrar.edges(pairs, advance))
        edges = tuple(_alike_across_cuts(exposures, each) for each in edges)
        # Locators must report their failures.
        located = [(edge.locator, edge.motion.homography) for edge in edges if isinstance(edge.motion, Located)]
        if problem := why_still([homography for _, homography in located], shape, partial(_seen_px, groups, edges, start)):
            names = {name for name, _ in located}
            origins = listed(label_of(locator.component) for locator in level.locators if locator.name in names)
            raise PluginError(
                f"{origins} broke {'its' if len(names) == 1 else 'their'} contract at level {level.number}: {problem}; "
                "a failure is NotLocated"
            )
        with exposures.clock("locate"), solving(level.number):
            edges = _checked_fallbacks(
                edges, level.locators[0].name, groups, frame_shape=shape, start=registrar.to_plane, model=model
            )
        if by_hand:
            starts = [_started(each, registrar.to_plane) for each in by_hand]
            kept = context.checkpoints.log(
                f"level-{level.number}-ties", groups, [each.expected for each in starts], decisions=decisions
            )
            registered = registrar.closures(starts, kept)
            edges += tuple(each.checked(edge) for each, edge in zip(by_hand, registered, strict=True))
        if gyroscope is not None:
            edges += gyroscope.edges(groups)
        with exposures.clock("locate"), solving(level.number):
            labels = components(len(groups), edges)
            foreseen = np.array([exposures.is_foreseen(index) for index in range(len(groups))])
            require_tied(
                level.number,
                groups,
                edges,
                parts=labels,
                contrasts=registrar.contrasts,
                disconnected=graph.disconnected,
                merged=exposures.merged,
                foreseen=foreseen,
                frame_shape=shape,
            )
            largest = np.flatnonzero(labels == 0)
            anchor = int(largest[len(largest) // 2])
            to_plane = registrar.to_plane
            solution = solve(groups, edges, anchor, frame_shape=shape, start=to_plane, model=model)
            compare = solution.compare
            candidates = [pair for pair in closure_candidates(groups, solution, shape, graph) if pair not in excluded]
            between = [inverse(solution.homographies[fixed]) @ solution.homographies[moving] for moving, fixed in candidates]
        revisits = context.checkpoints.log(
            f"level-{level.number}-revisits", groups, candidates, solution.homographies, decisions=decisions
        )
        returning = [
            Pair(*pair, FrameHomography(motion), closure=True) for pair, motion in zip(candidates, between, strict=True)
        ]
        closures = tuple(registrar.closures(returning, revisits))
    log.finish()
    with exposures.clock("locate"), solving(level.number):
        if closures:
            alone, model = solution, solution.model
            solution = solve(groups, edges + closures, anchor, frame_shape=shape, start=to_plane, model=model)
            fair = _not_outvoting(closures, edges, alone, solution)
            if fair != closures:
                closures, solution = fair, solve(groups, edges + fair, anchor, frame_shape=shape, start=to_plane, model=model)
        assessed = solution.assess()
        if solution.without_roll is not None and solution.rolls_by_chance(assessed.errors_px, shape):
            solution = solution.without_roll()
            assessed = solution.assess()
    return LocatedLevel(
        groups=groups,
        edges=edges + closures,
        closures=closures,
        solution=solution,
        assessed=assessed,
        frame_shape=shape,
        compare=compare,
        ambiguity=_ambiguity(level.number, registrar.alternatives_px, edges, shape),
    )


def _started(tied: TiedPair, to_plane: FloatArray | None) -> Pair:
    """Return a tied pair to register: from the (N, 3, 3) motion known so far, at the first level from that of its points."""
    motion = tied.motion if to_plane is None else inverse(to_plane[tied.fixed]) @ to_plane[tied.moving]
    return Pair(tied.moving, tied.fixed, FrameHomography(motion), closure=True)


def _alike_across_cuts(exposures: VirtualExposures, edge: Edge) -> Edge:
    """Reject a pair across a cut whose exposures are not similar: where the view is another one, features agree by chance."""
    moving, fixed = exposures.groups[edge.moving], exposures.groups[edge.fixed]
    if not isinstance(edge.motion, Located) or exposures.timeline is None:
        return edge
    if np.ptp(exposures.timeline.piece_of([fixed.reference, moving.reference])) == 0:
        return edge
    one, other = exposures.merged(edge.moving), exposures.merged(edge.fixed)
    similarity = exposure_similarity(one, other, FrameHomography(edge.motion.homography))
    if similarity == 0 or similarity >= MIN_SIMILARITY:  # 0 where noise hides it
        return edge
    reason = f"across a cut, the similarity of the exposures is {similarity:.2f}, less than {MIN_SIMILARITY:g}"
    return replace(edge, motion=NotLocated(reason, edge.motion.evidence), locator="")


def _checked_fallbacks(
    edges: Sequence[Edge],
    first_locator: str,
    groups: Sequence[Group],
    *,
    frame_shape: tuple[int, int],
    start: FloatArray | None,
    model: MotionModel,
) -> tuple[Edge, ...]:
    """Reject motions by fallback locators that contradict those of the first locator; return all pairs.

    Exposures that are far apart show less of the scene in common, but all of an object that moves along with the camera. The
    first locator then fails, and the features of a fallback match on the object.
    """
    firsts = [edge for edge in edges if edge.locator == first_locator]
    others = [edge for edge in edges if isinstance(edge.motion, Located) and edge.locator != first_locator]
    if not firsts or not others:
        return tuple(edges)
    parts = components(len(groups), firsts)
    tied = {(edge.moving, edge.fixed) for edge in others if parts[edge.moving] == parts[edge.fixed]}
    contradicting: dict[tuple[int, int], float] = {}
    for part in {int(parts[moving]) for moving, _ in tied}:
        of_part = [edge for edge in firsts if parts[edge.moving] == part]
        anchor = of_part[len(of_part) // 2].moving
        homographies = solve(groups, of_part, anchor, frame_shape=frame_shape, start=start, model=model).homographies
        for edge in others:
            if (edge.moving, edge.fixed) in tied and parts[edge.moving] == part and isinstance(edge.motion, Located):
                between = inverse(homographies[edge.fixed]) @ homographies[edge.moving]
                away_px = float(corner_displacements(between, edge.motion.homography, frame_shape).mean())
                if away_px > _CONTRADICTION * min(frame_shape):
                    contradicting[edge.moving, edge.fixed] = away_px

    def checked(edge: Edge) -> Edge:
        away_px = contradicting.get((edge.moving, edge.fixed))
        if away_px is None:
            return edge
        reason = f"{edge.locator}: the motion is {away_px:.0f} px from that along the pairs of {first_locator} in between"
        return replace(edge, motion=NotLocated(reason, edge.motion.evidence), locator="")

    return tuple(map(checked, edges))


def _seen_px(groups: Sequence[Group], edges: Sequence[Edge], start: StartingMotion | None) -> float:
    """Return the largest motion of a pair by the velocities of short spans, in px; 0 where these show none."""
    instants = instants_of(groups)
    moved = [start.between(instants[edge.moving], instants[edge.fixed]) for edge in edges] if start else []
    return max((float(np.hypot(*motion[:2, 2])) for motion in moved if motion is not None), default=0.0)


def _not_outvoting(
    closures: tuple[Edge, ...], edges: Sequence[Edge], alone: GraphSolution, together: GraphSolution
) -> tuple[Edge, ...]:
    """Reject loop closures that turn other pairs between their exposures into outliers; return all closures.

    Where a scene repeats, many closures may be wrong by the same distance, and agree with each other. An uncertain pair fits
    right closures without becoming an outlier; a pair that becomes an outlier is more certain than they are. Outliers of the
    solution without closures (`alone`) are wrong anyway.
    """
    outvoted = [edges[index] for index in set(together.outliers) - set(alone.outliers) if index < len(edges)]
    found = []
    for each in closures:
        outvotes = any(each.fixed <= edge.fixed and edge.moving <= each.moving for edge in outvoted)
        if isinstance(each.motion, Located) and outvotes:
            reason = "this loop closure contradicts pairs in between that are surer"
            each = replace(each, motion=NotLocated(reason, each.motion.evidence), locator="")
        found.append(each)
    return tuple(found)


def _ambiguity(
    level: int, alternatives_px: Mapping[tuple[int, int], float], edges: Sequence[Edge], frame_shape: tuple[int, int]
) -> Ambiguity | None:
    """Return the located pairs that fit the scene at a second place, and its median distance.

    Where a roll or a zoom moves the corners of a frame otherwise than its middle by as much, a part of it lies there.
    """
    middle = corners(frame_shape).mean(axis=0)

    def spread_px(motion: Located) -> float:
        shift = translation(*(transform_points(motion.homography, middle[None])[0] - middle))
        return float(corner_displacements(motion.homography, shift, frame_shape).max())

    motions = {(edge.moving, edge.fixed): edge.motion for edge in edges if isinstance(edge.motion, Located)}
    both = sorted(motions.keys() & alternatives_px.keys())
    pairs = tuple(pair for pair in both if alternatives_px[pair] > spread_px(motions[pair]))
    if not pairs:
        return None
    return Ambiguity(level, pairs, float(np.median([alternatives_px[pair] for pair in pairs])))
