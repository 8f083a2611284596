"""Locator `profile-shift`: estimate a shift from the row and column profiles of two exposures."""

import numpy as np
from numpy.typing import NDArray

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import transform_points, translation
from photonpano.locating import ImageLimits, View, motion_from_images, view_of
from photonpano_example.profiles import offset, profile

ROUNDS = 8
NEAR_PX = 2
CONVERGED_PX = 0.01
TRANSLATION = (4, 5)
"""Indices, from 0, of the parameters p1 to p8 that a shift changes."""


class ProfileShift:
    """Compares the column means, and the row means, of two images: they hold little photon noise."""

    def __init__(self, blur_px: float, reach: float) -> None:
        self.blur_px, self.reach = blur_px, reach

    def describe(self, exposure: VirtualExposure) -> View:
        """Return the exposure as a blurred, variance-stabilised image with weights."""
        return view_of(exposure, self.blur_px)

    def register(self, moving: View, fixed: View, initial: NDArray[np.float64] | None) -> Located | NotLocated:
        """Estimate the shift of `moving` onto `fixed`, starting from `initial`; see `photonpano.Locator`."""
        middle = (np.array([moving.shape[::-1]]) - 1) / 2
        x, y = (0.0, 0.0) if initial is None else (transform_points(initial, middle) - middle)[0]
        furthest = int(self.reach * max(moving.shape))
        for _ in range(ROUNDS):
            there = fixed.seen_from(translation(x, y))
            both = moving.seen & there.seen
            right, down = (
                offset(profile(moving.image, both, axis), profile(there.image, both, axis), furthest) for axis in (0, 1)
            )
            x, y, furthest = x + right, y + down, NEAR_PX
            if max(abs(right), abs(down)) < CONVERGED_PX:
                break
        return motion_from_images(moving, fixed, translation(x, y), ImageLimits(), free=TRANSLATION)
