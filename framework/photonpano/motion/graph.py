"""The motion graph: exposures are nodes, pairwise motions are edges; it is solved for one homography a node."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from photonpano.geometry import (
    Camera,
    align_planes,
    corner_displacements,
    inverse,
    lenses_apart_px,
    likely_rotations,
    normalised,
    scaled_ahead,
)
from photonpano.motion.adjustment import OUTLIER, Adjustment, Assessment, Cost, Problem
from photonpano.motion.consensus import agreeing, contradicting, layers, tolerances_px, travelled
from photonpano.motion.evidence import Evidence, likeliest
from photonpano.motion.model import HOMOGRAPHIES, SAME_LENS_PX, MotionModel
from photonpano.motion.pairs import adjacency, component_labels
from photonpano.motion.planar import PlanarAdjustment, nearest
from photonpano.motion.rotation_graph import RotationAdjustment, Rotations
from photonpano.values import BoolArray, Edge, FloatArray, Located

# Share of the patches that contradict a camera that only turns, above which they are told from the background.
_CONTRADICTED = 0.005
_HELD = 3.0  # expected errors by which k1 may differ from what is given, to be held while the focal length is free
_FEWEST_NODES = 12  # of which pairs tell what is the background over time


class GraphOptions(Protocol):
    """Which pairs of exposures are registered, and whether some exposures may remain disconnected."""

    @property
    def skips(self) -> tuple[float, ...]:
        """Each exposure is registered with those at these distances before and after it, in group lengths."""

    @property
    def closure_overlap(self) -> float | None:
        """Least overlap of a loop closure, as a share of the field of view; None registers no loop closures."""

    @property
    def exclude(self) -> tuple[tuple[int, int], ...]:
        """Pairs of frames: exposures that hold them are not registered with each other."""

    @property
    def tie(self) -> Path | None:
        """A file of points that are tied by hand, see `photonpano.motion.ties`; None if there are none."""

    @property
    def disconnected(self) -> Literal["error", "largest"]:
        """Whether a graph that falls apart is an error, or its largest part is used."""


class Freed(NamedTuple):
    """What edges show of the camera where a number that is given is free."""

    number: int  # which: 0 for the focal length in px, 1 for k1
    given: float
    found: float
    std: float  # expected error of what was found


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """The homographies of the exposures.

    Convention:
        Homographies map pixels of a node's frame to pixels of the anchor's frame; the anchor's is the identity. Those of a
        rotating camera have determinant 1, all others h33 = 1.
    """

    homographies: FloatArray  # (N, 3, 3), NaN for nodes that are not tied to the anchor
    located: BoolArray  # (N,) True for nodes that are tied to the anchor
    # positions, in the list that was solved, of edges that were dropped because they contradict the others
    outliers: tuple[int, ...]
    residual_px: float  # root mean square residual of the other edges at the corners, 0 for a tree
    # returns how well the L located nodes are determined. It takes about as long as to solve the graph.
    assess: Callable[[], Assessment]
    model: MotionModel = HOMOGRAPHIES  # of these homographies: the one that "auto" chose
    rotations: Rotations | None = None  # of the L located nodes, and their camera; None for homographies
    # returns how well rival models explain the edges, None without rivals; for rotations it takes as long as solving the graph
    compare: Callable[[], Evidence | None] = lambda: None
    # (N, P) how far patches of each node lie from where the motion lets expect them, as mean squares in variances, 1 for noise;
    # 0 where nothing is known, and None where patches do not contradict the motion
    layers: FloatArray | None = None
    # angle by which what does not follow the motion passes the background: the way of the camera over its distance, if it rests
    parallax: float = 0.0
    # returns what of a given camera the edges contradict most; None where nothing is given, and for homographies
    freed: Callable[[], Freed | None] = lambda: None


def components(n_nodes: int, edges: Sequence[Edge]) -> NDArray[np.integer]:
    """Number the connected components of the located edges, the largest first: (N,)."""
    labels = component_labels(n_nodes, _pairs(edges))
    by_size = np.argsort(-np.bincount(labels), kind="stable")
    return np.asarray(np.argsort(by_size)[labels])


def solve(
    n_nodes: int,
    edges: Sequence[Edge],
    anchor: int,
    frame_shape: tuple[int, int],
    start: FloatArray | None = None,
    model: MotionModel = HOMOGRAPHIES,
) -> GraphSolution:
    """Solve the graph: find the motions with the least residuals of all located edges; that of the anchor is the identity.

    Robust least squares on the corners that each edge maps, weighted by the edge's information where it has one; Gauss-Newton
    with Cauchy weights, from a tree of edges between near exposures unless a start is given: (N, 3, 3) homographies to any
    plane. Outliers are dropped, unless the graph would fall apart, and it is solved again.
    """
    tied = _Tied.of(n_nodes, edges, anchor, frame_shape)
    if not len(tied.motions):
        return tied.alone(model)
    if model.kind == "auto":
        tied, fits = _of_background(tied, start, _rivals(tied, start, model))
        chosen = _chosen(tied, fits)
        solution = tied.solution(fits[chosen], replace(chosen, chosen=True), lambda: Evidence.of(_costs(fits)))
        turned = next((fit for model, fit in fits.items() if chosen.is_simple and model.kind == "rotation"), None)
        return solution if turned is None else replace(solution, assess=partial(_doubting, tied, solution, turned))
    tied, fits = _of_background(tied, start, {model: _fitted(tied, start, model)})
    fit = fits[model]
    solution = tied.solution(fit, model, partial(_compared, tied, start, model, fit))
    if not (model.chosen and model.is_simple):
        return solution
    with suppress(ValueError, np.linalg.LinAlgError), np.errstate(all="ignore"):
        turned = _fitted(tied, start, replace(model, kind="rotation"), [fit])
        return replace(solution, assess=partial(_doubting, tied, solution, turned))
    return solution


def _rivals(tied: _Tied, start: FloatArray | None, model: MotionModel) -> dict[MotionModel, _Fit]:
    """Fit the models of which "auto" chooses; further ones only if simple ones do not explain the pairs."""
    fits: dict[MotionModel, _Fit] = {}
    for rivals in model.rivals:
        for rival in rivals:
            # No plane holds all frames of a camera that turns far.
            with suppress(ValueError, np.linalg.LinAlgError), np.errstate(all="ignore"):
                fits[rival] = _fitted(tied, start, rival, list(fits.values()))
        if fits and _chosen(tied, fits).is_simple:
            break
    return fits


def _of_background(
    tied: _Tied, start: FloatArray | None, fits: dict[MotionModel, _Fit]
) -> tuple[_Tied, dict[MotionModel, _Fit]]:
    """Have pairs follow the patches that agree with one camera, if others contradict it: what moves by itself, or is near.

    Returns the pairs by these patches, and all models fitted to them.
    """
    costs = {model: cost for model, cost in _costs(fits).items() if model.kind == "rotation"}
    if not costs or len(tied.order) < _FEWEST_NODES:
        return tied, fits
    turning = likeliest(costs)
    first, fit = fits[turning].adjustment, fits[turning]
    assert isinstance(first, RotationAdjustment)
    if not turning.layered and contradicting(tied.motions, first.beside(fit.state)) < _CONTRADICTED:
        return tied, fits
    background = tied
    for tolerance_px in tolerances_px(tied.motions):
        motions = agreeing(tied.motions, first.beside(fit.state), tolerance_px, tied.frame_shape)
        background = replace(tied, motions=motions)
        adjustment = RotationAdjustment(background.problem, turning.seen_by(tied.frame_shape), turning.unknown)
        try:
            fit = background.fit(adjustment, fit.state)
        except (ValueError, np.linalg.LinAlgError):
            return tied, fits  # too few patches agree
    found = layers(tied.pairs, tied.motions, first.beside(fit.state), len(tied.located))
    parallax = travelled(tied.pairs, tied.motions, first.beside(fit.state), found) / fit.state.camera.focal_px
    background = replace(background, layers=found, parallax=parallax)
    others = [model for model in fits if model is not turning]
    return background, {model: _fitted(background, start, model) for model in others} | {turning: fit}


def _chosen(tied: _Tied, fits: Mapping[MotionModel, _Fit]) -> MotionModel:
    """Return the likeliest model; a lens that is not asked for must move pixels enough to matter, and not fold the frame."""
    costs = _costs(fits)
    if any(model.kind == "rotation" and not model.finds_lens for model in fits):
        for model in [each for each in fits if each.kind == "rotation" and each.finds_lens]:
            camera: Camera = fits[model].state.camera
            if not lenses_apart_px(camera, Camera(camera.matrix), tied.frame_shape) >= SAME_LENS_PX:
                del costs[model]
    return likeliest(costs)


def _doubting(tied: _Tied, solution: GraphSolution, turned: _Fit) -> Assessment:
    """Assess shifts and rolls as well as pairs can tell them from turns: perspective may be too weak to be worth its price."""
    assessed = solution.assess()
    simple, rival = solution.homographies[tied.located], scaled_ahead(turned.adjustment.homographies(turned.state))
    aligned = align_planes(simple, rival, tied.frame_shape) @ simple
    apart_px = np.sqrt((corner_displacements(inverse(rival) @ aligned, np.eye(3), tied.frame_shape) ** 2).mean(axis=-1))
    return replace(assessed, std_px=np.hypot(assessed.std_px, apart_px))


def _compared(tied: _Tied, start: FloatArray | None, model: MotionModel, fit: _Fit) -> Evidence | None:
    """Compare rotations with homographies; None for other models, and where no plane holds all frames."""
    if model.kind != "rotation":
        return None
    try:
        with np.errstate(all="ignore"):
            free = _fitted(tied, start, HOMOGRAPHIES)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return Evidence.of(_costs({model: fit, HOMOGRAPHIES: free}))


def _freed(tied: _Tied, model: MotionModel, fit: _Fit) -> Freed | None:
    """Return what edges contradict most, the focal length or k1; None where the model gives neither.

    Where k1 is as it was given, it is held, since the two depend on each other.
    """
    if not isinstance(fit.state, Rotations) or (model.focal_px is None and not model.distortion[0]):
        return None
    given = fit.state.camera.numbers
    for free in ({0, 1}, {0}):
        adjustment = RotationAdjustment(tied.problem, model.seen_by(tied.frame_shape), tuple(sorted(free.union(model.unknown))))
        freed = tied.fit(adjustment, fit.state)
        found, stds = freed.state.camera.numbers, adjustment.assess(freed.state, freed.norms, freed.kept).std_camera
        tested = (stds > 0) & ~np.isin(np.arange(5), model.unknown)
        away = np.divide(np.abs(found - given), stds, out=np.zeros(5), where=tested)
        if away[1] > _HELD:
            break
    number = int(away.argmax())
    return Freed(number, given[number], found[number], stds[number]) if away.any() else None


def _costs(fits: Mapping[MotionModel, _Fit]) -> dict[MotionModel, Cost]:
    """Return the costs of models for the edges that the one with most unknowns keeps."""
    richest = max(fits.values(), key=lambda fit: fit.adjustment.unknowns)
    return {model: fit.adjustment.cost(fit.state, np.minimum(fit.norms, OUTLIER), richest.kept) for model, fit in fits.items()}


def _fitted(tied: _Tied, start: FloatArray | None, model: MotionModel, fits: Sequence[_Fit] = ()) -> _Fit:
    """Fit a model; rotations through a lens begin with those without, if these are among the `fits`."""
    problem, shape = tied.problem, tied.frame_shape
    given = None if start is None else inverse(start[tied.anchor]) @ start[tied.located]
    if model.kind != "rotation":
        planar = model.planar
        found = nearest(planar, problem.observed if given is None else normalised(given), shape)
        return tied.fit(PlanarAdjustment(problem, planar), tied.composed(found) if given is None else found)
    adjustment = RotationAdjustment(problem, model.seen_by(shape), model.unknown)
    state = next((fit.state for fit in fits if isinstance(fit.state, Rotations)), None)
    if state is None:
        camera = model.camera(shape)
        if model.focal_px is None and model.known is None:
            camera = adjustment.likeliest_camera(camera)
        rotations = likely_rotations(camera, problem.observed if given is None else given, shape)
        state = Rotations(tied.composed(rotations) if given is None else rotations, camera)
    return tied.fit(adjustment, state)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A solution of the graph."""

    adjustment: Adjustment[Any]
    state: Any  # of least cost
    norms: FloatArray  # (E,) of the whitened residuals
    kept: BoolArray  # (E,) False for outliers


@dataclass(frozen=True, slots=True, eq=False)
class _Tied:
    """The part of a graph that is tied to its anchor."""

    located: BoolArray  # (N,) which nodes
    order: NDArray[np.integer]  # these nodes, the anchor first, each after its parent
    parents: NDArray[np.integer]  # (N,) of the nodes: a tree of short edges
    positions: NDArray[np.integer]  # (E,) of the located edges between them, in the list that is solved
    pairs: NDArray[np.integer]  # (E, 2) their nodes
    motions: Sequence[Located]  # their motions
    frame_shape: tuple[int, int]  # (height, width) of a frame
    layers: FloatArray | None = None  # see `GraphSolution`
    parallax: float = 0.0

    @classmethod
    def of(cls, n_nodes: int, edges: Sequence[Edge], anchor: int, frame_shape: tuple[int, int]) -> _Tied:
        """Find the edges that are tied to the anchor."""
        located_edges = [(position, edge) for position, edge in enumerate(edges) if isinstance(edge.motion, Located)]
        pairs = _pairs(edges)
        order, parents = _tree(n_nodes, pairs, anchor)
        located = np.zeros(n_nodes, dtype=bool)
        located[order] = True
        tied = [index for index, (moving, _) in enumerate(pairs) if located[moving]]
        positions = np.array([located_edges[index][0] for index in tied], dtype=int)
        motions = [motion for index in tied if isinstance(motion := located_edges[index][1].motion, Located)]
        return cls(located, order, parents, positions, pairs[tied], motions, frame_shape)

    @property
    def anchor(self) -> int:
        """The node that does not move."""
        return int(self.order[0])

    @property
    def compact_pairs(self) -> NDArray[np.integer]:
        """The nodes of the edges, numbered without those that are not tied: (E, 2)."""
        return np.asarray((np.cumsum(self.located) - 1)[self.pairs])

    @property
    def problem(self) -> Problem:
        """The least-squares problem, without nodes that are not tied."""
        return Problem(self.compact_pairs, int(self.located[: self.anchor].sum()), self.motions, self.frame_shape)

    def composed(self, observed: FloatArray) -> FloatArray:
        """Return the maps of the tied nodes to the anchor, each composed from its parent's along one edge: (L, 3, 3)."""
        maps = np.full((len(self.located), 3, 3), np.nan)
        maps[self.anchor] = np.eye(3)
        edge_of = {(int(moving), int(fixed)): index for index, (moving, fixed) in enumerate(self.pairs)}
        for node in map(int, self.order[1:]):
            parent = int(self.parents[node])
            forward = edge_of.get((node, parent))
            step = observed[forward] if forward is not None else inverse(observed[edge_of[parent, node]])
            maps[node] = scaled_ahead(maps[parent] @ step)
        return maps[self.located]

    def fit(self, adjustment: Adjustment[Any], state: Any) -> _Fit:
        """Solve from a start; drop outliers, unless the graph would fall apart, and solve again."""
        kept = np.ones(len(self.motions), dtype=bool)
        found, norms = adjustment.minimise(state, kept)
        inliers = adjustment.inliers(norms)
        if not inliers.all() and not component_labels(len(self.order), self.compact_pairs[inliers]).any():
            kept = inliers
            found, norms = adjustment.minimise(found, kept)
        return _Fit(adjustment, found, norms, kept)

    def solution(self, fit: _Fit, model: MotionModel, compare: Callable[[], Evidence | None]) -> GraphSolution:
        """Return a fit as the solution of the graph."""
        adjustment, found = fit.adjustment, fit.state
        homographies = np.full((len(self.located), 3, 3), np.nan)
        homographies[self.located] = adjustment.homographies(found)
        residual_px = float(np.sqrt(np.mean(adjustment.residuals_px(found)[fit.kept] ** 2)))
        outliers = tuple(int(position) for position in self.positions[~fit.kept])
        assess = partial(adjustment.assess, found, fit.norms, fit.kept)
        rotations = found if isinstance(found, Rotations) else None
        left, freed = (self.layers, self.parallax), partial(_freed, self, model, fit)
        return GraphSolution(homographies, self.located, outliers, residual_px, assess, model, rotations, compare, *left, freed)

    def alone(self, model: MotionModel) -> GraphSolution:
        """Return the solution of a single node."""
        homographies = np.full((len(self.located), 3, 3), np.nan)
        homographies[self.anchor] = np.eye(3)
        rotations = None if model.kind != "rotation" else Rotations(np.eye(3)[None], model.camera(self.frame_shape))
        nothing = Assessment(np.full((1, 8, 8), np.nan), np.full(1, np.nan), np.zeros(0))
        return GraphSolution(homographies, self.located, (), 0.0, lambda: nothing, model, rotations)


def _tree(n_nodes: int, pairs: NDArray[np.integer], anchor: int) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Return the nodes that are tied to the anchor, each after its parent, and the (N,) parents: a tree of short edges.

    Errors along a path grow with its length. Two nodes that are next to each other therefore should have nearly the same path:
    over a long capture, branches drift so far from each other that a least-squares solution from there is lost.
    """
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    gaps = (pairs[:, 1] - pairs[:, 0]).astype(np.float64)
    # By squares of gaps, many short edges are nearer than one that skips the nodes in between.
    distances = np.asarray(dijkstra(adjacency(n_nodes, pairs, gaps**2), directed=False, indices=[anchor]))[0]
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    gaps = np.tile(gaps, 2)
    on_path = distances[ends[:, 0]] + gaps**2 == distances[ends[:, 1]]
    # Of parents that are equally near, the one farthest from the node: dense exposures, which skip their next neighbours, thus
    # hang on one chain, and form no second one beside it.
    kept = np.flatnonzero(on_path)[np.argsort(gaps[on_path], kind="stable")]
    parents = np.full(n_nodes, -1)
    parents[ends[kept, 1]] = ends[kept, 0]
    order = np.argsort(distances, kind="stable")
    return order[np.isfinite(distances[order])], parents


def _pairs(edges: Sequence[Edge]) -> NDArray[np.integer]:
    """Return the (moving, fixed) of the located edges: (E, 2)."""
    located = [(edge.moving, edge.fixed) for edge in edges if isinstance(edge.motion, Located)]
    return np.array(located, dtype=int).reshape(-1, 2)
