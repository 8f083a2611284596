"""The base of locators that match points: homographies, or rotations of a camera that only turns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from copy import copy
from typing import Any, Self

from photonpano.locating.configs import MatchingConfig
from photonpano.locating.matched_turns import turn_of
from photonpano.locating.points import Matches
from photonpano.values import FloatArray, Homography, Located, NotLocated

# Matches that agree on a homography and determine its eight numbers: of as many, blurred against the noise of dark exposures,
# the corners are certain to about a pixel.
_DETERMINED = 100


class PointLocator(ABC):
    """Locates pairs from matched points: see `photonpano.Locator` and `photonpano.LocatesTurns`.

    A homography has eight numbers. Where matches do not determine them, and the camera only turns, the three of a rotation are
    tried. What `describe` returns has a `shape`, the (height, width) of the exposure.
    """

    _config: MatchingConfig
    _rounding_px = 0.0
    _camera_matrix: FloatArray | None = None

    def turning(self, camera_matrix: FloatArray) -> Self:
        """Return this locator for a camera that only turns.

        Args:
            camera_matrix: (3, 3), in px of the exposures; the lens does not distort.
        """
        turning = copy(self)
        turning._camera_matrix = camera_matrix
        return turning

    def register(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when too few points match or agree, when they leave the corners of the
            frame uncertain, or when no camera moves like that.
        """
        motion = self._homography(moving, fixed, initial)
        if self._camera_matrix is None:
            return motion
        # The number that agreed at first: near their final motion some matches are chance.
        if isinstance(motion, Located) and motion.evidence.get("agreeing", motion.evidence["inliers"]) >= _DETERMINED:
            return motion
        matches = self._matches(moving, fixed, initial)
        evidence = {name: number for name, number in motion.evidence.items() if name.startswith("keypoints")}
        turn = turn_of(matches, moving.shape, self._config, self._camera_matrix, evidence, self._rounding_px)
        if isinstance(motion, Located) or isinstance(turn, Located):
            return turn if isinstance(turn, Located) else motion
        return NotLocated(f"{motion.reason}; as a rotation: {turn.reason}", motion.evidence)

    @abstractmethod
    def _homography(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Match, and fit a homography."""

    @abstractmethod
    def _matches(self, moving: Any, fixed: Any, initial: Homography | None) -> Iterator[Matches]:
        """Yield the matches near the positions that `initial` predicts if there is one, then those in the whole image."""
