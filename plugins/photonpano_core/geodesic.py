"""Geodesic interpolation of homographies (Fragneto et al. 2012; named in the paper, section 4, "Interpolate")."""

from __future__ import annotations

from photonpano import FloatArray
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.trajectories import GroupTrajectory


class GeodesicInterpolator:
    """Moves from each knot to the next along a power of the motion between them.

    Between the knots G and H the curve is G (G^-1 H)^s, with s from 0 to 1: the velocity is constant, with a kink at each knot.
    It is the cumulative B-spline of degree 1 whose control points are the knots.
    """

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> GroupTrajectory:
        """Interpolate; the information is not used, since the curve passes through every knot.

        Raises:
            LocationError: two knots are half a turn or more apart, so that the motion between them has no real logarithm.
        """
        del information
        return GroupTrajectory(instants, homographies, 1, self._config.hold_frames)
