"""Robust least squares of a motion graph, and the uncertainty of its solution."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from photonpano.geometry import (
    apply,
    corners,
    from_parameters,
    generators,
    inverse,
    normalised,
    parameters,
    slopes,
    unit_coordinates,
)
from photonpano.values import BoolArray, FloatArray, Located

MAX_ITERATIONS = 30
CONVERGED_PX = 1e-3
"""A step that moves no corner by more than about this has converged."""
MAX_HALVINGS = 8
"""A step that raises the cost is halved up to this many times."""
NO_WORSE = 1e-6
"""Rounding errors may raise the cost by this share."""
CAUCHY = 2.385
"""Tuning constant of the Cauchy weights: a residual of this many scales weighs half (95 % efficiency for Gaussian noise)."""
OUTLIER = 8.0
"""An edge whose residual exceeds this many scales is an outlier."""
MEDIAN_NORM = 0.958
"""The median of the root mean square of eight Gaussian numbers of unit variance."""
_DAMPING, _TINY = 1e-10, 1e-200
"""Unknowns of a singular system are damped by this share of the system; a floor on numbers that are divided by."""
SAMPLES = 64
"""Solutions drawn to estimate the expected error of each node, to a few per cent."""


class Adjustment:
    """The least-squares problem of a connected graph.

    The unknowns of a node are p1..p8 of a small homography of its own frame, in coordinates of about unit size, so that their
    meaning does not depend on where the frame lies.
    """

    def __init__(
        self,
        pairs: NDArray[np.integer],
        anchor: int,
        observed: FloatArray,
        motions: Sequence[Located],
        frame_shape: tuple[int, int],
    ) -> None:
        """Set up the problem.

        Args:
            pairs: (E, 2) the moving and the fixed node of each edge.
            anchor: the node that does not change.
            observed: (E, 3, 3) homographies of the edges, pixels of the moving frame to pixels of the fixed one.
            motions: the motions of the edges, with their information.
            frame_shape: (height, width) of a frame.
        """
        self._moving, self._fixed = pairs.T
        self._anchor = anchor
        self._n_nodes = int(pairs.max()) + 1
        self._corners = corners(frame_shape)
        self._rows = np.concatenate([self._corners, np.ones((4, 1))], axis=1).T
        self._targets = apply(observed, self._corners)
        self._whitening = _whitening(motions, self._rows)
        self._half = max(frame_shape) / 2
        self._unit = unit_coordinates(frame_shape)
        self._generators = generators(frame_shape)

    def minimise(self, homographies: FloatArray, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return the homographies of least cost, (N, 3, 3), and the norm of the whitened residual of each edge, (E,).

        Args:
            homographies: (N, 3, 3) where to start.
            kept: (E,) False for outliers.
        """
        # Equal weights at first: the start fits half of the edges exactly, so that robust weights would reject the others.
        weights = kept.astype(np.float64)
        for _ in range(MAX_ITERATIONS):
            jacobians, residuals = self._linearised(homographies, weights)
            free = self._free
            step = np.zeros(8 * self._n_nodes)
            step[free] = -_solved((jacobians.T @ jacobians)[free][:, free], (jacobians.T @ residuals)[free])
            stepped = self._stepped(homographies, step, weights, float(residuals @ residuals))
            if stepped is None:
                break
            homographies, norms = stepped
            weights = self._robust_weights(norms, kept)
            if np.abs(step).max() * self._half < CONVERGED_PX:
                break
        # The anchor is fixed; this removes rounding errors.
        homographies[self._anchor] = np.eye(3)
        return homographies, self._norms(homographies)

    def inliers(self, norms: FloatArray) -> BoolArray:
        """Return which edges are no outliers, from the norms of their whitened residuals: (E,)."""
        return np.asarray(norms <= OUTLIER * self._residual_scale(norms, np.ones(len(norms), dtype=bool)))

    def residuals_px(self, homographies: FloatArray) -> FloatArray:
        """Return the root mean square residual at the corners, for each edge: (E,) in px."""
        return np.asarray(np.sqrt(np.mean(np.sum(self._residuals(homographies) ** 2, axis=-1), axis=-1)))

    def assess(self, homographies: FloatArray, norms: FloatArray, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return the information on each node while the others are held, and the expected error of its corners.

        The error is that of solutions drawn from the covariance, each aligned with the best one as an evaluation aligns planes.
        If residuals exceed what the information of the edges predicts, the covariance is scaled up accordingly.

        Returns:
            (N, 8, 8) inverse covariances of p1..p8 of the homographies; (N,) in px.
        """
        misfit = self._residual_scale(norms, kept) / MEDIAN_NORM
        jacobians, _ = self._linearised(homographies, self._robust_weights(norms, kept) / misfit**2)
        normal, free = jacobians.T @ jacobians, self._free
        nodes = np.arange(self._n_nodes)
        blocks = np.stack([normal[8 * node : 8 * node + 8, 8 * node : 8 * node + 8].toarray() for node in nodes])
        draws = np.random.default_rng(0).normal(size=(jacobians.shape[0], SAMPLES))
        changes = np.zeros((8 * self._n_nodes, SAMPLES))
        changes[free] = _solved(normal[free][:, free], (jacobians.T @ draws)[free], draws=True)
        return self._in_parameters(homographies, blocks), self._corner_std_px(homographies, changes)

    def _stepped(
        self, homographies: FloatArray, step: FloatArray, weights: FloatArray, cost: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the homographies after a step, halved until the cost falls, and the norms there; None if it never does.

        A chain of many frames is far from linear: the perspective of the first bends the path of all others.
        """
        for _ in range(MAX_HALVINGS):
            # Too large a step may leave homographies that cannot be inverted.
            with suppress(ValueError, np.linalg.LinAlgError), np.errstate(all="ignore"):
                change = np.linalg.inv(self._unit) @ from_parameters(step.reshape(-1, 8)) @ self._unit
                changed = normalised(homographies @ change)
                norms = self._norms(changed)
                if 8 * weights @ norms**2 <= cost * (1 + NO_WORSE):
                    return changed, norms
            step = step / 2
        return None

    @property
    def _free(self) -> BoolArray:
        """The unknowns of all nodes but the anchor: (8 N,)."""
        return np.repeat(np.arange(self._n_nodes) != self._anchor, 8)

    def _corner_std_px(self, homographies: FloatArray, changes: FloatArray) -> FloatArray:
        """Return the root mean square displacement of corners by (8 N, S) changes, after the best alignment of planes: (N,)."""
        here = np.broadcast_to(self._rows, (self._n_nodes, 3, 4))
        to_corners = slopes(here, np.broadcast_to(self._generators @ self._rows, (self._n_nodes, 8, 3, 4)))
        # Derivatives of the corners of each frame with respect to a change of the plane.
        by_plane = inverse(homographies)[:, None] @ self._generators @ homographies[:, None] @ self._rows
        of_plane = slopes(here, by_plane).reshape(-1, 8)
        errors = (to_corners @ changes.reshape(self._n_nodes, 8, -1)).reshape(len(of_plane), -1)
        scale = np.linalg.norm(of_plane, axis=0)
        best = np.linalg.lstsq(of_plane / scale, errors, rcond=None)[0]
        remaining = errors - of_plane / scale @ best
        return np.asarray(np.sqrt((remaining**2).reshape(self._n_nodes, -1).sum(axis=1) / (4 * remaining.shape[1])))

    def _in_parameters(self, homographies: FloatArray, blocks: FloatArray) -> FloatArray:
        """Convert (N, 8, 8) information on changes of nodes to that on p1..p8 of their homographies."""
        changed = homographies[:, None] @ self._generators
        slopes = changed - homographies[:, None] * changed[..., 2:, 2:]
        to_parameters = parameters(np.eye(3) + slopes).transpose(0, 2, 1)
        to_change = np.linalg.inv(to_parameters)
        return np.asarray(to_change.transpose(0, 2, 1) @ blocks @ to_change)

    def _residual_scale(self, norms: FloatArray, kept: BoolArray) -> float:
        """Return the robust scale of the whitened residuals: at least that of unit variance, which the information predicts."""
        # Each node absorbs the residuals of one edge; the redundant edges determine the scale. The median alone would be too
        # small where robust weights make half of the edges fit exactly.
        n_edges = int(kept.sum())
        redundancy = n_edges - self._n_nodes + 1
        scale = float(np.median(norms[kept])) * float(np.sqrt(n_edges / redundancy)) if redundancy > 0 else 0.0
        return max(scale, MEDIAN_NORM)

    def _robust_weights(self, norms: FloatArray, kept: BoolArray) -> FloatArray:
        """Return the Cauchy weights of the edges, 0 for those that are not kept: (E,)."""
        scale = self._residual_scale(norms, kept) * CAUCHY
        return np.asarray(np.where(kept, 1 / (1 + (norms / scale) ** 2), 0.0))

    def _relative(self, homographies: FloatArray) -> FloatArray:
        return np.linalg.solve(homographies[self._fixed], homographies[self._moving])

    def _residuals(self, homographies: FloatArray) -> FloatArray:
        return apply(self._relative(homographies), self._corners) - self._targets

    def _norms(self, homographies: FloatArray) -> FloatArray:
        whitened = np.einsum("eij,ej->ei", self._whitening, self._residuals(homographies).reshape(-1, 8))
        return np.asarray(np.linalg.norm(whitened, axis=1) / np.sqrt(8))

    def _linearised(self, homographies: FloatArray, weights: FloatArray) -> tuple[sparse.csr_array, FloatArray]:
        """Return the weighted derivatives of the residuals, (8 E, 8 N), and the weighted residuals, (8 E,)."""
        relative = self._relative(homographies)
        mapped = relative @ self._rows
        d_moving = relative[:, None] @ (self._generators @ self._rows)
        d_fixed = -self._generators @ mapped[:, None]
        root = np.sqrt(weights)[:, None, None] * self._whitening
        n_edges = len(weights)
        # Each residual depends on the eight unknowns of both nodes of its edge alone.
        entries = np.concatenate([root @ slopes(mapped, d) for d in (d_moving, d_fixed)], axis=2)
        unknowns = (8 * np.stack([self._moving, self._fixed], axis=1)[..., None] + np.arange(8)).reshape(n_edges, 1, 16)
        columns = np.broadcast_to(unknowns, entries.shape).astype(np.int32)
        starts = np.arange(0, entries.size + 1, 16, dtype=np.int32)
        residuals = np.einsum("eij,ej->ei", root, self._residuals(homographies).reshape(-1, 8))
        shape = 8 * n_edges, 8 * self._n_nodes
        return sparse.csr_array((entries.ravel(), columns.ravel(), starts), shape=shape), residuals.ravel()


def _solved(normal: sparse.csr_array, right: FloatArray, draws: bool = False) -> FloatArray:
    """Solve a positive semidefinite system; the symmetric ordering keeps the factors of a graph with loop closures sparse.

    Unknowns that nothing determines stay where they are: a singular system is damped.

    Args:
        normal: (N, N).
        right: (N,) or (N, S).
        draws: whether the right sides are drawn with `normal` as their covariance; unknowns that nothing determines then get
            draws as wide as the damping.
    """
    with suppress(RuntimeError), np.errstate(all="ignore"):
        solution = _factorised(normal).solve(right)
        if np.isfinite(solution).all():
            return np.asarray(solution)
    diagonal = normal.diagonal()
    damping = _DAMPING * np.maximum(diagonal, _DAMPING * diagonal.max(initial=_TINY))
    if draws:
        right = right + np.sqrt(damping)[:, None] * np.random.default_rng(1).normal(size=right.shape)
    return np.asarray(_factorised(normal + sparse.diags_array(damping)).solve(right))


def _factorised(normal: sparse.csr_array) -> SuperLU:
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
    """Return the maps from residuals at the corners, in px, to residuals of unit variance: (E, 8, 8).

    Args:
        motions: of the edges.
        rows: (3, 4) the corners in homogeneous coordinates.
    """
    whitening = np.array([np.eye(8) / max(motion.residual_px or 1.0, 1e-3) for motion in motions])
    informed = [index for index, motion in enumerate(motions) if motion.information is not None]
    if informed:
        information = np.array([motions[index].information for index in informed])
        mapped = np.array([motions[index].homography for index in informed]) @ rows
        changes = (from_parameters(np.eye(8)) - np.eye(3)) @ rows
        to_corners = slopes(mapped, np.broadcast_to(changes, (len(informed), *changes.shape)))
        whitening[informed] = _roots(information) @ np.linalg.inv(to_corners)
    return whitening
