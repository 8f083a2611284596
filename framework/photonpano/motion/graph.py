"""The motion graph: exposures are nodes, pairwise motions are edges; it is solved for one homography a node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order

from photonpano.geometry import inverse, normalised
from photonpano.motion.adjustment import Adjustment
from photonpano.motion.pairs import adjacency, component_labels
from photonpano.values import BoolArray, Edge, FloatArray, Located


class GraphOptions(Protocol):
    """Which pairs of exposures are registered, and whether some exposures may remain disconnected."""

    @property
    def skips(self) -> tuple[float, ...]:
        """Each exposure is registered with those at these distances before and after it, in group lengths."""
        ...

    @property
    def closure_overlap(self) -> float | None:
        """Least overlap of a loop closure, as a share of the field of view; None registers no loop closures."""
        ...

    @property
    def disconnected(self) -> Literal["error", "largest"]:
        """Whether a graph that falls apart is an error, or its largest part is used."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """The homographies of the exposures.

    Convention:
        Homographies map pixels of a node's frame to pixels of the anchor's frame; the anchor's is the identity.

    Attributes:
        homographies: (N, 3, 3), NaN for nodes that are not tied to the anchor.
        located: (N,) True for nodes that are tied to the anchor.
        outliers: positions, in the list that was solved, of edges that were dropped because they contradict the others.
        residual_px: root mean square residual of the other edges at the corners, 0 for a tree.
        assess: returns, for the L located nodes, the inverse covariances of p1..p8 while all other nodes are held, (L, 8, 8),
            and the expected error of the corners after the best alignment of the planes, (L,) in px. NaN for a single node.
            It takes about as long as to solve the graph.
    """

    homographies: FloatArray
    located: BoolArray
    outliers: tuple[int, ...]
    residual_px: float
    assess: Callable[[], tuple[FloatArray, FloatArray]]


def components(n_nodes: int, edges: Sequence[Edge]) -> NDArray[np.integer]:
    """Number the connected components of the located edges, the largest first: (N,)."""
    labels = component_labels(n_nodes, _pairs(edges))
    by_size = np.argsort(-np.bincount(labels), kind="stable")
    return np.asarray(np.argsort(by_size)[labels])


def solve(
    n_nodes: int, edges: Sequence[Edge], anchor: int, frame_shape: tuple[int, int], start: FloatArray | None = None
) -> GraphSolution:
    """Solve the graph: find the homographies with the least residuals of all located edges.

    Robust least squares on the corners that each edge maps, weighted by the edge's information where it has one; Gauss-Newton
    with Cauchy weights, from a spanning tree of edges to the nearest exposures unless a start is given. Outliers are dropped,
    unless the graph would fall apart, and it is solved again.

    Args:
        n_nodes: number of exposures.
        edges: pairs of exposures; those that are not located are skipped.
        anchor: the node whose homography is the identity.
        frame_shape: (height, width) of a frame.
        start: (N, 3, 3) homographies to any plane, such as those of a solution without some of the edges.
    """
    located_edges = [(position, edge) for position, edge in enumerate(edges) if isinstance(edge.motion, Located)]
    pairs = _pairs(edges)
    order, parents = breadth_first_order(adjacency(n_nodes, pairs), anchor, directed=False)
    located = np.zeros(n_nodes, dtype=bool)
    located[order] = True
    tied = [index for index, (moving, _) in enumerate(pairs) if located[moving]]
    positions = np.array([located_edges[index][0] for index in tied], dtype=int)
    motions = [motion for index in tied if isinstance(motion := located_edges[index][1].motion, Located)]
    homographies = np.full((n_nodes, 3, 3), np.nan)
    homographies[anchor] = np.eye(3)
    if not tied:
        return GraphSolution(homographies, located, (), 0.0, lambda: (np.full((1, 8, 8), np.nan), np.full(1, np.nan)))
    pairs = pairs[tied]
    observed = np.array([motion.homography for motion in motions])
    if start is None:
        _compose_tree(homographies, order[1:], parents, pairs, observed)
    else:
        homographies[located] = normalised(inverse(start[anchor]) @ start[located])

    compact = np.cumsum(located) - 1
    adjustment = Adjustment(compact[pairs], int(compact[anchor]), observed, motions, frame_shape)
    kept = np.ones(len(tied), dtype=bool)
    found, norms = adjustment.minimise(homographies[located], kept)
    inliers = adjustment.inliers(norms)
    if not inliers.all() and not component_labels(len(order), compact[pairs][inliers]).any():
        kept = inliers
        found, norms = adjustment.minimise(found, kept)
    homographies[located] = found
    residual_px = float(np.sqrt(np.mean(adjustment.residuals_px(found)[kept] ** 2)))
    outliers = tuple(int(position) for position in positions[~kept])
    return GraphSolution(homographies, located, outliers, residual_px, partial(adjustment.assess, found, norms, kept))


def _pairs(edges: Sequence[Edge]) -> NDArray[np.integer]:
    """Return the (moving, fixed) of the located edges: (E, 2)."""
    located = [(edge.moving, edge.fixed) for edge in edges if isinstance(edge.motion, Located)]
    return np.array(located, dtype=int).reshape(-1, 2)


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
