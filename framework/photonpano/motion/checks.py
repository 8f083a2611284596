"""Contract checks of what components return: groups, motions of pairs, exposures, and trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import islice, pairwise
from numbers import Real
from typing import Any

import numpy as np

from photonpano.errors import PluginError
from photonpano.geometry import apply, corner_displacements, corners, jacobian
from photonpano.motion.attribution import BrokenContract, shown
from photonpano.motion.level import FrameHomography, Level
from photonpano.protocols import Trajectory
from photonpano.text import listed
from photonpano.values import Edge, FloatArray, Group, Homography, Located, NotLocated, VirtualExposure

STILL_SHARE = 0.1
"""The identity is refused if the motion known so far moves the corners by at least this share of the shorter side of a frame.
For less it may be right: the motion of the first level is off by a few pixels, and some locators return whole pixels."""
STILL_PX, MOVING_PX = 1e-3, 2.0
"""Pairs that move the corners by less are nearly the identity; an image that moves by this much between exposures moves."""
UNDETERMINED = 10.0
"""A pair whose motion has an expected error of this many sides of a frame ties nothing."""
KNOT_PX, KNOT_STDS = 1.0, 10.0
"""A trajectory may miss its knots by this many pixels, or this many of their expected errors."""
_LARGEST = 1e9
"""Numbers of a homography from this on are no motion of a camera, and overflow in later steps."""
_SAFE = 0.01
"""A margin of the bound on errors that the smallest pivot gives."""
_SMALLEST = 1e-100
"""A floor on eigenvalues."""
_ASYMMETRY = 1e-3
"""Information may be asymmetric by this share, because of rounding."""


def require_groups(found: Iterable[Any], n_frames: int) -> tuple[Group, ...]:
    """Return the groups that a resampler returned, once they are checked.

    Args:
        found: what it returned.
        n_frames: frames of the capture.

    Raises:
        BrokenContract: there is none, or they are not in order, or lie outside the capture.
    """
    # Instants are whole or half, so that there are fewer than two for each frame; a generator may have no end.
    groups = tuple(islice(found, 2 * n_frames))
    if len(groups) == 2 * n_frames:
        raise BrokenContract(f"the capture has {n_frames} frames, got {len(groups)} groups or more")
    for group in groups:
        ends = (group.span.start, group.span.stop) if isinstance(group, Group) else ()
        if not ends or not all(isinstance(end, int | np.integer) for end in ends):
            raise BrokenContract(f"expected groups, got {group!r:.60}")
    instants = [group.reference for group in groups]
    if not groups or any(later <= earlier for earlier, later in pairwise(instants)):
        raise BrokenContract(f"expected at least one group, in order, each instant once; got the instants {instants!s:.200}")
    if beyond := [str(group) for group in groups if group.span.stop > n_frames]:
        raise BrokenContract(f"the capture has {n_frames} frames (0 to {n_frames - 1}), got a group of {beyond[0]}")
    return groups


def require_valid(motion: object) -> Located | NotLocated:
    """Return what a locator returned for a pair, once its types, shapes and values are checked.

    Raises:
        BrokenContract: it is neither `Located` with finite numbers nor `NotLocated`.
    """
    if not isinstance(motion, Located | NotLocated):
        raise BrokenContract(f"expected Located or NotLocated, got {type(motion).__name__}")
    if not isinstance(motion.evidence, Mapping):
        raise BrokenContract(f"evidence is a mapping of numbers by name, got {shown(motion.evidence)}")
    for key, value in motion.evidence.items():
        if not _is_number(value):
            raise BrokenContract(f"evidence consists of numbers, got {key} = {value!r:.60}")
    if isinstance(motion, NotLocated):
        if not isinstance(motion.reason, str):
            raise BrokenContract(f"the reason of NotLocated is a text, got {shown(motion.reason)}")
        return motion
    _require_homography(motion.homography)
    information, residual_px = motion.information, motion.residual_px
    if information is not None and not _is_inverse_covariance(information):
        raise BrokenContract(
            "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
        )
    if residual_px is not None and not (_is_number(residual_px) and 0 <= residual_px < np.inf):
        raise BrokenContract(f"residual_px is a finite number of at least 0, None if it is not known; got {residual_px!r:.60}")
    return motion


def why_undetermined(motion: Located, frame_shape: tuple[int, int]) -> str | None:
    """Return why the images of a pair do not determine its motion, as those of stripes that move along themselves.

    Args:
        motion: in px of a frame.
        frame_shape: (height, width) of a frame.

    Returns:
        A clause if the expected error of a corner exceeds `UNDETERMINED` times the longer side of a frame.
    """
    worst_px, limit_px = motion.residual_px or 0.0, UNDETERMINED * max(frame_shape)
    if motion.information is not None:
        units, scaled = _scaled(motion.information)
        with suppress(np.linalg.LinAlgError):
            # The smallest pivot bounds the errors well enough for all but a few pairs.
            side, pivot = max(frame_shape), np.diagonal(np.linalg.cholesky(scaled)).min()
            if (np.array([*4 * [side], 1, 1, side**2, side**2]) / units).sum() < _SAFE * pivot * limit_px:
                return None
        to_corners = jacobian(motion.homography, corners(frame_shape)).reshape(8, 8)
        values, vectors = np.linalg.eigh(scaled)
        errors = (to_corners / units) @ (vectors / np.sqrt(np.maximum(values, _SMALLEST)))
        worst_px = float(np.sqrt((errors**2).sum(axis=1).max()))
    if worst_px <= limit_px:
        return None
    return f"the images do not determine the motion: its expected error is {worst_px:.2g} px at a corner"


def require_no_standstill(motion: Located, expected: FrameHomography | None, frame_shape: tuple[int, int]) -> None:
    """Refuse the identity, or nearly the identity, as the motion of a pair if the motion known so far is far from it.

    Args:
        motion: what a locator returned, in any unit: the identity is the same in all.
        expected: (3, 3) the motion known so far; None at the first level.
        frame_shape: (height, width) of a frame.

    Raises:
        BrokenContract: the locator returned the identity instead of a failure.
    """
    if expected is None or np.abs(motion.homography - np.eye(3)).max() > STILL_PX:
        return
    expected_px = corner_displacements(expected, np.eye(3), frame_shape).mean()
    if expected_px >= STILL_SHARE * min(frame_shape):
        raise BrokenContract(
            f"got the identity where the motion known so far moves the corners by {expected_px:.0f} px; a failure is NotLocated"
        )


def require_motion(level: Level, edges: Sequence[Edge], shape: tuple[int, int], seen_px: Callable[[], float]) -> None:
    """Refuse a level where every located pair is the identity: the locator does not report its failures.

    Because of photon noise, a camera that stands still gives nearly the identity, and never exactly. Nearly the identity is
    refused if short spans of frames show that the image moves.

    Args:
        level: the level.
        edges: the pairs that were tried.
        shape: (height, width) of a frame.
        seen_px: returns by how much the image moves between two exposures, as short spans of frames show it; called only if
            every pair is nearly the identity.

    Raises:
        PluginError: names the locators.
    """
    located = [(edge.locator, edge.motion.homography) for edge in edges if isinstance(edge.motion, Located)]
    if not located:
        return
    if all(_is_identity(homography) for _, homography in located):
        found = "every pair that was located is exactly the identity, which a camera that stands still does not give"
    elif (
        max(corner_displacements(homography, np.eye(3), shape).mean() for _, homography in located) < STILL_PX
        and (moved_px := seen_px()) >= MOVING_PX
    ):
        found = (
            f"every pair that was located moves the corners by less than {STILL_PX:g} px, while short spans of frames show a "
            f"motion of {moved_px:.0f} px"
        )
    else:
        return
    names = {name for name, _ in located}
    origins = listed(locator.origin for locator in level.locators if locator.name in names)
    raise PluginError(
        f"{origins} broke {'its' if len(names) == 1 else 'their'} contract at level {level.number}: {found}; "
        "a failure is NotLocated"
    )


def require_exposure(exposure: object, group: Group, scale: float, frame_shape: tuple[int, int]) -> VirtualExposure:
    """Return what a merger returned for a group, once its group, scale, shapes and values are checked.

    Args:
        exposure: what the merger returned.
        group: the group that it was given.
        scale: the scale that it was given.
        frame_shape: (height, width) of a frame.

    Raises:
        BrokenContract: it is no exposure of this group and scale, or flux is not finite exactly where pixels were seen.
    """
    if not isinstance(exposure, VirtualExposure):
        raise BrokenContract(f"expected a VirtualExposure, got {type(exposure).__name__}")
    if exposure.scale != scale:
        raise BrokenContract(f"expected an exposure of scale {scale:g}, got {exposure.scale:g}")
    if exposure.group != group:
        raise BrokenContract(
            f"expected the exposure of {group} at the instant {group.reference:g}, got that of {exposure.group!r:.120}"
        )
    shape = tuple(max(1, round(side * scale)) for side in frame_shape)
    for name in ("flux", "weight"):
        image = getattr(exposure, name)
        if not isinstance(image, np.ndarray) or image.dtype.kind != "f" or image.shape != shape:
            raise BrokenContract(f"{name} is {shape} of float32, got {shown(image)}")
    if not callable(getattr(exposure.response, "stabilised", None)):
        raise BrokenContract(f"response is that of the source, got {shown(exposure.response)}")
    flux, weight = exposure.flux, exposure.weight
    if (np.isfinite(flux) != (weight > 0)).any() or not 0 <= weight.min() <= weight.max() < np.inf:
        row, column = np.argwhere((np.isfinite(flux) != (weight > 0)) | ~(weight >= 0) | ~np.isfinite(weight))[0]
        raise BrokenContract(
            "flux is finite where weight is positive, and NaN where weight is 0; "
            f"at row {row}, column {column} flux is {flux[row, column]:g} and weight {weight[row, column]:g}"
        )
    return exposure


def require_knots_kept(
    trajectory: Trajectory, instants: FloatArray, homographies: FloatArray, std_px: FloatArray, frame_shape: tuple[int, int]
) -> None:
    """Refuse a trajectory that has nothing to do with the knots that it was fitted to.

    A trajectory that smooths misses its knots by a few of their expected errors; outliers may lie further away. So most knots
    may be missed by the larger of `KNOT_STDS` expected errors and `KNOT_PX`. Half-way between two knots, it may stray from the
    mean of both by the distance between them in addition.

    Args:
        trajectory: what an interpolator fitted.
        instants: (N,) of the knots.
        homographies: (N, 3, 3) of the knots.
        std_px: (N,) expected error of the knots; NaN where it is not known.
        frame_shape: (height, width) of a frame.

    Raises:
        BrokenContract: half of the knots, or of the places between them, are missed by more.
    """
    points = corners(frame_shape)
    knots, between = apply(homographies, points), (instants[1:] + instants[:-1]) / 2
    fitted = apply(trajectory.at(np.concatenate([instants, between])), points)
    steps_px = _distance_px(knots[1:], knots[:-1])
    allowed_px = max(KNOT_PX, KNOT_STDS * float(np.nan_to_num(np.median(std_px))))
    missed_px = float(np.median(_distance_px(fitted[: len(instants)], knots)))
    if not missed_px <= allowed_px:
        raise BrokenContract(
            f"the trajectory misses half of its knots by {missed_px:.3g} px or more, where their expected error is "
            f"{np.median(std_px):.2g} px"
        )
    if len(between):
        strayed_px = float(np.median(_distance_px(fitted[len(instants) :], (knots[1:] + knots[:-1]) / 2) - steps_px))
        if not strayed_px <= allowed_px:
            raise BrokenContract(
                f"the trajectory passes its knots, but half-way between them it is typically {strayed_px:.3g} px further away "
                "than the next knot"
            )


def _distance_px(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the mean distance of four corners: (N, 4, 2) twice to (N,)."""
    return np.asarray(np.linalg.norm(first - second, axis=-1).mean(axis=-1))


def _require_homography(homography: object) -> None:
    if not isinstance(homography, np.ndarray) or homography.dtype.kind not in "fiu":
        raise BrokenContract(f"a homography is a (3, 3) array of float64, got {shown(homography)}; a failure is NotLocated")
    if homography.shape == (3, 3) and homography[2, 2] != 0 and np.isfinite(homography).all():
        with np.errstate(over="ignore"):
            if (np.abs(homography / homography[2, 2]) < _LARGEST).all():
                return
    raise BrokenContract(
        f"a homography is a finite (3, 3) matrix with h33 = 1, got {homography.tolist()}; a failure is NotLocated"
    )


def _is_number(value: object) -> bool:
    return isinstance(value, Real | np.bool_ | np.integer | np.floating)


def _is_identity(homography: Homography) -> bool:
    """Return whether a map is the identity to within rounding."""
    return bool(np.abs(np.asarray(homography) - np.eye(3)).max() < 1e-9)


def _is_inverse_covariance(matrix: object) -> bool:
    if not isinstance(matrix, np.ndarray) or matrix.dtype.kind not in "fiu" or matrix.shape != (8, 8):
        return False
    if not np.isfinite(matrix).all() or np.diagonal(matrix).min() <= 0:
        return False
    _, scaled = _scaled(matrix)
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return bool(np.abs(scaled - scaled.T).max() < _ASYMMETRY)


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the square roots of the diagonal, (8,), and the information in units of them: (8, 8) with ones on its diagonal."""
    units = np.sqrt(np.diagonal(information))
    return units, information / (units[:, None] * units)
