"""Add warps of images to pixels that move by a polynomial of time beyond a homography. Compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled

_BLOCK = 512
"""Pixels whose places are computed at once, so that this is vectorised."""


@compiled
def add_along(
    image: NDArray[np.float32],
    worth: NDArray[np.float32],
    n_frames: float,
    to_image: NDArray[np.float64],
    places: NDArray[np.float64],
    motion: NDArray[np.float32],
    elapsed: float,
    counts: NDArray[np.float32],
    weight: NDArray[np.float32],
) -> None:
    """Add an image to some pixels of a grid, interpolated bilinearly; the image is 0 outside of its border.

    Args:
        image: (h, w) sum of frames.
        worth: (h, w) what a frame of each pixel is worth, from 0 to 1; (0, 0) if it is 1 for all.
        n_frames: number of frames in the sum.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        places: (2, N), x and y of the pixels of the grid.
        motion: (D, 2, N), coefficients of their motion on the grid: see `MotionField`.
        elapsed: the time at which they are displaced.
        counts: (N,) sums that are added to.
        weight: (N,) numbers of frames that are added to.
    """
    height, width = image.shape
    frames = np.float32(n_frames)
    us, vs = np.empty(_BLOCK), np.empty(_BLOCK)
    for start in range(0, places.shape[1], _BLOCK):
        stop = min(start + _BLOCK, places.shape[1])
        _place(to_image, places[:, start:stop], motion[:, :, start:stop], elapsed, us, vs)
        into, of = counts[start:stop], weight[start:stop]
        for i in range(stop - start):
            u, v = us[i], vs[i]
            if not (-1 < u < width and -1 < v < height):
                continue
            left, top = int(np.floor(u)), int(np.floor(v))
            a, b = np.float32(u - left), np.float32(v - top)
            if 0 <= left < width - 1 and 0 <= top < height - 1:
                above, below = image[top], image[top + 1]
                p = above[left] + a * (above[left + 1] - above[left])
                q = below[left] + a * (below[left + 1] - below[left])
                into[i] += p + b * (q - p)
                if worth.size:
                    above, below = worth[top], worth[top + 1]
                    p = above[left] + a * (above[left + 1] - above[left])
                    q = below[left] + a * (below[left + 1] - below[left])
                    of[i] += frames * (p + b * (q - p))
                else:
                    of[i] += frames
                continue
            for down in range(2):
                for right in range(2):
                    row, column = top + down, left + right
                    if 0 <= row < height and 0 <= column < width:
                        share = (b if down else 1 - b) * (a if right else 1 - a)
                        into[i] += share * image[row, column]
                        of[i] += share * frames * (worth[row, column] if worth.size else 1)


@compiled
def _place(
    to_image: NDArray[np.float64],
    places: NDArray[np.float64],
    motion: NDArray[np.float32],
    elapsed: float,
    us: NDArray[np.float64],
    vs: NDArray[np.float64],
) -> None:
    """Write where displaced pixels of the grid lie in the image; arguments as in `add_along`."""
    xs, ys = places[0], places[1]
    for i in range(len(xs)):
        us[i], vs[i] = xs[i], ys[i]
    power = 1.0
    for d in range(motion.shape[0]):
        power *= elapsed
        right, down = motion[d, 0], motion[d, 1]
        for i in range(len(xs)):
            us[i] += power * right[i]
            vs[i] += power * down[i]
    xx, xy, x1 = to_image[0, 0], to_image[0, 1], to_image[0, 2]
    yx, yy, y1 = to_image[1, 0], to_image[1, 1], to_image[1, 2]
    zx, zy, z1 = to_image[2, 0], to_image[2, 1], to_image[2, 2]
    for i in range(len(xs)):
        x, y = us[i], vs[i]
        per_depth = 1 / (zx * x + zy * y + z1)
        us[i] = (xx * x + xy * y + x1) * per_depth
        vs[i] = (yx * x + yy * y + y1) * per_depth
