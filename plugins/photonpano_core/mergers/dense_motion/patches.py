"""Square patches that overlap by half: their search in another image, and their sums along a motion. Compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano_core.mergers.dense_motion.warping import Frames

Image = NDArray[np.float32]

_ROUNDED_UP = 1 + 1e-6


@dataclass(frozen=True, slots=True)
class PatchGrid:
    """Patches at steps of half a side, from half a side before the image, so that each pixel lies in four."""

    shape: tuple[int, int]  # (height, width) of the image
    side: int  # of a patch, in px, even

    @property
    def step(self) -> int:
        """Distance of neighbouring patches, in px."""
        return self.side // 2

    @property
    def n_patches(self) -> tuple[int, int]:
        """Number of patches along y and along x."""
        return -(-self.shape[0] // self.step) + 1, -(-self.shape[1] // self.step) + 1

    def joined(self, patches: Image) -> Image:
        """Blend patches, (rows, columns, side, side), with windows of raised cosines, which add up to 1: (H, W)."""
        half = self.step
        window = 0.5 - 0.5 * np.cos(np.pi * (np.arange(self.side) + 0.5) / half)
        # Slightly more than 1, so that rounding does not turn one frame into less.
        patches = patches * (np.outer(window, window) * _ROUNDED_UP).astype(np.float32)
        rows, columns = self.n_patches
        image = np.zeros(((rows + 1) * half, (columns + 1) * half), np.float32)
        for down in range(2):
            for right in range(2):
                # The quarters of all patches lie side by side.
                quarters = patches[:, :, down * half : (down + 1) * half, right * half : (right + 1) * half]
                quarters = quarters.swapaxes(1, 2).reshape(rows * half, columns * half)
                image[down * half : (down + rows) * half, right * half : (right + columns) * half] += quarters
        return np.ascontiguousarray(image[half : half + self.shape[0], half : half + self.shape[1]])


@compiled
def add_patches(summed: Frames, shifts: NDArray[np.float64], step: int, counts: Image, weight: Image) -> None:
    """Add an image to patches, shifted and interpolated bilinearly; the image is 0 outside of its border.

    The pixel p of a patch is read at p + shift, for `shifts` x and y (rows, columns, 2). `counts` and `weight` are (rows,
    columns, side, side), added to; `step` is the distance of neighbouring patches, in px.
    """
    image, weights = summed.image, summed.weights
    height, width = image.shape
    rows, columns, side = counts.shape[0], counts.shape[1], counts.shape[2]
    for i in range(rows):
        for j in range(columns):
            x, y = (j - 1) * step + shifts[i, j, 0], (i - 1) * step + shifts[i, j, 1]
            left, top = int(np.floor(x)), int(np.floor(y))
            a, b = np.float32(x - left), np.float32(y - top)
            one = np.float32(1)
            for row in range(side):
                for corner in range(4):
                    down, right = corner // 2, corner % 2
                    source, start = top + row + down, left + right
                    first, last = max(0, -start), min(side, width - start)
                    if not 0 <= source < height or first >= last:
                        continue
                    factor = (b if down else one - b) * (a if right else one - a)
                    frames = factor * np.float32(summed.number)
                    lit, seen = image[source, start + first : start + last], weights[source, start + first : start + last]
                    to, of = counts[i, j, row, first:last], weight[i, j, row, first:last]
                    for t in range(len(to)):
                        to[t] += factor * lit[t]
                        of[t] += frames * seen[t]


@compiled
def search(
    fixed: Image, moving: Image, side: int, starts: NDArray[np.int64], radius: int, found: NDArray[np.float64], costs: Image
) -> None:
    """Find each patch of `fixed`, (h, w), in `moving`, by the mean squared difference over the pixels that both show.

    Args:
        fixed: (h, w) where patches are cut out.
        moving: (h, w) where they are searched.
        side: of a patch, in px.
        starts: (S, rows, columns, 2) displacements x and y; the search goes on around the best.
        radius: largest distance from it, along x and along y.
        found: (rows, columns, 2) output, displacements, between pixels by a parabola.
        costs: (rows, columns, 2) output, costs of no displacement and of the one found; infinite without overlap.
    """
    step = side // 2
    around = np.empty((2 * radius + 3, 2 * radius + 3))
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            x, y = (j - 1) * step, (i - 1) * step
            best, at_x, at_y = np.inf, 0, 0
            for s in range(len(starts)):
                cost = _difference(fixed, moving, x, y, side, starts[s, i, j, 0], starts[s, i, j, 1])
                if cost < best:
                    best, at_x, at_y = cost, starts[s, i, j, 0], starts[s, i, j, 1]
            least, row, column = np.inf, radius + 1, radius + 1
            for down in range(2 * radius + 3):
                for right in range(2 * radius + 3):
                    cost = _difference(fixed, moving, x, y, side, at_x + right - radius - 1, at_y + down - radius - 1)
                    around[down, right] = cost
                    inside = 1 <= down <= 2 * radius + 1 and 1 <= right <= 2 * radius + 1
                    if inside and cost < least:
                        least, row, column = cost, down, right
            found[i, j, 0] = at_x + column - radius - 1 + _vertex(around[row, column - 1], least, around[row, column + 1])
            found[i, j, 1] = at_y + row - radius - 1 + _vertex(around[row - 1, column], least, around[row + 1, column])
            costs[i, j, 0], costs[i, j, 1] = _difference(fixed, moving, x, y, side, 0, 0), least


@compiled
def _difference(fixed: Image, moving: Image, x: int, y: int, side: int, right: int, down: int) -> float:
    """Return the mean squared difference of a patch and a displaced one; infinite if they share under half of their pixels."""
    height, width = fixed.shape
    first, last = max(0, x, -right), min(width, x + side, width - right)
    total, n = np.float32(0), 0
    for row in range(max(0, y, -down), min(height, y + side, height - down)):
        if first >= last:
            break
        mine, other = fixed[row, first:last], moving[row + down, first + right : last + right]
        for t in range(len(mine)):
            total += (mine[t] - other[t]) ** 2
        n += len(mine)
    inside = max(0, min(width, x + side) - max(0, x)) * max(0, min(height, y + side) - max(0, y))
    if n == 0 or 2 * n < inside:
        return np.inf
    return float(total) / n


@compiled
def _vertex(before: float, least: float, after: float) -> float:
    """Return where a parabola through three costs is least, from -0.5 to 0.5."""
    if not (least < before < np.inf and least < after < np.inf):
        return 0.0
    return float(0.5 * (before - after) / (before - 2 * least + after))
