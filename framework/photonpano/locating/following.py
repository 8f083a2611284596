"""Find the part of an image that follows a motion; objects that move by themselves do not follow that of the camera."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray

_SIDE_PX = 7  # side of the square in which two images are compared, px
# Relative variance of the difference of two aligned images from which on they differ: 0 for equal, 1 for unrelated images.
_DIFFERENT = 0.5
_STANDARD_ERRORS = 4.0  # by which the variances must exceed those of noise
_ALIKE = 0.25  # largest relative variance of an aligned part
_BORDER_PX = 2  # width of the mixed border around parts that move otherwise, px
_REST_PX = 4.0  # standard deviation of the Gaussian that smooths the weights of what does not follow, px
_SUSPECT = 0.12  # mean difference, each at most 0.5, above which other motions are tried: noise and blur leave less
# Share of the image from which on a part that shows something different may move otherwise: noise leaves no such part.
_SUSPECT_SHARE = 0.03
_CLEARLY = 0.5  # a pixel clearly follows the motion that leaves less than half of the difference of another one


class Follows(NamedTuple):
    """What follows a motion."""

    # (H, W) float32, local variance of the difference of the aligned images relative to the sum of their variances, from 0 to
    # 1; NaN without enough texture
    difference: NDArray[np.float32]

    @property
    def part(self) -> BoolArray:
        """(H, W), True where the image follows, and where it lacks texture."""
        return ~(self.difference > _ALIKE)

    @property
    def inner(self) -> BoolArray:
        """(H, W), that part without the border of larger parts that do not follow."""
        beyond = cv2.dilate(_opened(~self.part), np.ones((2 * _BORDER_PX + 1, 2 * _BORDER_PX + 1), np.uint8)) > 0
        return np.asarray(self.part & ~beyond)

    @property
    def rest(self) -> NDArray[np.float32]:
        """(H, W) weights of what does not follow, without edges that would correlate with themselves."""
        smooth = cv2.GaussianBlur(np.nan_to_num(self.difference), (0, 0), _REST_PX)
        return np.asarray(np.maximum(2 * smooth / max(float(smooth.max()), 1e-6) - 1, 0), np.float32)

    def rather_than(self, other: Follows) -> BoolArray:
        """(H, W), True where the image clearly follows this motion and not another one."""
        return np.asarray(self.difference < _CLEARLY * other.difference)

    @property
    def suspect(self) -> bool:
        """Whether a part of the image may move otherwise."""
        textured = self.difference[np.isfinite(self.difference)]
        mean = float(np.minimum(textured, _DIFFERENT).mean()) if textured.size else 0.0
        return mean > _SUSPECT or float(_opened(self.difference > _DIFFERENT).mean()) > _SUSPECT_SHARE

    def extent_beyond(self, other: Follows) -> float:
        """Return how large the part is that clearly follows this motion and not another one, and how far it spreads.

        The scene surrounds an object, so an area counts by its extent: the number of its pixels times the standard deviations
        of their coordinates.
        """
        y, x = np.nonzero(self.rather_than(other))
        return float(len(y) * y.std() * x.std()) if len(y) else 0.0

    def more_than(self, other: Follows, trust: float = 1.0) -> bool:
        """Whether the part that clearly follows this motion is larger, and spreads further, than that of another motion.

        Args:
            other: what follows the other motion.
            trust: factor on the extent of this part, for a motion that is known from elsewhere.
        """
        return trust * self.extent_beyond(other) > other.extent_beyond(self)


def follows(
    moving: NDArray[np.float32], fixed: NDArray[np.float32], noise: NDArray[np.float32], noise_left: float = 1.0
) -> Follows:
    """Find the part of an image that follows the motion by which another one was aligned to it.

    Args:
        moving: (H, W) the image.
        fixed: (H, W) the other one, seen along the motion.
        noise: (H, W) variance of the noise of their difference; infinite where either was not seen.
        noise_left: share of the variance of white noise that the blur of the images left, which makes neighbours alike.
    """
    seen = np.isfinite(noise).astype(np.float32)
    near = _averaged(seen)
    own = np.asarray(_averaged(np.where(seen > 0, noise, np.float32(0))) / np.maximum(near, np.float32(1e-6)), np.float32)
    difference, first, second = (_variance(image * seen, near) for image in (fixed - moving, moving, fixed))
    chance = np.float32(_STANDARD_ERRORS * np.sqrt(2 / (_SIDE_PX**2 * noise_left))) * own
    texture = first + second - own
    textured = (near > _DIFFERENT) & (seen > 0) & (texture > chance)
    relative = np.clip((difference - own) / np.maximum(texture, np.float32(1e-12)), 0, 1)
    return Follows(np.where(textured, relative, np.float32(np.nan)).astype(np.float32))


def _opened(part: BoolArray) -> NDArray[np.uint8]:
    """Return the squares that fit into a part of an image: 1 there, 0 elsewhere."""
    square = np.ones((_SIDE_PX, _SIDE_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_OPEN, square), np.uint8)


def _variance(image: NDArray[np.float32], near: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the variance in the square around each pixel; `image` is 0 where nothing is seen."""
    near = np.maximum(near, np.float32(1e-6))
    return np.asarray(_averaged(image * image) / near - (_averaged(image) / near) ** 2, np.float32)


def _averaged(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.blur(image, (_SIDE_PX, _SIDE_PX)), np.float32)
