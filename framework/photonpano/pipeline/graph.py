"""The motion graph: exposures are nodes, pairwise motions are edges; one homography a node makes them agree best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.sparse.linalg import spsolve

from photonpano.geometry import apply, corners, from_parameters, inverse, jacobian, normalised
from photonpano.values import Located

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from photonpano.values import BoolArray, Edge, FloatArray

MAX_ITERATIONS = 30
CONVERGED_PX = 1e-4
CAUCHY = 2.385
"""Residuals of so many typical ones weigh half (95 % efficiency for Gaussian noise)."""
CONTRADICTION = 8.0
"""An edge that disagrees with the solution by more than so many typical residuals is reported."""


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """Where the exposures lie.

    Convention:
        Homographies map pixels of a node's frame to pixels of the anchor's frame; the anchor's is the identity.

    Attributes:
        homographies: (N, 3, 3), NaN for nodes that are not tied to the anchor.
        located: (N,) True for nodes that are tied to the anchor.
        contradictions: positions, in the list that was solved, of edges that the others outvote.
        residual_px: root mean square disagreement of the edges at the corners, 0 for a tree.
    """

    homographies: FloatArray
    located: BoolArray
    contradictions: tuple[int, ...]
    residual_px: float


def largest_component(n_nodes: int, edges: Sequence[Edge]) -> BoolArray:
    """Return the nodes of the largest set that located edges tie together: (N,)."""
    pairs = np.array([(edge.moving, edge.fixed) for edge in edges if isinstance(edge.motion, Located)], dtype=int).reshape(
        -1, 2
    )
    _, labels = connected_components(_adjacency(n_nodes, pairs), directed=False)
    return np.asarray(labels == np.argmax(np.bincount(labels)))


def solve(n_nodes: int, edges: Sequence[Edge], anchor: int, frame_shape: tuple[int, int]) -> GraphSolution:
    """Find the homographies that agree best with all located edges.

    Robust least squares on where each edge sends the corners of its frame, weighted by the edge's information where it has
    one; Gauss-Newton with Cauchy weights, from a spanning tree of edges to the nearest exposures.

    Args:
        n_nodes: number of exposures.
        edges: what the locator said; failures are skipped.
        anchor: the node whose homography is the identity.
        frame_shape: (height, width) of a frame.
    """
    located_edges = [(position, edge) for position, edge in enumerate(edges) if isinstance(edge.motion, Located)]
    pairs = np.array([(edge.moving, edge.fixed) for _, edge in located_edges], dtype=int).reshape(-1, 2)
    order, parents = breadth_first_order(_adjacency(n_nodes, pairs), anchor, directed=False)
    located = np.zeros(n_nodes, dtype=bool)
    located[order] = True
    tied = [index for index, (moving, _) in enumerate(pairs) if located[moving]]
    positions = [located_edges[index][0] for index in tied]
    motions = [motion for index in tied if isinstance(motion := located_edges[index][1].motion, Located)]
    homographies = np.full((n_nodes, 3, 3), np.nan)
    homographies[anchor] = np.eye(3)
    if not tied:
        return GraphSolution(homographies, located, (), 0.0)
    pairs = pairs[tied]
    observed = np.array([motion.homography for motion in motions])
    _compose_tree(homographies, order[1:], parents, pairs, observed)
    if len(tied) == len(order) - 1:
        return GraphSolution(homographies, located, (), 0.0)

    compact = np.cumsum(located) - 1
    problem = _Problem(compact[pairs], int(compact[anchor]), observed, motions, frame_shape)
    homographies[located], whitened = problem.minimise(homographies[located])
    contradictions = tuple(positions[index] for index in np.flatnonzero(whitened > CONTRADICTION * np.median(whitened)))
    return GraphSolution(homographies, located, contradictions, problem.residual_px(homographies[located]))


def _adjacency(n_nodes: int, pairs: NDArray[np.integer]) -> sparse.csr_array:
    ones = np.ones(len(pairs))
    return sparse.csr_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(n_nodes, n_nodes))


def _compose_tree(
    homographies: FloatArray,
    order: NDArray[np.integer],
    parents: NDArray[np.integer],
    pairs: NDArray[np.integer],
    observed: FloatArray,
) -> None:
    """Fill in the homographies of the nodes of `order`, each from its parent along one edge."""
    edge_of = {(int(moving), int(fixed)): index for index, (moving, fixed) in enumerate(pairs)}
    for node in map(int, order):
        parent = int(parents[node])
        forward = edge_of.get((node, parent))
        step = observed[forward] if forward is not None else inverse(observed[edge_of[parent, node]])
        homographies[node] = normalised(homographies[parent] @ step)


class _Problem:
    """Residuals and steps of a connected graph; the unknowns of a node are p1..p8 in coordinates of about unit size."""

    def __init__(
        self,
        pairs: NDArray[np.integer],
        anchor: int,
        observed: FloatArray,
        motions: Sequence[Located],
        frame_shape: tuple[int, int],
    ) -> None:
        self._moving, self._fixed = pairs.T
        self._anchor = anchor
        self._corners = corners(frame_shape)
        self._targets = apply(observed, self._corners)
        self._whitening = np.array([_whitening(motion, self._corners) for motion in motions])
        height, width = frame_shape
        self._half = half = max(height, width) / 2
        self._unit = np.array([[1 / half, 0, (1 - width) / (2 * half)], [0, 1 / half, (1 - height) / (2 * half)], [0, 0, 1]])
        basis = from_parameters(np.eye(8)) - np.eye(3)
        self._generators = np.linalg.inv(self._unit) @ basis @ self._unit

    def minimise(self, homographies: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the homographies, and the whitened residual of each edge."""
        # Each node takes up as many residuals as an edge has; what is left over tells the typical size of an error.
        freedom = np.sqrt(len(self._moving) / (len(self._moving) - len(homographies) + 1))
        weights = np.ones(len(self._moving))
        for _ in range(MAX_ITERATIONS):
            step = self._step(homographies, weights)
            change = np.linalg.inv(self._unit) @ from_parameters(step) @ self._unit
            homographies = normalised(homographies @ change)
            norms = self._norms(homographies)
            scale = max(float(np.median(norms)) * freedom, 1e-9) * CAUCHY
            weights = 1 / (1 + (norms / scale) ** 2)
            if np.abs(step).max() * self._half < CONVERGED_PX:
                break
        # The anchor does not move, but rounding may show in its last digits.
        homographies[self._anchor] = np.eye(3)
        return homographies, self._norms(homographies)

    def residual_px(self, homographies: FloatArray) -> float:
        """Return the root mean square distance, over edges and corners, in px."""
        return float(np.sqrt(np.mean(np.sum(self._residuals(homographies) ** 2, axis=-1))))

    def _relative(self, homographies: FloatArray) -> FloatArray:
        return np.linalg.solve(homographies[self._fixed], homographies[self._moving])

    def _residuals(self, homographies: FloatArray) -> FloatArray:
        return apply(self._relative(homographies), self._corners) - self._targets

    def _norms(self, homographies: FloatArray) -> FloatArray:
        whitened = np.einsum("eij,ej->ei", self._whitening, self._residuals(homographies).reshape(-1, 8))
        return np.asarray(np.linalg.norm(whitened, axis=1) / np.sqrt(8))

    def _step(self, homographies: FloatArray, weights: FloatArray) -> FloatArray:
        """Solve the weighted normal equations for the (N, 8) changes of all nodes but the anchor."""
        relative = self._relative(homographies)
        rows = np.concatenate([self._corners, np.ones((4, 1))], axis=1).T
        mapped = relative @ rows
        d_moving = np.einsum("eij,kjl,lc->ekic", relative, self._generators, rows)
        d_fixed = -np.einsum("kij,ejc->ekic", self._generators, mapped)
        root = np.sqrt(weights)[:, None, None] * self._whitening
        blocks = [root @ _perspective(mapped, d) for d in (d_moving, d_fixed)]
        residuals = np.einsum("eij,ej->ei", root, self._residuals(homographies).reshape(-1, 8))
        n_edges, n_nodes = len(weights), len(homographies)
        edge_rows = np.arange(8 * n_edges).reshape(n_edges, 8, 1)
        data, row, column = [], [], []
        for nodes, block in zip((self._moving, self._fixed), blocks, strict=True):
            data.append(block.ravel())
            row.append(np.broadcast_to(edge_rows, block.shape).ravel())
            column.append(np.broadcast_to(8 * nodes[:, None, None] + np.arange(8), block.shape).ravel())
        entries = (np.concatenate(data), (np.concatenate(row), np.concatenate(column)))
        jacobians = sparse.csc_array(entries, shape=(8 * n_edges, 8 * n_nodes))
        free = np.repeat(np.arange(n_nodes) != self._anchor, 8)
        jacobians = jacobians[:, free]
        step = np.zeros(8 * n_nodes)
        step[free] = -spsolve(jacobians.T @ jacobians, jacobians.T @ residuals.ravel())
        return step.reshape(n_nodes, 8)


def _perspective(mapped: FloatArray, derivatives: FloatArray) -> FloatArray:
    """Return d(x/z, y/z) of (E, 3, 4) mapped corners for (E, 8, 3, 4) derivatives: (E, 8 coordinates, 8 parameters)."""
    z = mapped[:, None, 2:]
    points = mapped[:, None, :2] / z
    d = (derivatives[:, :, :2] - points * derivatives[:, :, 2:]) / z
    return d.transpose(0, 3, 2, 1).reshape(len(mapped), 8, 8)


def _whitening(motion: Located, frame: FloatArray) -> FloatArray:
    """Return the (8, 8) map from errors of the corners, in px, to errors of unit variance."""
    if motion.information is None:
        return np.eye(8) / max(motion.residual_px or 1.0, 1e-3)
    root = np.linalg.cholesky(motion.information).T
    return np.asarray(root @ np.linalg.inv(jacobian(motion.homography, frame).reshape(8, 8)))
