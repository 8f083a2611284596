"""Contract checks of the motions that locators return."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real

import numpy as np

from photonpano.errors import PluginError
from photonpano.geometry import corner_displacements
from photonpano.motion.attribution import BrokenContract
from photonpano.motion.level import FrameHomography, Level
from photonpano.text import listed
from photonpano.values import Edge, FloatArray, Homography, Located, NotLocated

STILL_SHARE = 0.1
"""The identity is refused if the motion known so far moves the corners by at least this share of the shorter side of a frame.
For less it may be right: the motion of the first level is off by a few pixels, and some locators return whole pixels."""


def require_valid(motion: object) -> Located | NotLocated:
    """Return what a locator returned for a pair, once its types, shapes and values are checked.

    Raises:
        BrokenContract: it is neither `Located` with finite numbers nor `NotLocated`.
    """
    if not isinstance(motion, Located | NotLocated):
        raise BrokenContract(f"expected Located or NotLocated, got {type(motion).__name__}")
    for key, value in motion.evidence.items():
        if not isinstance(value, Real | np.generic):
            raise BrokenContract(f"evidence consists of numbers, got {key} = {value!r:.60}")
    if isinstance(motion, NotLocated):
        return motion
    matrix, information = np.asarray(motion.homography), motion.information
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or matrix[2, 2] == 0:
        raise BrokenContract(
            f"a homography is a finite (3, 3) matrix with h33 = 1, got {matrix.tolist()}; a failure is NotLocated"
        )
    if information is not None and not _is_positive_definite(np.asarray(information)):
        raise BrokenContract(
            "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
        )
    return motion


def require_no_standstill(motion: Located, expected: FrameHomography | None, frame_shape: tuple[int, int]) -> None:
    """Refuse the identity as the motion of a pair if the motion known so far is far from it.

    Args:
        motion: what a locator returned, in any unit: the identity is the same in all.
        expected: (3, 3) the motion known so far; None at the first level.
        frame_shape: (height, width) of a frame.

    Raises:
        BrokenContract: the locator returned the identity instead of a failure.
    """
    if expected is None or not _is_identity(motion.homography):
        return
    expected_px = corner_displacements(expected, np.eye(3), frame_shape).mean()
    if expected_px >= STILL_SHARE * min(frame_shape):
        raise BrokenContract(
            f"got the identity where the motion known so far moves the corners by {expected_px:.0f} px; a failure is NotLocated"
        )


def require_motion(level: Level, edges: Sequence[Edge]) -> None:
    """Refuse a level where every located pair is exactly the identity: the locator does not report its failures.

    Because of photon noise, a camera that stands still gives nearly the identity, and never exactly.

    Raises:
        PluginError: every located pair is exactly the identity.
    """
    located = [(edge.locator, edge.motion.homography) for edge in edges if isinstance(edge.motion, Located)]
    if not located or not all(_is_identity(homography) for _, homography in located):
        return
    names = {name for name, _ in located}
    origins = listed(locator.origin for locator in level.locators if locator.name in names)
    raise PluginError(
        f"{origins} broke {'its' if len(names) == 1 else 'their'} contract at level {level.number}: every pair that was "
        "located is exactly the identity, which a camera that stands still does not give; a failure is NotLocated"
    )


def _is_identity(homography: Homography) -> bool:
    """Return whether a map is the identity to within rounding."""
    return bool(np.abs(np.asarray(homography) - np.eye(3)).max() < 1e-9)


def _is_positive_definite(matrix: FloatArray) -> bool:
    if matrix.shape != (8, 8) or not np.all(np.isfinite(matrix)):
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
