"""Coarse-to-fine alignment of brightness: what all backends that descend on image pyramids share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from photonpano.geometry import rescaled
from photonpano.locating.viewing import View
from photonpano.values import Homography, NotLocated

ALL_PARAMETERS = (0, 1, 2, 3, 4, 5, 6, 7)  # indices of p1..p8
TRANSLATION = (4, 5)  # indices of the parameters of a translation, p5 and p6
_AFFINE = (0, 1, 2, 3, 4, 5)
# Prior standard deviation of p1..p4, p7 and p8 in unit coordinates: between two exposures a camera rolls by 1 or 2 degrees, and
# scale, shear and perspective change as little.
PRIOR_STD = 0.03
MIN_COMMON_CURVATURE = 1e-3  # floor on the eigenvalues of the curvature that two images have in common, relative to their own
SMALLEST_SIDE = 24  # images are not halved to fewer pixels than this along a side

# Reasons of `NotLocated`.
NO_TEXTURE = "the images do not overlap, or there is no texture where they do"
NOTHING_SEEN = "all pixels are masked, or too near to masked ones"


def free_parameters(depth: int, layers: int) -> tuple[int, ...]:
    """Return which of p1..p8 to estimate on a layer of a pyramid.

    Few pixels determine few parameters: a translation on the coarsest layer, an affine map on the next, then all eight.

    Args:
        depth: number of the layer, 0 for the finest. The finest layer always estimates all eight.
        layers: number of layers of the pyramid.
    """
    from_coarsest = layers - 1 - depth
    return (TRANSLATION, _AFFINE)[from_coarsest] if depth > 0 and from_coarsest < 2 else ALL_PARAMETERS


def coarse_to_fine(
    moving: Sequence[View],
    fixed: Sequence[View],
    start: Homography,
    align: Callable[[View, View, Homography, int], Homography | NotLocated],
) -> tuple[list[Homography], NotLocated | None]:
    """Align two pyramids layer by layer. A layer that fails is skipped: the next one starts where it started.

    Args:
        moving: views of one exposure, finest first.
        fixed: views of the other one.
        start: (3, 3) initial map, in pixels of the finest views.
        align: returns the map between two views, given an initial one and the depth of the layer, in pixels of these views.

    Returns:
        The maps of the layers that could be aligned, coarsest first, in pixels of the finest views; and why the finest layer
        could not be aligned, None if it could.
    """
    found: list[Homography] = []
    failure = None
    for depth in reversed(range(len(moving))):
        pixel = moving[depth].pixel
        outcome = align(moving[depth], fixed[depth], rescaled(start, 1 / pixel), depth)
        failure = outcome if isinstance(outcome, NotLocated) else None
        if not isinstance(outcome, NotLocated):
            start = rescaled(outcome, pixel)
            found.append(start)
    return found, failure
