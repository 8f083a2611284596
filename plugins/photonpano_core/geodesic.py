"""Geodesic interpolation of homographies (Fragneto and others 2012; named in the paper, section 4, "Interpolate")."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_core.configs import GeodesicConfig
from photonpano_core.group_spline import GroupTrajectory


class GeodesicInterpolator:
    """Goes from each knot to the next along a power of the motion between them.

    Between the knots G and H it is G (G^-1 H)^s, where s goes from 0 to 1: constant velocity, and a kink at each knot. It is
    the cumulative B-spline of degree 1 whose control points are the knots.
    """

    def __init__(self, config: GeodesicConfig) -> None:
        self._config = config

    def fit(
        self,
        instants: NDArray[np.float64],
        homographies: NDArray[np.float64],
        information: NDArray[np.float64] | None,
    ) -> GroupTrajectory:
        """Interpolate; the information is not used, since the curve goes through every knot.

        Raises:
            LocationError: two knots are half a turn or more apart, so that the motion between them has no real logarithm.
        """
        del information
        return GroupTrajectory(instants, homographies, 1, self._config.hold_frames)
