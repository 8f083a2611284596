"""Interpolation of the eight parameters of the homography (paper, section 4, "Interpolate")."""

from __future__ import annotations

from photonpano import FloatArray
from photonpano.geometry import parameters
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.trajectories import ParameterTrajectory, interpolating_spline


class LucasKanadeInterpolator:
    """Fits a cubic spline of p1..p8 through the knots."""

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> ParameterTrajectory:
        """Interpolate; the information is not used, since the spline passes through every knot."""
        del information
        spline = interpolating_spline(instants, parameters(homographies))
        return ParameterTrajectory(instants, spline, self._config.hold_frames)
