"""Interpolation of the eight parameters of the homography (paper, section 4, "Interpolate")."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline

from photonpano.geometry import from_parameters, parameters

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from photonpano_core.configs import LucasKanadeConfig


class LucasKanadeTrajectory:
    """A cubic spline of p1..p8 through the knots; fewer than four knots give a lower order.

    Beyond the first and last knot the velocity is held for a bounded distance, then the camera stands still: a cubic would run
    away. Frames out there are not located.
    """

    def __init__(self, instants: NDArray[np.float64], homographies: NDArray[np.float64], hold_frames: float | None) -> None:
        self._first, self._last = float(instants[0]), float(instants[-1])
        knots = parameters(homographies)
        if len(instants) == 1:
            instants, knots = np.array([self._first, self._first + 1]), np.repeat(knots, 2, axis=0)
        self._spline = make_interp_spline(instants, knots, k=min(3, len(instants) - 1))
        self._velocity = self._spline.derivative()
        spacing = (self._last - self._first) / max(1, len(homographies) - 1)
        self._hold = spacing if hold_frames is None else hold_frames

    def at(self, frame_indices: ArrayLike) -> NDArray[np.float64]:
        """Return the homographies of N instants: (N, 3, 3)."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        inside = np.clip(frames, self._first, self._last)
        beyond = np.clip(frames - inside, -self._hold, self._hold)
        return from_parameters(self._spline(inside) + self._velocity(inside) * beyond[:, None])

    def located(self, frame_indices: ArrayLike) -> NDArray[np.bool_]:
        """Tell which of N instants lie between the first and the last knot: (N,)."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        return (self._first <= frames) & (frames <= self._last)


class LucasKanadeInterpolator:
    """Fits `LucasKanadeTrajectory`."""

    def __init__(self, config: LucasKanadeConfig) -> None:
        self._config = config

    def fit(
        self,
        instants: NDArray[np.float64],
        homographies: NDArray[np.float64],
        information: NDArray[np.float64] | None,
    ) -> LucasKanadeTrajectory:
        """Interpolate; the information is not used, since the spline goes through every knot."""
        del information
        return LucasKanadeTrajectory(instants, homographies, self._config.hold_frames)
