"""Robust least squares of a motion graph with the noise that its exposures share, and the uncertainty of its solution."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from photonpano.geometry import corners, from_parameters, generators, inverse, patch_centres, slopes, transform_points
from photonpano.robust import cauchy_weights
from photonpano.values import BoolArray, FloatArray, FrameSpan, Located

# Least weight of a pair. Shared photons carry no new information: their noise agrees with the motion known so far.
_LEAST_WEIGHT = 0.05
_LEAST = 1e-9  # eigenvalue of the information of an exposure, relative to its largest
MAX_ITERATIONS = 30
CONVERGED_PX = 1e-3  # largest motion of a corner in the last step
# Fall of the cost by the last step, in squares of standard deviations. The first step, with equal weights, is never the last.
NEGLIGIBLE = 1e-3
MAX_HALVINGS = 8  # of a step that raises the cost
NO_WORSE = 1e-6  # relative increase of the cost by rounding errors
# Tuning constant of the Cauchy weights, in scales of the residuals: 95 % efficiency for Gaussian noise.
CAUCHY = 2.385
OUTLIER = 8.0  # residual of an outlier, in scales of the residuals
MEDIAN_NORM = 0.958  # the median of the root mean square of eight Gaussian numbers of unit variance
# Unknowns of a singular system are damped by this share of the system; a floor on numbers that are divided by.
_DAMPING, _TINY = 1e-10, 1e-200
SAMPLES = 64  # solutions drawn to estimate the expected error of each node, to a few per cent
# Error of the corners that all pairs have in common: interpolation bends them so that focal lengths of 4,464 px are 1 to 5 %
# too small.
_COMMON_PX = 0.003
_UNKNOWN_NORM = 1e-3 * MEDIAN_NORM  # least scale of the residuals of edges that say nothing of their errors

StateT = TypeVar("StateT")
SelfT = TypeVar("SelfT")
FoundT = TypeVar("FoundT")


def remembered(method: Callable[[SelfT, StateT], FoundT]) -> Callable[[SelfT, StateT], FoundT]:
    """Have a method remember what it found for the last state, which is stepped to, linearised and compared."""
    name = f"_last_{method.__name__}"

    @wraps(method)
    def found(self: SelfT, state: StateT) -> FoundT:
        last: tuple[StateT, FoundT] | None = getattr(self, name, None)
        if last is None or last[0] is not state:
            last = state, method(self, state)
            setattr(self, name, last)
        return last[1]

    return found


@dataclass(frozen=True, slots=True, eq=False)
class ExposureNoise:
    """How the exposures of a graph share the noise of their photons.

    A pair errs by the noise of its two exposures, and by what it adds since it sees only the part of the scene that both show.
    """

    pairs: NDArray[np.integer]  # (E, 2) the moving and the fixed exposure of each pair
    # (N, C) shares of N exposures in the noise of C spans of frames, between whose ends no exposure begins or ends; their
    # squares add up to 1
    shares: FloatArray
    # (E,) weights with which pairs count the photons of each exposure once, however many of them it is in, and however many
    # exposures hold its frames
    weights: FloatArray
    shown: BoolArray  # (E,) False for pairs that no exposures show: each errs by itself

    @classmethod
    def of(cls, pairs: NDArray[np.integer], spans: Sequence[FrameSpan], shown: BoolArray | None = None) -> ExposureNoise:
        """Compute what N exposures share from the frames of each; without `shown`, exposures show all pairs."""
        shown = np.ones(len(pairs), dtype=bool) if shown is None else shown
        bounds = np.array([(span.start, span.stop) for span in spans], dtype=np.float64)
        ends = np.unique(bounds)
        inside = (bounds[:, :1] <= ends[:-1]) & (ends[1:] <= bounds[:, 1:])
        shares = np.sqrt(inside * np.diff(ends))
        shares /= np.linalg.norm(shares, axis=1, keepdims=True)
        (starts, stops), (moving, fixed) = bounds.T, pairs.T
        common = np.minimum(stops[moving], stops[fixed]) - np.maximum(starts[moving], starts[fixed])
        shared = np.maximum(common, 0) / np.minimum((stops - starts)[moving], (stops - starts)[fixed])
        # The correlations of each exposure with all others, at low frequencies of the motion, add up.
        repeated = shares @ shares.sum(axis=0)
        degrees = np.bincount(pairs[shown].ravel(), minlength=len(spans))
        counted = (degrees[moving] + degrees[fixed]) / 4 * np.sqrt(repeated[moving] * repeated[fixed])
        weights = np.where(shown, np.maximum(1 - shared, _LEAST_WEIGHT) / np.maximum(counted, 1), 1.0)
        return cls(pairs, shares, weights, shown)

    def errors(self, moving: FloatArray, fixed: FloatArray, n_draws: int, rng: np.random.Generator) -> FloatArray:
        """Draw errors of pairs, in units in which their covariance is the identity if they share nothing: (E, 8, n_draws).

        `moving` and `fixed` are the derivatives of the residuals of each pair, in these units, by small motions of its frames:
        (E, 8, 8).
        """
        moving, fixed = (np.where(self.shown[:, None, None], slopes, 0) for slopes in (moving, fixed))
        roots = self._roots(moving, fixed)
        chunks = rng.normal(size=(self.shares.shape[1], 8 * n_draws))
        noise = roots @ (self.shares @ chunks).reshape(len(roots), 8, n_draws)
        known = [slopes @ roots[nodes] for slopes, nodes in ((moving, self.pairs[:, 0]), (fixed, self.pairs[:, 1]))]
        beside = np.eye(8) - sum(each @ np.swapaxes(each, 1, 2) for each in known)
        values, vectors = np.linalg.eigh(beside)
        own = (vectors * np.sqrt(np.maximum(values, 0))[:, None]) @ rng.normal(size=(len(moving), 8, n_draws))
        return np.asarray(moving @ noise[self.pairs[:, 0]] + fixed @ noise[self.pairs[:, 1]] + own)

    def _roots(self, moving: FloatArray, fixed: FloatArray) -> FloatArray:
        """Return roots of the covariances of the noise of the exposures: (N, 8, 8).

        Half of the variance of a pair comes from each exposure. An exposure knows its motion at least as well as any of its
        pairs shows it, in each direction.
        """
        nodes = np.concatenate([self.pairs[:, 0], self.pairs[:, 1]])
        slopes = np.concatenate([moving, fixed])
        of_pairs = 2 * np.swapaxes(slopes, 1, 2) @ slopes
        order = np.lexsort([-np.trace(of_pairs, axis1=1, axis2=2), nodes])
        rank = np.arange(len(nodes)) - np.searchsorted(nodes[order], nodes[order])
        information = np.broadcast_to(np.finfo(float).tiny * np.eye(8), (len(self.shares), 8, 8)).copy()
        information[nodes[order[rank == 0]]] = of_pairs[order[rank == 0]]
        for number in range(1, int(rank.max(initial=0)) + 1):
            here = order[rank == number]
            root, back = _symmetric_roots(information[nodes[here]])
            values, vectors = np.linalg.eigh(back @ of_pairs[here] @ back)
            more = root @ vectors
            information[nodes[here]] += (more * np.maximum(values - 1, 0)[:, None]) @ np.swapaxes(more, 1, 2)
        return _symmetric_roots(information)[1]


def _symmetric_roots(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the symmetric roots of (N, 8, 8) information, and of its inverse."""
    values, vectors = np.linalg.eigh(information)
    roots = np.sqrt(np.maximum(values, np.maximum(_LEAST * values[:, -1:], np.finfo(float).tiny)))
    back = np.swapaxes(vectors, 1, 2)
    return (vectors * roots[:, None]) @ back, (vectors / roots[:, None]) @ back


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """How well a graph determines its unknowns."""

    # (N, k, k) inverse covariances of the motion of each node while the others are held: of p1..p8 of its homography, or of a
    # rotation vector in its own frame. NaN for a single node.
    information: FloatArray
    errors_px: FloatArray  # (N, 8, S) drawn errors of the corners of each node, after the best alignment of the planes
    shared_px: FloatArray  # (N, 8, S) the part of these errors that comes with those of unknowns that all nodes share
    # (5,) expected errors of the camera that all nodes share: of its focal length in px, and of k1, k2, p1 and p2. They are 0
    # for what is given; () without a camera.
    std_camera: FloatArray

    @property
    def std_px(self) -> FloatArray:
        """The expected error of the corners of each node: (N,)."""
        return std_of(self.errors_px)


def std_of(errors_px: FloatArray) -> FloatArray:
    """Return the expected error of the corners of each node, (N,), from errors that were drawn: (N, 8, S)."""
    return np.asarray(np.sqrt((errors_px**2).mean(axis=(1, 2)) * 2))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Problem:
    """A connected graph whose nodes are to be found."""

    pairs: NDArray[np.integer]  # (E, 2) the moving and the fixed node of each edge
    anchor: int  # the node that does not change
    motions: Sequence[Located]  # the motions of the edges, with their information
    frame_shape: tuple[int, int]  # (height, width) of a frame
    instants: FloatArray  # (N,) of the nodes, in frames, in order
    spans: Sequence[FrameSpan]  # the frames of each node
    shown: BoolArray | None = None  # (E,) whether exposures show an edge, so that it has a part in their noise; None for all

    @property
    def observed(self) -> FloatArray:
        """The homographies of the edges: (E, 3, 3), pixels of the moving frame to pixels of the fixed one."""
        return np.array([motion.homography for motion in self.motions])


class Prior(NamedTuple):
    """What is known of the unknowns beside the edges: m residuals that are normally distributed."""

    residuals: FloatArray  # (m,) of unit variance
    slopes: sparse.csr_array  # (m, k N + s) their derivatives
    log_variances: float = 0.0  # sum of the logarithms of their variances before they were scaled


class Adjustment(ABC, Generic[StateT]):
    """The least-squares problem of a connected graph.

    Each node has k unknowns, which move it a little in its own frame; all nodes may share some more. Unknowns have about unit
    size: a change by one moves the ends of a frame by about half its side, wherever the frame lies.

    Subclasses define the state, such as the homographies of the nodes, and its change by a step.
    """

    def __init__(self, problem: Problem, n_shared: int = 0) -> None:
        """Set up the problem; all nodes share `n_shared` unknowns."""
        self._moving, self._fixed = problem.pairs.T
        self._anchor = problem.anchor
        self._n_nodes = int(problem.pairs.max()) + 1
        self._n_shared = n_shared
        self._frame_shape = problem.frame_shape
        self._half = max(problem.frame_shape) / 2
        self._corners = corners(problem.frame_shape)
        self._rows = np.concatenate([self._corners, np.ones((4, 1))], axis=1).T
        self._targets = transform_points(problem.observed, self._corners)
        self._whitening = _whitening(problem.motions, self._rows)
        self._motions = problem.motions
        self._noise_norm: float | None = None
        self._informed = any(each.information is not None or each.residual_px for each in problem.motions)
        self._noise = ExposureNoise.of(problem.pairs, problem.spans, problem.shown)

    @abstractmethod
    def of(self, problem: Problem) -> Adjustment[StateT]:
        """Return the same for other pairs of the nodes, with what was learnt from these."""

    @abstractmethod
    def homographies(self, state: StateT) -> FloatArray:
        """Return the maps from pixels of each node's frame to those of the anchor's: (N, 3, 3)."""

    @abstractmethod
    def changed(self, state: StateT, nodes: FloatArray, shared: FloatArray) -> StateT:
        """Return the state after a step: (N, k) changes of the nodes, and (s,) of what they share."""

    def anchored(self, state: StateT) -> StateT:
        """Return the state without rounding errors of the anchor."""
        return state

    @abstractmethod
    def generators(self, state: StateT) -> FloatArray:
        """Return the derivatives of the small motion of a frame by the unknowns of its node: (k, 3, 3)."""

    @abstractmethod
    def information(self, state: StateT, blocks: FloatArray) -> FloatArray:
        """Convert (N, k, k) information on the unknowns of each node to what `Assessment` holds."""

    def shared_slopes(self, state: StateT) -> FloatArray:
        """Return the derivatives of the corners that each edge maps by the shared unknowns: (E, 8, s)."""
        del state
        return np.zeros((len(self._moving), 8, self._n_shared))

    def shared_errors(self, state: StateT) -> FloatArray:
        """Return the derivatives of the corners of each node's frame by the shared unknowns: (N, 8, s)."""
        del state
        return np.zeros((self._n_nodes, 8, self._n_shared))

    def prior(self, state: StateT) -> Prior:
        """Return what is known of the unknowns beside the edges."""
        del state
        return Prior(np.zeros(0), sparse.csr_array((0, self._n_node * self._n_nodes + self._n_shared)))

    def learn(self, state: StateT, weights: FloatArray) -> bool:
        """Estimate the variances of the prior from edges of these weights, (E,), and return whether they changed."""
        del state, weights
        return False

    def narrowed(self, state: StateT) -> tuple[Adjustment[StateT], StateT]:
        """Return the problem without unknowns that are known to be 0, and the nearest state that it holds."""
        return self, state

    @property
    def n_hyperparameters(self) -> int:
        """How many variances of the prior were estimated."""
        return 0

    def std_camera(self, state: StateT, shared: FloatArray) -> FloatArray:
        """Return what `Assessment` holds of a camera, given (s, S) draws of errors of the shared unknowns."""
        del state, shared
        return np.zeros(0)

    def relative(self, state: StateT) -> FloatArray:
        """Return the homography that a state expects of each edge: (E, 3, 3)."""
        homographies = self.homographies(state)
        return np.linalg.solve(homographies[self._fixed], homographies[self._moving])

    def minimise(
        self, state: StateT, kept: BoolArray, weights: FloatArray | None = None, iterations: int = MAX_ITERATIONS
    ) -> tuple[StateT, FloatArray]:
        """Return the state of least cost, and the norm of the whitened residual of each edge, (E,); outliers are not `kept`.

        `weights` (E,) are those of the start, equal ones if it may fit half of the edges exactly: robust weights would reject
        the others.
        """
        weights = kept * self._noise.weights if weights is None else weights
        for iteration in range(iterations):
            jacobians, residuals = self._linearised(state, weights)
            free, gradient = self._free(state), jacobians.T @ residuals
            step = np.zeros(len(free))
            step[free] = -_solved((jacobians.T @ jacobians)[free][:, free], gradient[free])
            stepped = self._stepped(state, step, weights, float(residuals @ residuals))
            if stepped is None:
                break
            state, norms = stepped
            weights = self.weights(norms, kept)
            negligible = iteration > 0 and -step @ gradient < NEGLIGIBLE
            if negligible or np.abs(step).max() * self._half < CONVERGED_PX:
                break
        state = self.anchored(state)
        return state, self._norms(state)

    def inliers(self, norms: FloatArray) -> BoolArray:
        """Return which edges are no outliers, from the norms of their whitened residuals: (E,)."""
        return np.asarray(norms <= OUTLIER * self._residual_scale(norms, np.ones(len(norms), dtype=bool)))

    def residuals_px(self, state: StateT) -> FloatArray:
        """Return the root mean square residual at the corners, for each edge: (E,) in px."""
        return np.asarray(np.sqrt(np.mean(np.sum(self._residuals(state) ** 2, axis=-1), axis=-1)))

    @property
    def unknowns(self) -> int:
        """How many numbers are to be found."""
        return self._n_node * (self._n_nodes - 1) + self._n_shared

    @property
    def price(self) -> float:
        """By how much a shared number must lower the deviance: the logarithm of what was measured (Schwarz 1978)."""
        return float(np.log(8 * len(self._moving)))

    def chi2(self, norms: FloatArray, kept: BoolArray) -> float:
        """Return the mean square of the whitened residuals of the edges that are kept, given their (E,) norms."""
        return float((norms[kept] ** 2).mean())

    def deviance(self, state: StateT, weights: FloatArray) -> float:
        """Return minus twice the logarithm of the marginal likelihood of a solution, up to a constant that all models share.

        Unknowns are integrated out around it (Laplace), as if the problem were linear from there on: what another step would
        gain counts. Each variance that was estimated has its price. `weights` (E,) are the same for all models.
        """
        jacobians, residuals = self._linearised(state, weights)
        free = self._free(state)
        factors, gradient = factorised((jacobians.T @ jacobians)[free][:, free]), (jacobians.T @ residuals)[free]
        determinant = float(np.log(np.abs(factors.U.diagonal())).sum())
        known = self.prior(state).log_variances + self.n_hyperparameters * self.price
        return float(residuals @ residuals - gradient @ factors.solve(gradient)) + determinant + known

    def assess(self, state: StateT, norms: FloatArray, kept: BoolArray) -> Assessment:
        """Return the information on each node while the others are held, and the expected error of its corners.

        The error is that of solutions for drawn noise of the exposures, each aligned with the best one as an evaluation aligns
        planes. An edge with a lower robust weight errs by as much more.
        """
        weights = self.weights(norms, kept)
        jacobians, _ = self._linearised(state, weights)
        normal, free = jacobians.T @ jacobians, self._free(state)
        k, n_edges = self._n_node, len(weights)
        blocks = np.stack([normal[k * node : k * node + k, k * node : k * node + k].toarray() for node in range(self._n_nodes)])
        rng, changes = np.random.default_rng(0), np.zeros((len(free), SAMPLES))
        moving, fixed = self._body_slopes(state)
        errors = np.sqrt(self._noise.weights)[:, None, None] * self._noise.errors(moving, fixed, SAMPLES, rng)
        right = jacobians[: 8 * n_edges].T @ errors.reshape(8 * n_edges, SAMPLES)
        below = jacobians[8 * n_edges :]
        right += below.T @ rng.normal(size=(below.shape[0], SAMPLES))
        changes[free] = _solved(normal[free][:, free], right[free], draws=True)
        changes += self._common_errors(normal, free, float(weights.sum()), rng)
        shared, errors_px = changes[k * self._n_nodes :], self._corner_errors_px(state, changes)
        shared_px = errors_px @ np.linalg.pinv(shared) @ shared if self._n_shared else np.zeros_like(errors_px)
        return Assessment(self.information(state, blocks), errors_px, shared_px, self.std_camera(state, shared))

    def _body_slopes(self, state: StateT) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of the whitened residual of each edge by small motions of both its frames: (E, 8, 8) each."""
        relative, moves = self.relative(state), generators(self._frame_shape)
        mapped = relative @ self._rows
        by_moving, by_fixed = relative[:, None] @ (moves @ self._rows), -moves @ mapped[:, None]
        return self._whitening @ slopes(mapped, by_moving), self._whitening @ slopes(mapped, by_fixed)

    def _common_errors(self, normal: sparse.csr_array, free: BoolArray, n_pairs: float, rng: np.random.Generator) -> FloatArray:
        """Draw errors of the shared unknowns that all pairs have in common, and how the nodes follow: (k N + s, S).

        Pairs, `n_pairs` by their weights, average out their noise, but not what interpolation does to all of them alike.
        """
        shared = np.arange(len(free))[len(free) - self._n_shared :]
        drawn = np.zeros((len(free), SAMPLES))
        if not len(shared):
            return drawn
        units = np.zeros((len(free), len(shared)))
        units[shared, np.arange(len(shared))] = 1
        covariances = np.zeros_like(units)
        covariances[free] = _solved(normal[free][:, free], units[free])
        noise_px = np.median(
            np.sqrt(np.trace(np.linalg.pinv(self._whitening @ self._whitening.transpose(0, 2, 1)), axis1=1, axis2=2) / 8)
        )
        times = np.sqrt(8 * n_pairs) * _COMMON_PX / max(float(noise_px), _COMMON_PX)
        values, vectors = np.linalg.eigh(covariances[shared])
        back = (vectors / np.sqrt(np.maximum(values, _TINY))) @ rng.normal(size=(len(shared), SAMPLES))
        return np.asarray(times * covariances @ back)

    @property
    @abstractmethod
    def _n_node(self) -> int:
        """Unknowns of a node."""

    def _stepped(self, state: StateT, step: FloatArray, weights: FloatArray, cost: float) -> tuple[StateT, FloatArray] | None:
        """Return the state after a step, halved until the cost falls, and the norms there; None if it never does.

        A chain of many frames is far from linear: the perspective of the first bends the path of all others.
        """
        n_nodes = self._n_node * self._n_nodes
        for _ in range(MAX_HALVINGS):
            # Too large a step may leave homographies that cannot be inverted.
            with suppress(ValueError, np.linalg.LinAlgError), np.errstate(all="ignore"):
                changed = self.changed(state, step[:n_nodes].reshape(self._n_nodes, -1), step[n_nodes:])
                norms = self._norms(changed)
                if 8 * weights @ norms**2 + float((self.prior(changed).residuals ** 2).sum()) <= cost * (1 + NO_WORSE):
                    return changed, norms
            step = step / 2
        return None

    def _free(self, state: StateT) -> BoolArray:
        """The unknowns of all nodes but the anchor, and those that are shared: (k N + s,)."""
        del state
        nodes = np.repeat(np.arange(self._n_nodes) != self._anchor, self._n_node)
        return np.concatenate([nodes, np.ones(self._n_shared, dtype=bool)])

    def _corner_errors_px(self, state: StateT, changes: FloatArray) -> FloatArray:
        """Return the displacements of corners by (k N + s, S) changes, after the best alignment of planes: (N, 8, S)."""
        homographies, k = self.homographies(state), self._n_node
        here = np.broadcast_to(self._rows, (self._n_nodes, 3, 4))
        to_corners = slopes(here, np.broadcast_to(self.generators(state) @ self._rows, (self._n_nodes, k, 3, 4)))
        # Derivatives of the corners of each frame with respect to a change of the plane.
        of_planes = generators(self._frame_shape)
        by_plane = inverse(homographies)[:, None] @ of_planes @ homographies[:, None] @ self._rows
        of_plane = slopes(here, by_plane).reshape(-1, 8)
        moved = to_corners @ changes[: k * self._n_nodes].reshape(self._n_nodes, k, -1)
        if self._n_shared:
            moved = moved + self.shared_errors(state) @ changes[k * self._n_nodes :]
        errors = moved.reshape(len(of_plane), -1)
        scale = np.linalg.norm(of_plane, axis=0)
        best = np.linalg.lstsq(of_plane / scale, errors, rcond=None)[0]
        remaining = errors - of_plane / scale @ best
        return np.asarray(remaining.reshape(self._n_nodes, 8, -1))

    def _residual_scale(self, norms: FloatArray, kept: BoolArray, least: float = MEDIAN_NORM) -> float:
        """Return the robust scale of the whitened residuals: at least that of unit variance, which the information predicts."""
        # Each node absorbs some of the residuals; the redundant ones determine the scale. The median alone would be too
        # small where robust weights make half of the edges fit exactly.
        n_edges = int(kept.sum())
        redundancy = n_edges - self.unknowns / 8
        scale = float(np.median(norms[kept])) * float(np.sqrt(n_edges / redundancy)) if redundancy > 0 else 0.0
        return max(scale, least)

    def weights(self, norms: FloatArray, kept: BoolArray) -> FloatArray:
        """Return the weights of the edges, (E,): robust (Cauchy), in units of their residuals; 0 if they are not kept."""
        robust = cauchy_weights(norms, self._residual_scale(norms, kept) * CAUCHY)
        robust *= (MEDIAN_NORM / (self._noise_norm or self._least_norm(norms, kept))) ** 2
        return np.asarray(np.where(kept, robust, 0.0) * self._noise.weights)

    def hold_noise(self, norms: FloatArray, kept: BoolArray) -> None:
        """Take the scale of the residuals for noise from now on: a prior that holds unknowns leaves more of them."""
        self._noise_norm = self._least_norm(norms, kept)

    def _least_norm(self, norms: FloatArray, kept: BoolArray) -> float:
        return self._residual_scale(norms, kept, MEDIAN_NORM if self._informed else _UNKNOWN_NORM)

    def mapped_corners(self, state: StateT) -> FloatArray:
        """Return where a state expects the corners that each edge maps: (E, 4, 2) px."""
        return transform_points(self.relative(state), self._corners)

    def beside(self, state: StateT) -> FloatArray:
        """Return where patches lie beside where they are expected: (E, P, 2) px; meaningless for those that show nothing."""
        points = patch_centres(self._frame_shape)
        expected = transform_points(self.relative(state), points) + self.shifted_patches(state)
        patches = [np.zeros((len(points), 2)) if each.patches is None else each.patches.shifts for each in self._motions]
        observed = np.array([each.homography for each in self._motions])
        return np.asarray(transform_points(observed, points) + np.array(patches) - expected)

    def shifted_patches(self, state: StateT) -> FloatArray | float:
        """Return how far patches lie from where the homographies of a state map them: (E, P, 2) px."""
        del state
        return 0.0

    def _residuals(self, state: StateT) -> FloatArray:
        return self.mapped_corners(state) - self._targets

    def _norms(self, state: StateT) -> FloatArray:
        whitened = np.einsum("eij,ej->ei", self._whitening, self._residuals(state).reshape(-1, 8))
        return np.asarray(np.linalg.norm(whitened, axis=1) / np.sqrt(8))

    def _linearised(self, state: StateT, weights: FloatArray) -> tuple[sparse.csr_array, FloatArray]:
        """Return the derivatives of the weighted residuals, (8 E + m, k N + s), and these: of edges, then of the prior."""
        jacobians, residuals = self._of_edges(state, weights)
        prior = self.prior(state)
        if not len(prior.residuals):
            return jacobians, residuals
        return sparse.csr_array(sparse.vstack([jacobians, prior.slopes])), np.concatenate([residuals, prior.residuals])

    def _of_edges(self, state: StateT, weights: FloatArray) -> tuple[sparse.csr_array, FloatArray]:
        """Return the weighted derivatives of the residuals of the edges, (8 E, k N + s), and these residuals, (8 E,)."""
        relative, moves, k = self.relative(state), self.generators(state), self._n_node
        mapped = relative @ self._rows
        d_moving = relative[:, None] @ (moves @ self._rows)
        d_fixed = -moves @ mapped[:, None]
        root = np.sqrt(weights)[:, None, None] * self._whitening
        n_edges = len(weights)
        # Each residual depends on the unknowns of both nodes of its edge alone, and on the shared ones.
        entries = np.concatenate([root @ slopes(mapped, d) for d in (d_moving, d_fixed)], axis=2)
        unknowns = (k * np.stack([self._moving, self._fixed], axis=1)[..., None] + np.arange(k)).reshape(n_edges, 1, 2 * k)
        columns = np.broadcast_to(unknowns, entries.shape).astype(np.int32)
        starts = np.arange(0, entries.size + 1, 2 * k, dtype=np.int32)
        residuals = np.einsum("eij,ej->ei", root, self._residuals(state).reshape(-1, 8)).ravel()
        shape = 8 * n_edges, k * self._n_nodes
        jacobians = sparse.csr_array((entries.ravel(), columns.ravel(), starts), shape=shape)
        if not self._n_shared:
            return jacobians, residuals
        of_shared = sparse.csr_array((root @ self.shared_slopes(state)).reshape(8 * n_edges, -1))
        return sparse.csr_array(sparse.hstack([jacobians, of_shared])), residuals

    def _of_shared(self, values: FloatArray) -> sparse.csr_array:
        """Return (m, s) derivatives by the shared unknowns as those by all: (m, k N + s)."""
        beside = sparse.csr_array((len(values), self._n_node * self._n_nodes))
        return sparse.csr_array(sparse.hstack([beside, sparse.csr_array(values)])) if self._n_shared else beside


def _solved(normal: sparse.csr_array, right: FloatArray, draws: bool = False) -> FloatArray:
    """Solve a positive semidefinite system (N, N) for (N,) or (N, S) right sides; the ordering keeps the factors sparse.

    Unknowns that nothing determines stay where they are: a singular system is damped. If the right sides are `draws` with
    `normal` as their covariance, such unknowns get draws as wide as the damping.
    """
    with suppress(RuntimeError), np.errstate(all="ignore"):
        solution = factorised(normal).solve(right)
        if np.isfinite(solution).all():
            return np.asarray(solution)
    diagonal = normal.diagonal()
    damping = _DAMPING * np.maximum(diagonal, _DAMPING * diagonal.max(initial=_TINY))
    if draws:
        right = right + np.sqrt(damping)[:, None] * np.random.default_rng(1).normal(size=right.shape)
    return np.asarray(factorised(normal + sparse.diags_array(damping)).solve(right))


def factorised(normal: sparse.csr_array) -> SuperLU:
    """Factorise a symmetric system; the ordering keeps the factors sparse. A `RuntimeError` if it is exactly singular."""
    return splu(
        normal.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True, "Equil": False}
    )


def _roots(information: FloatArray) -> FloatArray:
    """Return maps from errors of p1..p8 to errors of unit variance, (E, 8, 8): roots R of the information R' R.

    In units of the standard deviations of each parameter, rounding errors are small; nearly singular information, which still
    is not positive definite, has its smallest eigenvalues raised.
    """
    try:
        return np.asarray(np.linalg.cholesky(information).transpose(0, 2, 1))
    except np.linalg.LinAlgError:
        units = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), _TINY))
        values, vectors = np.linalg.eigh(information / (units[:, :, None] * units[:, None, :]))
        return np.asarray(np.sqrt(np.maximum(values, _DAMPING))[..., None] * vectors.transpose(0, 2, 1) * units[:, None, :])


def _whitening(motions: Sequence[Located], rows: FloatArray) -> FloatArray:
    """Return the maps from residuals at the corners, (3, 4) in homogeneous px, to residuals of unit variance: (E, 8, 8)."""
    whitening = np.array([np.eye(8) / max(motion.residual_px or 1.0, 1e-3) for motion in motions])
    informed = [index for index, motion in enumerate(motions) if motion.information is not None]
    if informed:
        information = np.array([motions[index].information for index in informed])
        mapped = np.array([motions[index].homography for index in informed]) @ rows
        changes = (from_parameters(np.eye(8)) - np.eye(3)) @ rows
        to_corners = slopes(mapped, np.broadcast_to(changes, (len(informed), *changes.shape)))
        whitening[informed] = _roots(information) @ np.linalg.inv(to_corners)
    return whitening
