"""Match descriptors: mutual nearest neighbours with Lowe's ratio test, in the whole image or near predicted positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photonpano import FloatArray


def unit_descriptors(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return RootSIFT (Arandjelovic and Zisserman 2012): square roots, so that the scalar product is Hellinger's kernel."""
    raw = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1)))


def unit_bits(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the bits of (N, D) bytes as vectors of length 1: the square of a distance is 4 / (8 D) times Hamming's."""
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    return np.asarray((2 * bits - 1) / np.sqrt(max(1, bits.shape[1])), np.float32)


def match_everywhere(moving: NDArray[np.float32], fixed: NDArray[np.float32], ratio: float) -> NDArray[np.intp]:
    """Match unit descriptors (M, D) and (N, D): pairs of indices (K, 2)."""
    if min(len(moving), len(fixed)) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    similarity = moving @ fixed.T
    rows = np.arange(len(moving))
    best = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[best] == rows
    first = similarity[rows, best]
    similarity[rows, best] = -1
    second = similarity.max(axis=1)
    # Unit vectors: the squared distance is 2 - 2 * similarity, and Lowe's ratio is one of distances.
    distinct = (1 - first) <= ratio**2 * (1 - second)
    chosen = np.flatnonzero(mutual & distinct)
    return np.stack([chosen, best[chosen]], axis=1)


def match_nearby(
    moving: NDArray[np.float32],
    fixed: NDArray[np.float32],
    predicted: FloatArray,
    points: NDArray[np.float32],
    radius_px: float,
    ratio: float,
) -> NDArray[np.intp]:
    """Match unit descriptors (M, D) and (N, D) within a radius of predicted positions: pairs of indices (K, 2).

    `predicted` are positions of the moving keypoints in the fixed image, `points` those of the fixed ones, px. Without a second
    candidate, its similarity is taken as -1.
    """
    if min(len(moving), len(fixed)) == 0:
        return np.zeros((0, 2), dtype=np.intp)
    near = cKDTree(predicted).sparse_distance_matrix(cKDTree(points), radius_px, output_type="ndarray")
    i, j = near["i"], near["j"]
    similarity = np.einsum("kd,kd->k", moving[i], fixed[j])
    first, best = _best_two(i, similarity, len(moving))
    partner, _ = _best_two(j, similarity, len(fixed))
    k = first[first >= 0]
    second = best[i[k], 1]
    mutual = partner[j[k]] == k
    distinct = (1 - similarity[k]) <= ratio**2 * (1 - second)
    k = k[mutual & distinct]
    return np.stack([i[k], j[k]], axis=1)


def _best_two(
    owner: NDArray[np.intp], similarity: NDArray[np.float32], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the index of the best candidate of each owner (-1 if none), and the similarities of the best and second best."""
    order = np.lexsort((-similarity, owner))
    starts = np.flatnonzero(np.diff(owner[order], prepend=-1))
    best = np.full(count, -1, dtype=np.intp)
    best[owner[order[starts]]] = order[starts]
    values = np.full((count, 2), -1, dtype=np.float32)
    values[owner[order[starts]], 0] = similarity[order[starts]]
    seconds = starts[np.diff(np.append(starts, len(order))) > 1] + 1
    values[owner[order[seconds]], 1] = similarity[order[seconds]]
    return best, values
