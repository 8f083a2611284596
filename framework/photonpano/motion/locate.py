"""The locate step: register pairs of exposures, and find where all of them lie."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from photonpano.context import Context
from photonpano.motion.closures import revisits
from photonpano.motion.diagnosis import require_tied
from photonpano.motion.graph import GraphOptions, GraphSolution, components, solve
from photonpano.motion.level import Level
from photonpano.motion.merge import VirtualExposures
from photonpano.motion.pairs import pairs_of
from photonpano.motion.registration import Registrar, require_motion
from photonpano.protocols import Trajectory
from photonpano.threads import Stopwatch
from photonpano.values import Edge, FloatArray, FrameSpan, Group, NotLocated


@dataclass(frozen=True, slots=True, eq=False)
class LocatedLevel:
    """Where the exposures of a level lie.

    Attributes:
        groups: the groups of the level.
        edges: every pair that was tried, with its motion or the reason why there is none.
        n_revisits: how many of them, at the end, are pairs that may see one place at different times.
        solution: one homography an exposure.
        frame_shape: (height, width) of a frame.
    """

    groups: Sequence[Group]
    edges: tuple[Edge, ...]
    n_revisits: int
    solution: GraphSolution
    frame_shape: tuple[int, int]

    @property
    def instants(self) -> FloatArray:
        """The reference instants of the located exposures: (N,)."""
        return np.array([group.reference for group in self.groups])[self.solution.located]

    @property
    def homographies(self) -> FloatArray:
        """Their homographies to the plane of one of them: (N, 3, 3)."""
        return self.solution.homographies[self.solution.located]

    @property
    def information(self) -> FloatArray | None:
        """What is known of each of them while the others are held, as inverse covariances of p1..p8: (N, 8, 8).

        None for a single exposure, which nothing ties to others.
        """
        return self.solution.information[self.solution.located] if self.n_located > 1 else None

    @property
    def revisits(self) -> tuple[Edge, ...]:
        """The pairs that may see one place at different times."""
        return self.edges[len(self.edges) - self.n_revisits :]

    @property
    def covered(self) -> FrameSpan:
        """The frames from the first to the last that located exposures hold.

        Their motion is known: an exposure tells of all its frames, also of those beyond the last instant that was located.
        """
        spans = [group.span for group, located in zip(self.groups, self.solution.located, strict=True) if located]
        return FrameSpan(min(span.start for span in spans), max(span.stop for span in spans))

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
    graph: GraphOptions,
    clock: Stopwatch,
    context: Context,
) -> LocatedLevel:
    """Register the pairs of a level, and solve the motion graph.

    Each exposure is merged and described once, in order, a few ahead of the pairs that need it, and forgotten after the last.
    What the first locator loses is offered to the next. Where the motion leads back to places seen before, pairs of such
    exposures close loops. Only for these two are exposures merged and described once more.

    Raises:
        LocationError: exposures cannot be tied to each other, and the settings do not allow to go on without them.
        PluginError: a locator failed in its own way, or returned what is no motion.
    """
    groups, shape = exposures.groups, exposures.frame_shape
    registrar = Registrar(level, exposures, known, clock)
    pairs = pairs_of(groups, graph.skips)
    title = f"level {level.number}: merge and locate"
    with ThreadPoolExecutor(context.threads) as pool:
        with context.progress.stage(title, len(groups), "exposures") as advance:
            edges = tuple(registrar.edges(pairs, pool, context.threads, advance))
        require_motion(level, edges)
        with clock("locate"):
            labels = components(len(groups), edges)
            require_tied(level.number, groups, edges, labels, registrar.contrasts, graph.disconnected)
            candidates = np.flatnonzero(labels == 0)
            anchor = int(candidates[len(candidates) // 2])
            solution = solve(len(groups), edges, anchor, shape)
            again: list[tuple[int, int]] = []
            if graph.closure_overlap is not None:
                again = revisits(groups, solution.homographies, solution.located, shape, graph.skips, graph.closure_overlap)
        closures = tuple(registrar.revisits(again, solution.homographies, pool))
    if closures:
        with clock("locate"):
            solution = solve(len(groups), edges + closures, anchor, shape)
    return LocatedLevel(groups, edges + closures, len(closures), solution, shape)
