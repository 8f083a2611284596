"""The motion graph: exposures are nodes, pairwise motions are edges; it is solved for one homography a node."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from photonpano.geometry import (
    Camera,
    align_planes,
    corner_displacements,
    corners,
    inverse,
    lenses_apart_px,
    likely_rotations,
    patch_centres,
    scaled_ahead,
    transform_points,
)
from photonpano.motion.adjustment import Adjustment, Assessment, Problem
from photonpano.motion.models import (
    HOMOGRAPHIES,
    SAME_LENS_PX,
    MotionModel,
    agreed_share,
    agreeing,
    contradicting,
    layers,
    tolerances_px,
    travelled,
)
from photonpano.motion.pairs import GYROSCOPE, TIE, adjacency, component_labels, instants_of
from photonpano.motion.planar import PlanarAdjustment, PlanarName, Plane, nearest
from photonpano.motion.rotations import RotationAdjustment, Rotations
from photonpano.values import BoolArray, Edge, FloatArray, FrameSpan, Group, Located

# Share of the patches that contradict the motion, above which they are told from the background.
_CONTRADICTED = 0.005
_HELD = 3.0  # expected errors by which k1 may differ from what is given, to be held while the focal length is free
_FEWEST_NODES = 12  # of which pairs tell what is the background over time
_TRIED = 2  # steps towards a lens that show whether it is likelier: its numbers grow with the focal length
_CLEAR = 6.0  # deviance by which one model is likelier than another beyond doubt, a ratio of likelihoods of 20
_BY_CHANCE = 0.05  # share of drawn errors that roll as much as a path whose roll may be noise
_LEARNT = 3  # times that the variances of the prior are estimated, each along the motion by those before


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
        """A file of points that are tied by hand, see `photonpano.motion.pairs`; None if there are none."""

    @property
    def disconnected(self) -> Literal["error", "largest"]:
        """Whether a graph that falls apart is an error, or its largest part is used."""


class Freed(NamedTuple):
    """What edges show of the camera where a number that is given is free."""

    number: int  # which: 0 for the focal length in px, 1 for k1
    given: float
    found: float
    std: float  # expected error of what was found


class Rival(NamedTuple):
    """How well a model of the motion explains the pairs of a level."""

    chi2: float  # mean square of their whitened residuals, in which pairs that share photons have a part of their noise only
    unknowns: int
    deviance: float  # minus twice the logarithm of its marginal likelihood, above that of the likeliest model
    apart_px: float = 0.0  # mean distance of the corners by it from those by the model that was taken, after the best alignment


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
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
    model: MotionModel = HOMOGRAPHIES  # of these homographies: the likelier one of "auto"
    rotations: Rotations | None = None  # of the L located nodes, and their camera; None for homographies
    # how far what homographies do beyond shift and roll moves the ends of a frame over the capture, px; none that are 0
    walks_px: Mapping[str, float] = field(default_factory=dict)
    # focal length of a camera that turns and travels: perspective of its homographies follows the shift. None for all others
    turning_px: float | None = None
    # returns how well rival models explain the edges, by their names; homographies beside others take as long as the graph
    compare: Callable[[], Mapping[str, Rival]] = dict
    # (N, P) how far patches of each node lie from where the motion lets expect them, as mean squares in variances, 1 for noise;
    # 0 where nothing is known, and None where patches do not contradict the motion
    layers: FloatArray | None = None
    # way of the camera over the distance of what is near, by which that passes the background; 0 unless what is near rests
    parallax: float = 0.0
    # returns what of a given camera the edges contradict most; None where nothing is given, and for homographies
    freed: Callable[[], Freed | None] = lambda: None
    # returns the solution without roll; None unless all that homographies do beside shifts is roll
    without_roll: Callable[[], GraphSolution] | None = None

    def rolls_by_chance(self, errors_px: FloatArray, frame_shape: tuple[int, int]) -> bool:
        """Return whether noise rolls homographies as much, from each to the next, and from means of 2, 4, ... to the next ones.

        `errors_px` (L, 8, S) are those of the assessment: at each of these scales, one in twenty of them must roll as much.
        """
        frame = corners(frame_shape)
        away = frame - frame.mean(axis=0)
        across = (np.stack([-away[:, 1], away[:, 0]], axis=-1) / (away**2).sum()).ravel()
        homographies = self.homographies[self.located]
        found = np.unwrap(np.arctan2(homographies[:, 1, 0], homographies[:, 0, 0]))
        rolls = np.column_stack([found, np.einsum("c,ncs->ns", across, errors_px)])
        while len(rolls) > 2:
            sizes = (np.diff(rolls, axis=0) ** 2).mean(axis=0)
            if np.mean(sizes[1:] >= sizes[0]) < _BY_CHANCE:
                return False
            rolls = rolls[: len(rolls) // 2 * 2].reshape(-1, 2, rolls.shape[1]).mean(axis=1)
        return True


def components(n_nodes: int, edges: Sequence[Edge]) -> NDArray[np.integer]:
    """Number the connected components of the located edges, the largest first: (N,)."""
    labels = component_labels(n_nodes, _pairs(edges))
    by_size = np.argsort(-np.bincount(labels), kind="stable")
    return np.asarray(np.argsort(by_size)[labels])


def solve(
    nodes: Sequence[Group],
    edges: Sequence[Edge],
    anchor: int,
    *,
    frame_shape: tuple[int, int],
    start: FloatArray | None = None,
    model: MotionModel = HOMOGRAPHIES,
) -> GraphSolution:
    """Solve the graph: find the motions with the least residuals of all located edges; that of the anchor is the identity.

    Robust least squares on the corners that each edge maps, weighted by the edge's information where it has one; Gauss-Newton
    with Cauchy weights, from a tree of edges between near exposures unless a start is given: (N, 3, 3) homographies to any
    plane. Outliers are dropped, unless the graph would fall apart, and it is solved again. With the model "auto", rotations of
    one camera are taken if their marginal likelihood is higher than that of homographies.
    """
    tied = _Tied.of(nodes, edges, anchor, frame_shape)
    if not len(tied.motions):
        return tied.alone(model)
    fits = _rivals(tied, start, model)
    tied, fits, chosen = _of_background(tied, start, fits, _chosen(fits, tied))
    return tied.solution(fits[chosen], chosen, cache(partial(_compared, tied, start, fits, chosen)))


def _rivals(tied: _Tied, start: FloatArray | None, model: MotionModel) -> dict[MotionModel, _Fit]:
    """Fit a model; for "auto", homographies, and rotations if perspective follows the shift."""
    if not model.has_rivals:
        return {model: _fitted(tied, start, model)}
    fits: dict[MotionModel, _Fit] = {}
    # No plane holds all frames of a camera that turns far.
    with suppress(ValueError, np.linalg.LinAlgError, RuntimeError), np.errstate(all="ignore"):
        free = _planar(tied, start, "homography") if model.kind == "auto" else None
        if free is not None and _in_front(free.homographies, tied.frame_shape):
            assert isinstance(free.adjustment, PlanarAdjustment)
            # Where all that is left of homographies is that perspective follows the shift, they are rotations.
            still = free.adjustment.is_coupled and not free.adjustment.walks_px
            plane = replace(model, kind="homography")
            fits[plane] = _planar(tied, start, "euclidean") if still else _nearer(tied, start, free)
            if not free.adjustment.is_coupled:
                return fits
    turned: _Fit | None = None
    for rotation in model.rotations:
        if not fits:
            fits[rotation] = turned = _fitted(tied, start, rotation)
            continue
        with suppress(ValueError, np.linalg.LinAlgError, RuntimeError), np.errstate(all="ignore"):
            fits[rotation] = _fitted(tied, start, rotation) if turned is None else tied.stepped(rotation, turned)
            turned = fits[rotation]
    return fits


def _chosen(fits: dict[MotionModel, _Fit], tied: _Tied) -> MotionModel:
    """Return the likeliest model, whose fit has converged; that of others, which a few steps do not make likelier, need not."""
    chosen = _likeliest(fits, tied.frame_shape)
    while fits[chosen].start is not None:
        fits[chosen] = tied.fit(fits[chosen].adjustment, fits[chosen].start)
        chosen = _likeliest(fits, tied.frame_shape)
    return chosen


def _in_front(homographies: FloatArray, frame_shape: tuple[int, int]) -> bool:
    """Return whether one plane holds all frames."""
    depths = homographies[:, 2:, :2] @ corners(frame_shape).T + homographies[:, 2:, 2:]
    return bool((depths > 0).all())


def _of_background(
    tied: _Tied, start: FloatArray | None, fits: dict[MotionModel, _Fit], likeliest: MotionModel
) -> tuple[_Tied, dict[MotionModel, _Fit], MotionModel]:
    """Have pairs follow the patches that agree with one motion, if others contradict it: what moves by itself, or is near.

    Returns the pairs by these patches, all models fitted to them, and the likeliest one.
    """
    if len(tied.order) < _FEWEST_NODES:
        return tied, fits, likeliest
    contradicted = contradicting(tied.motions, fits[likeliest].adjustment.beside(fits[likeliest].state)) >= _CONTRADICTED
    if not (likeliest.layered or contradicted):
        return tied, fits, likeliest
    # A richer model may follow what is near, too, but then fits neither part: most patches agree with the right one.
    # What a narrow planar model cannot follow need not move by itself: homographies tell.
    turning = {model: fit for model, fit in fits.items() if model.kind == "rotation"}
    telling = fits if turning else _with_homographies(tied, start, fits)
    planar = [model for model in telling if model.kind == "homography"]
    rivals = dict.fromkeys([likeliest, _likeliest(turning, tied.frame_shape)] if turning else planar)
    selected = {model: agreed for model in rivals if (agreed := _agreed(tied, model, telling[model]))}
    if not selected:
        return tied, fits, likeliest
    model = max(selected, key=lambda each: selected[each].share)
    first, (background, fit, _) = telling[model].adjustment, selected[model]
    found = layers(tied.pairs, tied.motions, first.beside(fit.state), len(tied.located))
    background = replace(background, layers=found)
    if isinstance(fit.state, Rotations):
        camera, seen = fit.state.camera, np.array([each.homography for each in tied.motions])
        places = (transform_points(seen, patch_centres(tied.frame_shape)) - camera.centre_px) / camera.focal_px
        way_px = travelled(tied.pairs, tied.motions, first.beside(fit.state), found, places)
        background = replace(background, parallax=way_px / camera.focal_px)
    others = [each for each in fits if each is not model]
    fits = {each: _fitted(background, start, each) for each in others} | ({model: fit} if model in fits else {})
    return background, fits, _likeliest(fits, tied.frame_shape)


class _Agreed(NamedTuple):
    """What patches of pairs agree on."""

    tied: _Tied  # the pairs by these patches
    fit: _Fit  # of a model to them
    share: float  # of the patches that agree, by their weights


def _agreed(tied: _Tied, model: MotionModel, fit: _Fit) -> _Agreed | None:
    """Select the patches that agree with a model; None if too few do."""
    first, background, tolerances = fit.adjustment, tied, tolerances_px(tied.motions)
    for tolerance_px in tolerances:
        motions = agreeing(tied.motions, first.beside(fit.state), tolerance_px, tied.frame_shape)
        background = replace(tied, motions=motions)
        is_last = tolerance_px == tolerances[-1]
        try:
            adjustment = background.adjustment(model) if is_last else first.of(background.problem)
            fit = background.fit(adjustment, fit.state, learns=is_last)
        except (ValueError, np.linalg.LinAlgError):
            return None
    return _Agreed(background, fit, agreed_share(tied.motions, first.beside(fit.state), tolerances[-1]))


def _likeliest(fits: Mapping[MotionModel, _Fit], frame_shape: tuple[int, int]) -> MotionModel:
    """Return the likeliest model; a lens that is not asked for must move pixels enough to matter, and not fold the frame.

    Before the last level, it must be clear, too: the next level sees frames through it, and would run again without it.
    """
    deviances = _deviances(fits)
    if any(model.kind == "rotation" and not model.finds_lens for model in fits):
        for model in [each for each in fits if each.finds_lens]:
            camera: Camera = fits[model].state.camera
            if not lenses_apart_px(camera, Camera(camera.matrix), frame_shape) >= SAME_LENS_PX:
                del deviances[model]
            elif model.rough:
                deviances[model] += _CLEAR
    return min(deviances, key=deviances.__getitem__)


def _deviances(fits: Mapping[MotionModel, _Fit]) -> dict[MotionModel, float]:
    """Return the deviances of models for the edges with the weights that they have by the model with most unknowns."""
    if len(fits) == 1:
        return dict.fromkeys(fits, 0.0)
    weights = max(fits.values(), key=lambda fit: fit.adjustment.unknowns).weights
    return {model: fit.adjustment.deviance(fit.state, weights) for model, fit in fits.items()}


def _compared(tied: _Tied, start: FloatArray | None, fits: Mapping[MotionModel, _Fit], chosen: MotionModel) -> dict[str, Rival]:
    """Compare the models that were fitted, and homographies where one plane holds all frames."""
    fits, shape = _with_homographies(tied, start, fits), tied.frame_shape
    deviances, taken = _deviances(fits), fits[chosen].homographies
    least, rivals = min(deviances.values()), {}
    for model, fit in fits.items():
        beside = inverse(taken) @ align_planes(fit.homographies, taken, shape, np.eye(3)) @ fit.homographies
        apart_px = float(corner_displacements(beside, np.eye(3), shape).mean())
        chi2, unknowns = fit.adjustment.chi2(fit.norms, fit.kept), fit.adjustment.unknowns
        rivals[model.name] = Rival(chi2, unknowns, deviances[model] - least, apart_px)
    return rivals


def _with_homographies(tied: _Tied, start: FloatArray | None, fits: Mapping[MotionModel, _Fit]) -> dict[MotionModel, _Fit]:
    """Add homographies to the fits, unless they are among them, or no plane holds all frames."""
    if all(model.kind != "homography" for model in fits):
        with suppress(ValueError, np.linalg.LinAlgError, RuntimeError), np.errstate(all="ignore"):
            return {**fits, HOMOGRAPHIES: _fitted(tied, start, HOMOGRAPHIES)}
    return dict(fits)


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


def _fitted(tied: _Tied, start: FloatArray | None, model: MotionModel) -> _Fit:
    """Fit a model."""
    if model.kind != "rotation":
        fit = _planar(tied, start, model.planar)
        return _nearer(tied, start, fit) if model.planar == "homography" else fit
    shape, given = tied.frame_shape, tied.given(start)
    adjustment = RotationAdjustment(tied.problem, model.seen_by(shape), model.unknown)
    camera = model.camera(shape)
    if model.focal_px is None and model.known is None:
        camera = adjustment.likeliest_camera(camera)
    rotations = likely_rotations(camera, tied.problem.observed if given is None else given, shape)
    return tied.fit(adjustment, Rotations(tied.composed(rotations) if given is None else rotations, camera))


def _planar(tied: _Tied, start: FloatArray | None, model: PlanarName) -> _Fit:
    given = tied.given(start)
    found = nearest(model, tied.problem.observed if given is None else given, tied.frame_shape)
    adjustment = PlanarAdjustment(tied.problem, model)
    return tied.fit(adjustment, Plane(tied.composed(found) if given is None else found))


def _nearer(tied: _Tied, start: FloatArray | None, fit: _Fit) -> _Fit:
    """Return homographies, or shifts and rolls if those are likelier.

    Along a long chain, homographies without walks may be too far from those with walks to be found from there.
    """
    if fit.adjustment.unknowns <= 3 * len(tied.problem.instants):
        return fit
    return min((fit, _planar(tied, start, "euclidean")), key=lambda each: each.adjustment.deviance(each.state, fit.weights))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A solution of the graph."""

    adjustment: Adjustment[Any]
    state: Any  # of least cost
    norms: FloatArray  # (E,) of the whitened residuals
    kept: BoolArray  # (E,) False for outliers
    start: Any = None  # of a fit that has not converged: the state of a narrower model, from which a few steps led here

    @property
    def homographies(self) -> FloatArray:
        """The maps from the frame of each node to that of the anchor: (N, 3, 3)."""
        return self.adjustment.homographies(self.state)

    @property
    def weights(self) -> FloatArray:
        """The weights of the edges: (E,)."""
        return self.adjustment.weights(self.norms, self.kept)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Tied:
    """The part of a graph that is tied to its anchor."""

    located: BoolArray  # (N,) which nodes
    order: NDArray[np.integer]  # these nodes, the anchor first, each after its parent
    parents: NDArray[np.integer]  # (N,) of the nodes: a tree of short edges
    positions: NDArray[np.integer]  # (E,) of the located edges between them, in the list that is solved
    pairs: NDArray[np.integer]  # (E, 2) their nodes
    motions: Sequence[Located]  # their motions
    frame_shape: tuple[int, int]  # (height, width) of a frame
    instants: FloatArray  # (N,) of all nodes
    spans: Sequence[FrameSpan]  # their frames
    shown: BoolArray  # (E,) whether exposures show the edges
    layers: FloatArray | None = None  # see `GraphSolution`
    parallax: float = 0.0

    @classmethod
    def of(cls, nodes: Sequence[Group], edges: Sequence[Edge], anchor: int, frame_shape: tuple[int, int]) -> _Tied:
        """Find the edges that are tied to the anchor."""
        n_nodes = len(nodes)
        located_edges = [(position, edge) for position, edge in enumerate(edges) if isinstance(edge.motion, Located)]
        pairs = _pairs(edges)
        order, parents = _tree(n_nodes, pairs, anchor)
        located = np.zeros(n_nodes, dtype=bool)
        located[order] = True
        tied = [index for index, (moving, _) in enumerate(pairs) if located[moving]]
        positions = np.array([located_edges[index][0] for index in tied], dtype=int)
        motions = [motion for index in tied if isinstance(motion := located_edges[index][1].motion, Located)]
        spans = [group.span for group in nodes]
        shown = np.array([located_edges[index][1].locator not in (GYROSCOPE, TIE) for index in tied], dtype=bool)
        return cls(
            located=located,
            order=order,
            parents=parents,
            positions=positions,
            pairs=pairs[tied],
            motions=motions,
            frame_shape=frame_shape,
            instants=instants_of(nodes),
            spans=spans,
            shown=shown,
        )

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
        anchor = int(self.located[: self.anchor].sum())
        spans = [span for span, located in zip(self.spans, self.located, strict=True) if located]
        return Problem(
            pairs=self.compact_pairs,
            anchor=anchor,
            motions=self.motions,
            frame_shape=self.frame_shape,
            instants=self.instants[self.located],
            spans=spans,
            shown=self.shown,
        )

    def given(self, start: FloatArray | None) -> FloatArray | None:
        """Return the maps of the tied nodes to the anchor by a start: (L, 3, 3); None without one."""
        return None if start is None else inverse(start[self.anchor]) @ start[self.located]

    def adjustment(self, model: MotionModel) -> PlanarAdjustment | RotationAdjustment:
        """Return the least-squares problem of a model."""
        if model.kind == "rotation":
            return RotationAdjustment(self.problem, model.seen_by(self.frame_shape), model.unknown)
        return PlanarAdjustment(self.problem, model.planar)

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

    def fit(self, adjustment: Adjustment[Any], state: Any, *, learns: bool = True) -> _Fit:
        """Solve from a start; drop outliers, unless the graph would fall apart, and solve again.

        One that does not learn keeps the variances of its prior, and drops nothing: it is on the way to another.
        """
        kept = np.ones(len(self.motions), dtype=bool)
        found, norms = adjustment.minimise(state, kept)
        if not learns:
            return _Fit(adjustment, found, norms, kept)
        adjustment.hold_noise(norms, kept)
        adjustment, found, norms = self._learnt(adjustment, found, norms, kept)
        inliers = adjustment.inliers(norms)
        if not inliers.all() and not component_labels(len(self.order), self.compact_pairs[inliers]).any():
            kept = inliers
            adjustment, found, norms = self._learnt(adjustment, *adjustment.minimise(found, kept), kept)
        return _Fit(adjustment, found, norms, kept)

    def stepped(self, model: MotionModel, fit: _Fit) -> _Fit:
        """Return the fit of a model after a few steps from that of a narrower one."""
        adjustment = self.adjustment(model)
        state, norms = adjustment.minimise(fit.state, fit.kept, fit.weights, iterations=_TRIED)
        return _Fit(adjustment, state, norms, fit.kept, fit.state)

    def _learnt(
        self, adjustment: Adjustment[Any], found: Any, norms: FloatArray, kept: BoolArray
    ) -> tuple[Adjustment[Any], Any, FloatArray]:
        """Solve again with variances of the prior that the solution shows, and without unknowns that these hold at 0."""
        for _ in range(_LEARNT):
            if not adjustment.learn(found, adjustment.weights(norms, kept)):
                break
            adjustment, found = adjustment.narrowed(found)
            found, norms = adjustment.minimise(found, kept)
        return adjustment, found, norms

    def solution(self, fit: _Fit, model: MotionModel, compare: Callable[[], Mapping[str, Rival]]) -> GraphSolution:
        """Return a fit as the solution of the graph."""
        # Models were compared with the likeliest walks.
        if isinstance(fit.adjustment, PlanarAdjustment) and (wide := fit.adjustment.widened(fit.state, fit.weights)):
            fit = _Fit(wide, *wide.minimise(fit.state, fit.kept, fit.weights), fit.kept)
        adjustment, found = fit.adjustment, fit.state
        homographies = np.full((len(self.located), 3, 3), np.nan)
        homographies[self.located] = fit.homographies
        planar = adjustment if isinstance(adjustment, PlanarAdjustment) else None
        assess = adjustment.assess if planar is None or model.planar != "homography" else planar.assess_beside_turns
        return GraphSolution(
            homographies=homographies,
            located=self.located,
            outliers=tuple(int(position) for position in self.positions[~fit.kept]),
            residual_px=float(np.sqrt(np.mean(adjustment.residuals_px(found)[fit.kept] ** 2))),
            assess=partial(assess, found, fit.norms, fit.kept),
            model=model,
            rotations=found if isinstance(found, Rotations) else None,
            walks_px={} if planar is None else planar.walks_px,
            turning_px=None if planar is None else planar.turning_px(found),
            compare=compare,
            layers=self.layers,
            parallax=self.parallax,
            freed=partial(_freed, self, model, fit),
            without_roll=partial(self._without_roll, fit, model, compare) if planar is not None and planar.only_rolls else None,
        )

    def _without_roll(self, fit: _Fit, model: MotionModel, compare: Callable[[], Mapping[str, Rival]]) -> GraphSolution:
        """Return the solution of shifts alone, by the same pairs; the model is that of the fit, in which roll is none."""
        assert isinstance(fit.adjustment, PlanarAdjustment)
        adjustment = fit.adjustment.of(self.problem, "translation")
        state, norms = adjustment.minimise(Plane(nearest("translation", fit.homographies, self.frame_shape)), fit.kept)
        return self.solution(_Fit(adjustment, state, norms, fit.kept), model, compare)

    def alone(self, model: MotionModel) -> GraphSolution:
        """Return the solution of a single node."""
        homographies = np.full((len(self.located), 3, 3), np.nan)
        homographies[self.anchor] = np.eye(3)
        rotations = None if model.kind != "rotation" else Rotations(np.eye(3)[None], model.camera(self.frame_shape))
        unknown = np.full((1, 8, 1), np.nan)
        nothing = Assessment(np.full((1, 8, 8), np.nan), unknown, unknown, np.zeros(0))
        return GraphSolution(
            homographies=homographies,
            located=self.located,
            outliers=(),
            residual_px=0.0,
            assess=lambda: nothing,
            model=model,
            rotations=rotations,
        )


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
