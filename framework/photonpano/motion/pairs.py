"""Pairs of exposures to register: those some group lengths apart, and neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from photonpano.geometry import inverse, why_implausible
from photonpano.values import FloatArray, FrameSpan, Group

GYROSCOPE, TIE = "gyroscope", "tie"  # stand for the locators of pairs that no exposures show


def pairs_of(groups: Sequence[Group], skips: Sequence[float]) -> list[tuple[int, int]]:
    """Return the pairs (moving, fixed) of a level, moving later than fixed, ordered by the moving exposure.

    Exposures that share photons share their noise, which confirms the motion along which they were merged. Neighbours that
    overlap in time are therefore no pairs, unless the graph would fall apart without them.

    Each exposure is paired with those whose instants are closest to the `skips`, in mean lengths of both groups, before and
    after its own; at the shortest, also with the next one beyond, since dense exposures would otherwise fall into separate
    chains. Without skips, the pairs are a chain of neighbours.
    """
    instants, lengths = instants_of(groups), lengths_of(groups)
    pairs: set[tuple[int, int]] = set()
    for index, (instant, length) in enumerate(zip(instants, lengths, strict=True)):
        distances = (instants - instant) / ((lengths + length) / 2)
        for skip in skips:
            for target in (-skip, skip):
                if not distances[0] - 0.5 / length <= target <= distances[-1] + 0.5 / length:
                    continue
                partner = int(np.argmin(np.abs(distances - target)))
                beyond = partner + (1 if target > 0 else -1)
                partners = [partner, beyond] if skip == min(skips) else [partner]
                pairs |= {
                    (max(index, each), min(index, each)) for each in partners if each != index and 0 <= each < len(groups)
                }
    # Neighbours connect the graph, for instance of a capture that is hardly longer than a group.
    labels = component_labels(len(groups), np.array(sorted(pairs), dtype=int).reshape(-1, 2))
    pairs |= {
        (later, later - 1)
        for later in range(1, len(groups))
        if labels[later] != labels[later - 1] or not shared_share(groups[later].span, groups[later - 1].span)
    }
    return sorted(pairs)


def alike(pairs: Sequence[tuple[int, int]], to_plane: FloatArray, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Leave out the pairs that see too little alike by the motion known so far, (N, 3, 3), if others tie their exposures."""
    seen = [pair for pair in pairs if not why_implausible(inverse(to_plane[pair[1]]) @ to_plane[pair[0]], shape)]
    left, tied = (component_labels(len(to_plane), np.array(some, dtype=int).reshape(-1, 2)) for some in (seen, pairs))
    return seen if left.max() == tied.max() else list(pairs)


def excluded_pairs(groups: Sequence[Group], frames: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs (moving, fixed) of exposures of which one holds the first and the other the second of two `frames`."""

    def holding(frame: int) -> list[int]:
        return [index for index, group in enumerate(groups) if group.span.start <= frame < group.span.stop]

    return {(max(one, other), min(one, other)) for a, b in frames for one in holding(a) for other in holding(b) if one != other}


def shared_share(first: FrameSpan, second: FrameSpan) -> float:
    """Return the share of the shorter of two spans that lies in the other."""
    common = min(first.stop, second.stop) - max(first.start, second.start)
    return max(0, common) / min(len(first), len(second))


def adjacency(n_nodes: int, pairs: NDArray[np.integer], weights: FloatArray | None = None) -> sparse.csr_array:
    """Return the adjacency matrix of a graph: the (P,) weights of its (P, 2) pairs, or 1, at their rows and columns."""
    given = np.ones(len(pairs)) if weights is None else weights
    return sparse.csr_array((given, (pairs[:, 0], pairs[:, 1])), shape=(n_nodes, n_nodes))


def component_labels(n_nodes: int, pairs: NDArray[np.integer]) -> NDArray[np.integer]:
    """Number the connected components of a graph, given its (P, 2) pairs: (N,) the component of each node."""
    return np.asarray(connected_components(adjacency(n_nodes, pairs), directed=False)[1])


def instants_of(groups: Sequence[Group]) -> FloatArray:
    """Return the reference instants of the groups: (N,)."""
    return np.array([group.reference for group in groups])


def lengths_of(groups: Sequence[Group]) -> FloatArray:
    """Return the number of frames of each group: (N,)."""
    return np.array([float(len(group.span)) for group in groups])
