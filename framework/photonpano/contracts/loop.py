"""What resamplers, mergers, locators and interpolators may return."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.information import is_inverse_covariance
from photonpano.contracts.protocols import Trajectory
from photonpano.contracts.rules import (
    STRICT_IMAGES,
    Contract,
    Rule,
    attributing,
    has_h33_of_1,
    images,
    instance,
    is_float64,
    is_real,
    shown,
    text,
)
from photonpano.geometry import PATCHES, corner_displacements, corners, transform_points
from photonpano.values import FloatArray, Group, Homography, Located, NotLocated, Response, VirtualExposure

# A pair that moves the corners by less is nearly the identity; an image that moves by this much between exposures moves.
STILL_PX, MOVING_PX = 1e-3, 2.0
_ROUNDING = 1e-9  # elements of the identity may differ by less
# The identity is refused if the motion known so far moves the corners by at least this share of the shorter side of a frame.
# For less it may be right: the motion of the first level is off by a few pixels, and some locators return whole pixels.
STILL_SHARE = 0.1
KNOT_PX, KNOT_STDS = 1.0, 10.0  # a trajectory may miss its knots by this much, or by this many of their expected errors
_LARGEST = 1e9  # no camera moves by so much, and larger numbers of a homography overflow in later steps


def _no_group(groups: Iterable[Any], _: int) -> object:
    for group in groups:
        ends = (group.span.start, group.span.stop) if isinstance(group, Group) else ()
        if not ends or not all(isinstance(end, int | np.integer) for end in ends):
            return (group,)
    return None


def _out_of_order(groups: Sequence[Group], _: int) -> object:
    instants = [group.reference for group in groups]
    return (not groups or any(later <= earlier for earlier, later in pairwise(instants))) and (str(instants),)


def _other_integers(groups: Iterable[Group], _: int) -> object:
    kinds = {type(end).__name__ for group in groups for end in (group.span.start, group.span.stop)} - {"int"}
    return kinds and (", ".join(sorted(kinds)),)


def _outside(groups: Iterable[Group], _: int) -> object:
    return next(
        ((each.reference, each) for each in groups if not each.span.start <= each.reference <= each.span.stop - 1), None
    )


# Facts: the number of frames of the capture. Instants are whole or half, so that there are fewer than two for each frame.
GROUPS: Contract[tuple[Group, ...]] = Contract(
    [
        ("the capture has {} frames, got {} groups or more", lambda groups, n: len(groups) >= 2 * n and (n, len(groups))),
        ("expected groups, got {!r:.60}", _no_group),
        ("expected at least one group, in order, each instant once; got the instants {:.200}", _out_of_order),
        (
            "the capture has {} frames (0 to {}), got a group of {}",
            lambda groups, n: next(((n, n - 1, group) for group in groups if group.span.stop > n), None),
        ),
    ],
    strict=[
        ("the reference must lie between the first and the last frame, got {} for {}", _outside),
        ("spans must consist of Python's int, which run.json can hold; got {}", _other_integers),
    ],
)


def require_groups(found: Iterable[Any], n_frames: int) -> tuple[Group, ...]:
    """Return the groups that a resampler returned for a capture, or raise `BrokenContract`."""
    return GROUPS.require(tuple(islice(found, 2 * n_frames)), n_frames)  # a generator may have no end


@dataclass(frozen=True, slots=True)
class Asked:
    """What a merger was asked for."""

    group: Group
    scale: float  # pixels of the exposure per pixel of a frame
    frame_shape: tuple[int, int]  # (height, width) of a frame
    response: Response | None = None  # that of the source; None where it is not compared

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width) of the exposure."""
        return tuple(max(1, round(side * self.scale)) for side in self.frame_shape)


EXPOSURE: Contract[VirtualExposure] = Contract(
    [
        instance("a VirtualExposure", VirtualExposure),
        (
            "expected an exposure of scale {:g}, got {:g}",
            lambda found, asked: found.scale != asked.scale and (asked.scale, found.scale),
        ),
        (
            "expected the exposure of {} at the instant {:g}, got that of {!r:.120}",
            lambda found, asked: found.group != asked.group and (asked.group, asked.group.reference, found.group),
        ),
        (
            "response is that of the source, got {}",
            lambda found, _: not callable(getattr(found.response, "stabilised", None)) and (shown(found.response),),
        ),
        *images(lambda asked: asked.shape),
    ],
    strict=[
        *STRICT_IMAGES,
        (
            "response must be that of the source, {}; got {}",
            lambda found, asked: asked.response not in (None, found.response) and (asked.response, found.response),
        ),
    ],
)


def _is_number(value: object) -> bool:
    return isinstance(value, Real | np.bool_ | np.integer | np.floating)


def _no_motion(found: Located, _: None) -> object:
    homography = found.homography
    if homography.shape == (3, 3) and homography[2, 2] != 0 and np.isfinite(homography).all():
        with np.errstate(over="ignore"):
            if (np.abs(homography / homography[2, 2]) < _LARGEST).all():
                return None
    return (homography.tolist(),)


def _no_residual(found: Located, _: None) -> object:
    residual_px = found.residual_px
    return residual_px is not None and not (_is_number(residual_px) and 0 <= residual_px < np.inf) and (residual_px,)


def _no_patches(found: Located, _: None) -> object:
    if found.patches is None:
        return None
    shapes = {"shifts": (PATCHES**2, 2), "information": (PATCHES**2, 2, 2)}
    for name, shape in shapes.items():
        array: Any = getattr(found.patches, name, None)
        if not is_real(array) or array.shape != shape or not np.isfinite(array).all():
            return name, shape, shown(array)
    return None


_OF_A_PAIR: tuple[Rule, ...] = (
    instance("Located or NotLocated", Located, NotLocated),
    (
        "evidence is a mapping of numbers by name, got {}",
        lambda found, _: not isinstance(found.evidence, Mapping) and (shown(found.evidence),),
    ),
    (
        "evidence consists of numbers, got {} = {!r:.60}",
        lambda found, _: found.evidence and next((each for each in found.evidence.items() if not _is_number(each[1])), None),
    ),
)
_STRICT: Rule = (
    "evidence must be finite numbers by name, got {}",
    lambda found, _: not np.isfinite(list(found.evidence.values())).all() and (found.evidence,),
)
NOT_LOCATED: Contract[NotLocated] = Contract(
    [*_OF_A_PAIR, text("reason", "the reason of NotLocated")],
    strict=[
        _STRICT,
        ("NotLocated needs a reason: a clause with the numbers behind it", lambda found, _: not found.reason.strip()),
    ],
)
LOCATED: Contract[Located] = Contract(
    [
        *_OF_A_PAIR,
        (
            "a homography is a (3, 3) array of float64, got {}; a failure is NotLocated",
            lambda found, _: not is_real(found.homography) and (shown(found.homography),),
        ),
        ("a homography is a finite (3, 3) matrix with h33 = 1, got {}; a failure is NotLocated", _no_motion),
        (
            "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none",
            lambda found, _: found.information is not None and not is_inverse_covariance(found.information),
        ),
        ("residual_px is a finite number of at least 0, None if it is not known; got {!r:.60}", _no_residual),
        ("patches are None, or finite arrays: {} of shape {}, got {}", _no_patches),
    ],
    strict=[
        _STRICT,
        is_float64("homography"),
        has_h33_of_1(lambda found: found.homography),
        (
            "information must be symmetric, as every inverse covariance is",
            lambda found, _: (
                found.information is not None and not np.allclose(found.information, found.information.T, rtol=1e-6)
            ),
        ),
    ],
)


def contract_for(found: object) -> Contract[Any]:
    """Return the contract for what a locator returned for a pair."""
    return NOT_LOCATED if isinstance(found, NotLocated) else LOCATED


def require_valid(found: object) -> Located | NotLocated:
    """Return what a locator returned for a pair, or raise `BrokenContract`."""
    motion: Located | NotLocated = contract_for(found).require(found)
    return motion


# What is expected to move the corners, in px, where a locator returned the identity. Facts: (height, width) of a frame.
_MOVING: Contract[float] = Contract(
    [
        (
            "got the identity where the motion known so far moves the corners by {:.0f} px; a failure is NotLocated",
            lambda expected_px, frame_shape: expected_px >= STILL_SHARE * min(frame_shape) and (expected_px,),
        )
    ]
)


def require_no_standstill(motion: Located, expected: Homography | None, frame_shape: tuple[int, int]) -> None:
    """Raise `BrokenContract` for nearly the identity if the motion known so far, in px of a frame, is far from it."""
    if expected is not None and np.abs(motion.homography - np.eye(3)).max() <= STILL_PX:
        _MOVING.require(float(corner_displacements(expected, np.eye(3), frame_shape).mean()), frame_shape)


def why_still(homographies: Sequence[Homography], frame_shape: tuple[int, int], seen_px: Callable[[], float]) -> str | None:
    """Return why the located pairs of a level cannot all stand still, as a clause; None if they may.

    Because of photon noise, a camera that stands still gives nearly the identity, and never exactly. Nearly the identity is
    refused if `seen_px`, which is called only then, returns that short spans of frames show a motion between exposures.
    """
    if not homographies:
        return None
    if max(np.abs(np.asarray(each) - np.eye(3)).max() for each in homographies) < _ROUNDING:
        return "every pair that was located is exactly the identity, which a camera that stands still does not give"
    if max(corner_displacements(each, np.eye(3), frame_shape).mean() for each in homographies) >= STILL_PX:
        return None
    if (moved_px := seen_px()) < MOVING_PX:
        return None
    return (
        f"every pair that was located moves the corners by less than {STILL_PX:g} px, while short spans of frames show a "
        f"motion of {moved_px:.0f} px"
    )


def _not_finite(found: FloatArray, frames: FloatArray) -> object:
    bad = ~np.isfinite(found).all(axis=(1, 2)) | (found[:, 2, 2] == 0)
    return bad.any() and (frames[first := int(np.argmax(bad))], found[first].tolist())


# What `Trajectory.at` returns. Facts: (N,) the instants.
HOMOGRAPHIES: Contract[FloatArray] = Contract(
    [
        ("homographies are float64, got {}", lambda found, _: not is_real(found) and (shown(found),)),
        (
            "expected homographies of the shape ({}, 3, 3), got {}",
            lambda found, frames: found.shape != (len(frames), 3, 3) and (len(frames), found.shape),
        ),
        ("a homography is finite with h33 = 1, that of frame {:g} is {}", _not_finite),
    ],
    strict=[
        (
            "homographies must be float64, as all geometry; got {}",
            lambda found, _: found.dtype != np.float64 and (found.dtype,),
        ),
        has_h33_of_1(lambda found: found),
        (
            "homographies must be invertible maps; that at {:g} is not",
            lambda found, frames: (flat := np.linalg.det(found) <= 0).any() and (frames[flat][0],),
        ),
    ],
)


class AttributedTrajectory:
    """A trajectory fitted at a level, whose errors name its interpolator, and whose homographies are checked."""

    def __init__(self, trajectory: Trajectory, origin: str, level: int) -> None:
        self._trajectory = trajectory
        self._origin = origin
        self._level = level

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, (N, 3, 3), or raise a `PluginError`."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        with attributing(self._origin, f"level {self._level}"):
            found = HOMOGRAPHIES.require(np.asarray(self._trajectory.at(frame_indices)), frames)
            return np.asarray(found, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class KnotErrors:
    """How far a trajectory lies from the knots that it was fitted to, at the corners of a frame.

    A trajectory that smooths misses its knots by a few of their expected errors, and outliers may lie further away: so these
    are medians, which may be as large as the larger of `KNOT_STDS` expected errors and `KNOT_PX`.
    """

    missed_px: float  # distance from the knots
    strayed_px: float  # half-way between two knots, distance from the mean of both, beyond the distance between them
    std_px: float  # expected error of the knots; NaN where it is not known

    @property
    def allowed_px(self) -> float:
        """The largest error that is accepted."""
        return max(KNOT_PX, KNOT_STDS * float(np.nan_to_num(self.std_px)))


KNOTS: Contract[KnotErrors] = Contract(
    [
        (
            "the trajectory misses half of its knots by {:.3g} px or more, where their expected error is {:.2g} px",
            lambda errors, _: not errors.missed_px <= errors.allowed_px and (errors.missed_px, errors.std_px),
        ),
        (
            "the trajectory passes its knots, but half-way between them it is typically {:.3g} px further away than the next "
            "knot",
            lambda errors, _: not errors.strayed_px <= errors.allowed_px and (errors.strayed_px,),
        ),
    ]
)


def knot_errors(
    trajectory: Trajectory, instants: FloatArray, homographies: FloatArray, std_px: FloatArray, frame_shape: tuple[int, int]
) -> KnotErrors:
    """Compare a trajectory with the knots that it was fitted to: `KNOTS.require` refuses one that has nothing to do with them.

    The knots are (N, 3, 3) at (N,) instants, with (N,) expected errors, NaN where these are not known.
    """
    points = corners(frame_shape)
    knots, between = transform_points(homographies, points), (instants[1:] + instants[:-1]) / 2
    fitted = transform_points(trajectory.at(np.concatenate([instants, between])), points)
    strayed_px = _distance_px(fitted[len(instants) :], (knots[1:] + knots[:-1]) / 2) - _distance_px(knots[1:], knots[:-1])
    missed_px = float(np.median(_distance_px(fitted[: len(instants)], knots)))
    return KnotErrors(missed_px, float(np.median(strayed_px)) if len(between) else 0.0, float(np.median(std_px)))


def _distance_px(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the mean distance of four corners: (N, 4, 2) twice to (N,)."""
    return np.asarray(np.linalg.norm(first - second, axis=-1).mean(axis=-1))
