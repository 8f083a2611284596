"""Denoise an image by collaborative filtering of similar patches (Dabov et al., "BM3D", IEEE TIP 2007, its first stage).

Similar patches are stacked, transformed together, and coefficients below the noise are set to 0. Compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from photonpano.compiling import compiled

Image = NDArray[np.float32]

PATCH = 8  # side of a patch, px
GROUP = 16  # similar patches that are filtered together; a power of 2
SEARCH = 10  # similar patches are looked for at this distance at most along x and y, px
STEP = 4  # distance of reference patches, px
_THRESHOLD = np.float32(2.7)  # coefficients below this many standard deviations of the noise are set to 0
_DCT: Image = dct(np.eye(PATCH), axis=0, norm="ortho").astype(np.float32)


class Patches(NamedTuple):
    """Reference patches on a regular grid, and the patches that are similar to each."""

    rows: NDArray[np.int32]  # (R,) first rows of the reference patches
    columns: NDArray[np.int32]  # (C,) their first columns
    similar: NDArray[np.int32]  # (R, C, GROUP, 2) first row and column of the similar patches, the reference first

    @classmethod
    def over(cls, shape: tuple[int, ...]) -> Patches:
        """Return patches that cover an image of a (height, width), without similar ones."""
        rows, columns = (_places(length) for length in shape)
        return cls(rows, columns, np.empty((len(rows), len(columns), GROUP, 2), np.int32))


def _places(length: int) -> NDArray[np.int32]:
    """Return where reference patches begin along a side, so that they cover it."""
    return np.unique(np.append(np.arange(0, length - PATCH + 1, STEP), length - PATCH)).astype(np.int32)


@compiled
def find_similar(image: Image, patches: Patches) -> None:
    """Find the patches of an image, (H, W), that differ least from each reference patch."""
    rows, columns, found = patches
    height, width = image.shape
    side = 2 * SEARCH + 1
    best = np.empty(GROUP, np.float32)
    distances = np.empty(side, np.float32)
    for r in range(len(rows)):
        for c in range(len(columns)):
            y0, x0 = rows[r], columns[c]
            places = found[r, c]
            n = 0
            top, bottom = max(0, y0 - SEARCH), min(height - PATCH, y0 + SEARCH)
            left, right = max(0, x0 - SEARCH), min(width - PATCH, x0 + SEARCH)
            size = right - left + 1
            for y in range(top, bottom + 1):
                row = distances[:size]
                for t in range(size):
                    row[t] = np.float32(0)
                for i in range(PATCH):
                    line = image[y + i]
                    for j in range(PATCH):
                        value, part = image[y0 + i, x0 + j], line[left + j : left + j + size]
                        for t in range(size):
                            apart = part[t] - value
                            row[t] += apart * apart
                for t in range(size):
                    distance = row[t]
                    if y == y0 and left + t == x0:
                        distance = np.float32(-1)
                    if n == GROUP and distance >= best[GROUP - 1]:
                        continue
                    k = n if n < GROUP else GROUP - 1
                    n = min(n + 1, GROUP)
                    while k > 0 and best[k - 1] > distance:
                        best[k] = best[k - 1]
                        places[k, 0], places[k, 1] = places[k - 1, 0], places[k - 1, 1]
                        k -= 1
                    best[k] = distance
                    places[k, 0], places[k, 1] = y, left + t
            for k in range(n, GROUP):
                places[k, 0], places[k, 1] = y0, x0


@compiled
def _transformed(patch: Image, matrix: Image, scratch: Image) -> None:
    """Multiply a patch with a matrix from the left and with its transpose from the right, in place."""
    for i in range(PATCH):
        for j in range(PATCH):
            scratch[i, j] = np.float32(0)
        for k in range(PATCH):
            weight, row, out = matrix[i, k], patch[k], scratch[i]
            for j in range(PATCH):
                out[j] += weight * row[j]
    for i in range(PATCH):
        for j in range(PATCH):
            patch[i, j] = np.float32(0)
        for k in range(PATCH):
            weight, out = scratch[i, k], patch[i]
            for j in range(PATCH):
                out[j] += weight * matrix[j, k]


@compiled
def _mixed(stack: Image) -> None:
    """Apply the orthonormal Walsh-Hadamard transform along the patches of a (GROUP, PATCH * PATCH) stack; it inverts itself."""
    half = 1
    while half < GROUP:
        for start in range(0, GROUP, 2 * half):
            for k in range(start, start + half):
                a, b = stack[k], stack[k + half]
                for t in range(PATCH * PATCH):
                    p, q = a[t], b[t]
                    a[t], b[t] = p + q, p - q
        half *= 2
    scale = np.float32(1 / np.sqrt(GROUP))
    for k in range(GROUP):
        row = stack[k]
        for t in range(PATCH * PATCH):
            row[t] *= scale


@compiled
def filter_groups(image: Image, noise: Image, patches: Patches, total: Image, weights: Image) -> None:
    """Filter each group of similar patches, and add its patches where they lie, weighted by how few coefficients are left.

    `noise` is (H, W), the standard deviation to remove; `total` and `weights`, (H, W), are added to.
    """
    rows, columns, found = patches
    stack = np.empty((GROUP, PATCH, PATCH), np.float32)
    flat = stack.reshape(GROUP, PATCH * PATCH)
    scratch = np.empty((PATCH, PATCH), np.float32)
    forth, back = _DCT, np.ascontiguousarray(_DCT.T)
    half = PATCH // 2
    for r in range(len(rows)):
        for c in range(len(columns)):
            places = found[r, c]
            for k in range(GROUP):
                y, x = places[k, 0], places[k, 1]
                for i in range(PATCH):
                    for j in range(PATCH):
                        stack[k, i, j] = image[y + i, x + j]
                _transformed(stack[k], forth, scratch)
            _mixed(flat)
            sigma = noise[rows[r] + half, columns[c] + half]
            limit, kept = _THRESHOLD * sigma, 0
            for k in range(GROUP):
                row = flat[k]
                for t in range(PATCH * PATCH):
                    if abs(row[t]) < limit and k + t > 0:
                        row[t] = np.float32(0)
                    else:
                        kept += 1
            _mixed(flat)
            weight = np.float32(1) / (np.float32(kept) * sigma * sigma)
            for k in range(GROUP):
                _transformed(stack[k], back, scratch)
                y, x = places[k, 0], places[k, 1]
                for i in range(PATCH):
                    for j in range(PATCH):
                        total[y + i, x + j] += weight * stack[k, i, j]
                        weights[y + i, x + j] += weight
