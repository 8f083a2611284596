"""Sort the photons of frames by where their pixels lie on a fine grid. Compiled.

Pixels whose centres fall into one cell of the grid see nearly the same light, whatever their frame: their counts are summed,
and so are their frames. A capture becomes two images, on which each round of an estimate works, not on the frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled

_UP = 0.5 + 1e-6  # a centre on the border of two cells belongs to the second one, whatever the rounding of its coordinates


@compiled
def add_observations(
    counts: NDArray[np.float32],
    usable: NDArray[np.bool_],
    amounts: NDArray[np.float32],
    to_grid: NDArray[np.float64],
    first: int,
    lit: NDArray[np.float32],
    seen: NDArray[np.float32],
) -> None:
    """Add the pixels of a sum of frames, (h, w), to the cells that their centres fall into.

    `to_grid` (3, 3) maps pixels of the frame to cells of the whole grid, of which `lit` (H, W) and `seen` (P, H, W) are the
    rows from `first` on. Each usable pixel adds its count to `lit`, and `amounts` (P,), such as the frames in the sum, to
    `seen`.
    """
    height, width = counts.shape
    rows, columns = lit.shape
    present = np.flatnonzero(amounts)
    for y in range(height):
        # Along a row of the frame, the grid's coordinates are quotients of linear functions.
        u0, du = to_grid[0, 1] * y + to_grid[0, 2], to_grid[0, 0]
        v0, dv = to_grid[1, 1] * y + to_grid[1, 2], to_grid[1, 0]
        d0, dd = to_grid[2, 1] * y + to_grid[2, 2], to_grid[2, 0]
        last = width - 1
        ends = v0 / d0 - first, (v0 + dv * last) / (d0 + dd * last) - first
        if max(ends[0], ends[1]) < -0.5 or min(ends[0], ends[1]) > rows - 0.5:
            continue
        for x in range(width):
            per_depth = 1 / (d0 + dd * x)
            column = int(np.floor((u0 + du * x) * per_depth + _UP))
            row = int(np.floor((v0 + dv * x) * per_depth + _UP)) - first
            if 0 <= row < rows and 0 <= column < columns and usable[y, x]:
                lit[row, column] += counts[y, x]
                for p in present:
                    seen[p, row, column] += amounts[p]


@compiled
def expected(
    flux: NDArray[np.float32], kernel: NDArray[np.float32], scratch: NDArray[np.float32], into: NDArray[np.float32]
) -> None:
    """Average the flux, (H, W), over the areas of pixels that are centred at each cell; the border is repeated.

    `kernel` (2 r + 1,) are symmetric weights along x and y with the sum 1, so that this is its own adjoint; `scratch` is
    overwritten.
    """
    height, width = flux.shape
    radius = len(kernel) // 2
    for y in range(height):
        row, out = flux[y], scratch[y]
        for x in range(width):
            if radius <= x < width - radius:
                continue
            total = np.float32(0)
            for i in range(-radius, radius + 1):
                total += kernel[i + radius] * row[min(max(x + i, 0), width - 1)]
            out[x] = total
        inner = out[radius : width - radius]
        for t in range(len(inner)):
            inner[t] = np.float32(0)
        for i in range(2 * radius + 1):
            weight, part = kernel[i], row[i : i + len(inner)]
            for t in range(len(inner)):
                inner[t] += weight * part[t]
    for y in range(height):
        out = into[y]
        for x in range(width):
            out[x] = np.float32(0)
        for i in range(-radius, radius + 1):
            weight, part = kernel[i + radius], scratch[min(max(y + i, 0), height - 1)]
            for x in range(width):
                out[x] += weight * part[x]


@compiled
def _lit_share(light: np.float32) -> np.float32:
    """Return `1 - exp(-light)`, exact in float32 for a faint light too."""
    half = np.float32(0.5)
    return light - half * light * light if light < np.float32(2e-3) else np.float32(1) - np.exp(-light)


@compiled
def photon_ratio(
    lit: NDArray[np.float32], seen: NDArray[np.float32], mean: NDArray[np.float32], binary: bool, into: NDArray[np.float32]
) -> None:
    """Write `k / (1 - exp(-mean))` of the counts k of each cell, (H, W), or k / mean of counts that are not binary."""
    least = np.float32(1e-9)
    for y in range(lit.shape[0]):
        k, n, m, out = lit[y], seen[y], mean[y], into[y]
        for x in range(len(k)):
            light = max(m[x], least)
            if k[x] <= 0 or n[x] <= 0:
                out[x] = np.float32(0)
            elif binary:
                out[x] = k[x] / _lit_share(light)
            else:
                out[x] = k[x] / light


@compiled
def log_likelihood(
    lit: NDArray[np.float32], seen: NDArray[np.float32], mean: NDArray[np.float32], binary: bool, into: NDArray[np.float32]
) -> None:
    """Return the log-likelihood of the counts of each cell, but for a constant: see `photon_ratio` for the arguments."""
    least = np.float32(1e-9)
    for y in range(lit.shape[0]):
        k, n, m, out = lit[y], seen[y], mean[y], into[y]
        for x in range(len(k)):
            light = max(m[x], least)
            if n[x] <= 0:
                out[x] = np.float32(0)
            elif binary:
                out[x] = k[x] * np.log(_lit_share(light)) - (n[x] - k[x]) * light
            else:
                out[x] = k[x] * np.log(light) - n[x] * light


@compiled
def counts_in_light(
    mean: NDArray[np.float32],
    frames: NDArray[np.float32],
    gains: NDArray[np.float32],
    lit: NDArray[np.float32],
    dark: NDArray[np.float32],
) -> None:
    """Write the expected frames of each cell with and without photons in changing light, (H, W), from the mean flux.

    `frames` and `gains` are (C, H, W): the frames of each class of light, and the sums of their gains.
    """
    for y in range(mean.shape[0]):
        for x in range(mean.shape[1]):
            lit[y, x] = dark[y, x] = np.float32(0)
            for c in range(len(frames)):
                n = frames[c, y, x]
                if n > 0:
                    share = _lit_share(gains[c, y, x] / n * mean[y, x])
                    lit[y, x] += n * share
                    dark[y, x] += n * (np.float32(1) - share)
