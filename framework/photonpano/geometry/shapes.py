"""Test whether a homography between two images of one camera is possible. Compiled, for every step of an alignment."""

from __future__ import annotations

import numpy as np

from photonpano.compiling import compiled
from photonpano.values import Homography

MAX_AREA_CHANGE = 2.0  # largest ratio of the areas of two overlapping images of one camera
MAX_SIDE_CHANGE = 1.5  # largest ratio of opposite sides, which perspective changes
# Results of `violation`: possible, not finite, points behind the camera, mirrored or folded, implausible change of the area or
# of the ratio of opposite sides.
PLAUSIBLE, INFINITE, BEHIND, FOLDED, AREA, SIDES = range(6)


@compiled
def violation(homography: Homography, height: int, width: int) -> tuple[int, float]:
    """Return why a homography between two images of one camera is impossible, and the number that decides; `PLAUSIBLE` if not.

    It maps pixels of the moving image to those of the fixed one, both of `height` rows and `width` columns.
    """
    for row in range(3):
        for column in range(3):
            if not np.isfinite(homography[row, column]):
                return INFINITE, 0.0
    u, v, sides = np.empty(4), np.empty(4), np.empty(4)
    for corner in range(4):
        x, y = (width - 1.0) * (corner in (1, 2)), (height - 1.0) * (corner in (2, 3))
        depth = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
        u[corner] = homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]
        v[corner] = homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]
        if depth <= 0:
            return BEHIND, depth
        u[corner] /= depth
        v[corner] /= depth
    area = 0.0
    for here in range(4):
        there, beyond = (here + 1) % 4, (here + 2) % 4
        du, dv = u[there] - u[here], v[there] - v[here]
        turn = du * (v[beyond] - v[there]) - dv * (u[beyond] - u[there])
        if turn <= 0:
            return FOLDED, float(turn)
        sides[here] = np.sqrt(du * du + dv * dv)
        area += (u[here] * v[there] - u[there] * v[here]) / 2
    change = area / ((width - 1) * (height - 1))
    if not 1 / MAX_AREA_CHANGE < change < MAX_AREA_CHANGE:
        return AREA, change
    for side in range(2):
        ratio = max(sides[side], sides[side + 2]) / min(sides[side], sides[side + 2])
        if ratio > MAX_SIDE_CHANGE:
            return SIDES, ratio
    return PLAUSIBLE, 0.0
