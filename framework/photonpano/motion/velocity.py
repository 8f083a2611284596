"""A constant velocity of the image: it turns and shifts by the same amount from each frame to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from photonpano.values import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """A constant velocity of the image.

    Convention:
        Points are (x, y), y down, integers are pixel centres. A positive turn is clockwise as one sees the picture.

    Attributes:
        turn: of the image, in radians per frame period.
        shift: (2,) velocity of what is at `middle`, in px per frame period.
        middle: (2,) point of the frame.
    """

    turn: float
    shift: FloatArray
    middle: FloatArray

    @property
    def centre(self) -> FloatArray:
        """The (2,) point about which the image turns; not finite if it only shifts."""
        x, y = self.shift
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.middle + np.divide([-y, x], self.turn))

    def after(self, periods: ArrayLike) -> FloatArray:
        """Return where the image is N times some frame periods later: (N, 3, 3) from pixels now to pixels then."""
        periods = np.asarray(periods, dtype=np.float64)
        angles = self.turn * periods
        cosine, sine = np.cos(angles), np.sin(angles)
        moved = np.zeros((len(periods), 3, 3))
        moved[:, 0, 0], moved[:, 0, 1], moved[:, 1, 0], moved[:, 1, 1], moved[:, 2, 2] = cosine, -sine, sine, cosine, 1
        shifts = periods[:, None] * mean_shift(self.shift, angles)
        moved[:, :2, 2] = self.middle + shifts - moved[:, :2, :2] @ self.middle
        return moved


class ConstantVelocity:
    """The trajectory of an image that moves at a constant velocity.

    Args:
        velocity: of the image.
        reference: the frame whose homography is the identity.
    """

    def __init__(self, velocity: Velocity, reference: float) -> None:
        self._velocity, self._reference = velocity, reference

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, in frames, to the reference frame: (N, 3, 3)."""
        return self._velocity.after(self._reference - np.asarray(frame_indices, dtype=np.float64))


def mean_shift(shift: FloatArray, angle: ArrayLike) -> FloatArray:
    """Return the mean of shifts that turn at a constant rate: (..., 2).

    Args:
        shift: (..., 2) at first.
        angle: (...) in radians, by which they turn in all.
    """
    angle = np.asarray(angle, dtype=np.float64)
    along, across = np.sinc(angle / np.pi), np.sinc(angle / 2 / np.pi) * np.sin(angle / 2)
    x, y = shift[..., 0], shift[..., 1]
    return np.stack([along * x - across * y, across * x + along * y], axis=-1)
