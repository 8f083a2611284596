"""Sum, over blocks of pixels, what a panorama predicts of a span of frames and what was observed. Compiled."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled

BLOCK_PX = 16  # side of a block, px
# Sums of a block. With residual r, predicted count m, its gradient (gx, gy) along x and y, and the variance v of r: gx gx / v,
# gx gy / v, gy gy / v, gx r / v, gy r / v, gx m / v, gy m / v, m m / v, m r / v, r, v, m.
GXX, GXY, GYY, GX_R, GY_R, GX_M, GY_M, M_M, M_R, R, V, M = range(12)
N_SUMS = 12
# A block with a smaller variance than this, in counts squared, is not normally distributed, and is left out of chi-square.
_FEWEST_PHOTONS = 1.0


def n_blocks(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the number of blocks along y and x of a (height, width) image; the last ones may be cut off."""
    return -(-shape[0] // BLOCK_PX), -(-shape[1] // BLOCK_PX)


@compiled
def add_block_sums(  # noqa: PLR0917
    counts: NDArray[np.float32] | NDArray[np.uint8],
    dark: NDArray[np.float32],
    n_frames: float,
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Add the sums of a span to blocks. The border pixels of a frame are left out, for they have no gradient.

    Args:
        counts: (H, W) summed counts, NaN for masked pixels.
        dark: (H, W) variance of the count of a frame beside that of its photons, such as that of dark counts.
        n_frames: frames of the span.
        mean: (H, W) expected count of a frame.
        variance: (H, W) variance of the photons of a frame; 0 where it and the mean, also of a neighbour, are not known.
        sums: (h, w, 12), see `n_blocks`; added to.
    """
    height, width = mean.shape
    n, zero = np.float32(n_frames), np.float32(0)
    for block_row in range(len(sums)):
        last = min(height - 1, (block_row + 1) * BLOCK_PX) - 1
        # Two rows at a time: adding up what the lanes of the processor hold takes as long as a row.
        for y in range(max(1, block_row * BLOCK_PX), last + 1, 2):
            y2, both = min(y + 1, last), y < last
            for block in range(sums.shape[1]):
                start, stop = max(1, block * BLOCK_PX), min(width - 1, (block + 1) * BLOCK_PX)
                here, left, right = mean[y, start:stop], mean[y, start - 1 : stop - 1], mean[y, start + 1 : stop + 1]
                here2, left2, right2 = mean[y2, start:stop], mean[y2, start - 1 : stop - 1], mean[y2, start + 1 : stop + 1]
                up, down, up2, down2 = (
                    mean[y - 1, start:stop],
                    mean[y + 1, start:stop],
                    mean[y2 - 1, start:stop],
                    mean[y2 + 1, start:stop],
                )
                k, q, e = counts[y, start:stop], variance[y, start:stop], dark[y, start:stop]
                k2, q2, e2 = counts[y2, start:stop], variance[y2, start:stop], dark[y2, start:stop]
                xx = xy = yy = xr = yr = xm = ym = mm = mr = rr = vv = ms = zero
                for t in range(stop - start):
                    gx, gy, m, r, v, w = _terms(here[t], right[t] - left[t], down[t] - up[t], k[t], q[t], e[t], n, True)
                    gx2, gy2, m2, r2, v2, w2 = _terms(
                        here2[t], right2[t] - left2[t], down2[t] - up2[t], k2[t], q2[t], e2[t], n, both
                    )
                    wx, wy, wm, wx2, wy2, wm2 = w * gx, w * gy, w * m, w2 * gx2, w2 * gy2, w2 * m2
                    xx += wx * gx + wx2 * gx2
                    xy += wx * gy + wx2 * gy2
                    yy += wy * gy + wy2 * gy2
                    xr += wx * r + wx2 * r2
                    yr += wy * r + wy2 * r2
                    xm += wx * m + wx2 * m2
                    ym += wy * m + wy2 * m2
                    mm += wm * m + wm2 * m2
                    mr += wm * r + wm2 * r2
                    rr += r + r2
                    vv += v + v2
                    ms += m + m2
                cell = sums[block_row, block]
                cell[GXX] += xx
                cell[GXY] += xy
                cell[GYY] += yy
                cell[GX_R] += xr
                cell[GY_R] += yr
                cell[GX_M] += xm
                cell[GY_M] += ym
                cell[M_M] += mm
                cell[M_R] += mr
                cell[R] += rr
                cell[V] += vv
                cell[M] += ms


@compiled
def _terms(  # noqa: PLR0917
    mean: np.float32,
    across: np.float32,
    along: np.float32,
    counts: np.float32,
    variance: np.float32,
    dark: np.float32,
    n: np.float32,
    used: bool,
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Return gx, gy, m, r, v and 1 / v of a pixel: see `GXX`; m, r, v and 1 / v are 0 if it is not known, or not `used`."""
    half, zero, one = np.float32(0.5) * n, np.float32(0), np.float32(1)
    m = mean * n
    r = np.float32(counts) - m
    known = (r == r) & (variance > zero) & used
    v = n * (variance + dark) if known else zero
    w = one / v if known else zero
    return across * half, along * half, m if known else zero, r if known else zero, v, w


@compiled
def add_pixel_sums(  # noqa: PLR0917
    counts: NDArray[np.float32] | NDArray[np.uint8],
    n_frames: float,
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    residual: NDArray[np.float32],
    total: NDArray[np.float32],
    slopes: NDArray[np.float32],
    velocity: NDArray[np.float32],
) -> None:
    """Add residuals and expected counts to the sums (H, W) of each pixel; not known are NaN counts, and those of variance 0.

    `counts` are summed over `n_frames`, mean and variance are those of one. `slopes` (6, H, W) are gx gx / v, gx r / v,
    gy gy / v and gy r / v of pixels inside the frame, see `GXX`, and gt gt / v and gt r / v, with gt the change within a frame
    period of an image that moves by the `velocity` (2,) in px.
    """
    n, zero = np.float32(n_frames), np.float32(0)
    for y in range(mean.shape[0]):
        k, m, q, residuals, totals = counts[y], mean[y], variance[y], residual[y], total[y]
        for t in range(len(k)):
            expected = m[t] * n
            r = np.float32(k[t]) - expected
            known = r == r and q[t] > zero
            residuals[t] += r if known else zero
            totals[t] += expected if known else zero
    for y in range(1, mean.shape[0] - 1):
        k, m, q, up, down = counts[y], mean[y], variance[y], mean[y - 1], mean[y + 1]
        xx, xr, yy, yr, tt, tr = slopes[0, y], slopes[1, y], slopes[2, y], slopes[3, y], slopes[4, y], slopes[5, y]
        for t in range(1, len(k) - 1):
            gx, gy, _, r, _, w = _terms(m[t], m[t + 1] - m[t - 1], down[t] - up[t], k[t], q[t], zero, n, True)
            xx[t] += w * gx * gx
            xr[t] += w * gx * r
            yy[t] += w * gy * gy
            yr[t] += w * gy * r
            gt = velocity[0] * gx + velocity[1] * gy
            tt[t] += w * gt * gt
            tr[t] += w * gt * r


class Totals(NamedTuple):
    """Sums over spans that `fold` adds to: (h, w) for blocks of the sensor, (H', W') for squares of the panorama."""

    blocks: NDArray[np.float64]  # (h, w, 12) sums over time
    block_chi2: NDArray[np.float64]  # squared residuals of blocks / their variance
    block_count: NDArray[np.float64]  # number of blocks in these sums
    cell_chi2: NDArray[np.float64]  # the same, by the square of the panorama that a block falls on
    cell_count: NDArray[np.float64]  # number of blocks in these sums
    cell_noise: NDArray[np.float64]  # variance of the residuals, relative to the squared prediction
    pixel_residual: NDArray[np.float32]  # (H, W) residuals of each pixel: see `add_pixel_sums`
    pixel_mean: NDArray[np.float32]  # (H, W) expected counts
    pixel_slopes: NDArray[np.float32]  # (6, H, W)

    @classmethod
    def zeros(cls, shape: tuple[int, int], canvas_shape: tuple[int, int]) -> Totals:
        """Return no sums, for frames and a panorama of these shapes."""
        grid, cells = n_blocks(shape), n_blocks(canvas_shape)
        of_blocks = np.zeros((*grid, N_SUMS)), np.zeros(grid), np.zeros(grid)
        of_cells = np.zeros(cells), np.zeros(cells), np.zeros(cells)
        return cls(*of_blocks, *of_cells, *(np.zeros((*n, *shape), np.float32) for n in ((), (), (6,))))

    def plus(self, other: Totals) -> Totals:
        """Return the sums over both."""
        both: Iterable[tuple[Any, Any]] = zip(self, other, strict=True)
        return Totals._make(one + another for one, another in both)


@compiled
def fold(  # noqa: PLR0917
    sums: NDArray[np.float32],
    lever: NDArray[np.float64],
    middle: NDArray[np.float64],
    to_canvas: NDArray[np.float64],
    variance_share: float,
    normal: NDArray[np.float64],
    gradient: NDArray[np.float64],
    totals: Totals,
) -> float:
    """Add up the blocks of a span: the equations of its motion and gain, and squared residual / variance.

    Args:
        sums: (h, w, 12) of the span.
        lever: (h, w, 2) centres of the blocks, relative to the centre of the frame.
        middle: (h, w, 2) centres of the blocks, in pixels of the frame.
        to_canvas: (3, 3), pixels of the frame to pixels of the panorama.
        variance_share: expected variance of residuals, relative to that of the photons.
        normal: (5, 5), added to: see `Residuals`.
        gradient: (5,), added to.
        totals: added to.

    Returns:
        Mean over the blocks of squared residual / variance; 1 if no block has photons enough.
    """
    height, width = sums.shape[:2]
    total, n = 0.0, 0.0
    moves = np.zeros((4, 2))
    for y in range(height):
        for x in range(width):
            cell = sums[y, x]
            if cell[V] <= 0:
                continue
            moves[0, 0] = moves[1, 1] = 1
            moves[2, 0], moves[2, 1] = -lever[y, x, 1], lever[y, x, 0]
            moves[3, 0], moves[3, 1] = lever[y, x, 0], lever[y, x, 1]
            for i in range(4):
                a, b = moves[i]
                for j in range(4):
                    c, d = moves[j]
                    normal[i, j] += a * c * cell[GXX] + (a * d + b * c) * cell[GXY] + b * d * cell[GYY]
                mixed = a * cell[GX_M] + b * cell[GY_M]
                normal[i, 4] += mixed
                normal[4, i] += mixed
                gradient[i] += a * cell[GX_R] + b * cell[GY_R]
            normal[4, 4] += cell[M_M]
            gradient[4] += cell[M_R]
            for s in range(N_SUMS):
                totals.blocks[y, x, s] += cell[s]
            if cell[V] < _FEWEST_PHOTONS:
                continue
            reduced_chi2 = float(cell[R]) ** 2 / (float(cell[V]) * variance_share)
            total += reduced_chi2
            n += 1
            totals.block_chi2[y, x] += reduced_chi2
            totals.block_count[y, x] += 1
            px, py = middle[y, x]
            depth = to_canvas[2, 0] * px + to_canvas[2, 1] * py + to_canvas[2, 2]
            i = int(np.floor((to_canvas[1, 0] * px + to_canvas[1, 1] * py + to_canvas[1, 2]) / depth / BLOCK_PX))
            j = int(np.floor((to_canvas[0, 0] * px + to_canvas[0, 1] * py + to_canvas[0, 2]) / depth / BLOCK_PX))
            if 0 <= i < totals.cell_chi2.shape[0] and 0 <= j < totals.cell_chi2.shape[1]:
                totals.cell_chi2[i, j] += reduced_chi2
                totals.cell_count[i, j] += 1
                totals.cell_noise[i, j] += float(cell[V]) * variance_share / float(cell[M]) ** 2
    return total / n if n > 0 else 1.0
