"""What components may return: a function for each kind, which a run and the conformance kit call.

Each takes what a component returned and the arguments that it was given, and returns it, or raises `BrokenContract`. The run
names the component: see `photonpano.contracts.attribution`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import PATCHES, Canvas, corner_displacements, corners, jacobian, transform_points
from photonpano.text import pixels
from photonpano.values import (
    Bayer,
    BoolArray,
    FloatArray,
    FrameSpan,
    Group,
    Homography,
    Located,
    NotLocated,
    Panorama,
    Refined,
    Response,
    StreamInfo,
    VirtualExposure,
)

# A pair that moves the corners by less is nearly the identity; an image that moves by this much between exposures moves.
STILL_PX, MOVING_PX = 1e-3, 2.0
_ROUNDING = 1e-9  # elements of the identity may differ by less
# The identity is refused if the motion known so far moves the corners by at least this share of the shorter side of a frame.
# For less it may be right: the motion of the first level is off by a few pixels, and some locators return whole pixels.
STILL_SHARE = 0.1
KNOT_PX, KNOT_STDS = 1.0, 10.0  # a trajectory may miss its knots by this much, or by this many of their expected errors
_LARGEST = 1e9  # no camera moves by so much, and larger numbers of a homography overflow in later steps
_FLUX = np.array([[0.0, 0.01, 0.3], [0.3, 0.01, np.nan]], np.float32)  # with which a response is tried
UNDETERMINED = 10.0  # expected corner error of a pair, in sides of a frame, from which on it constrains nothing
_SAFE = 0.01  # margin of the bound on errors that the smallest pivot gives
_SMALLEST = 1e-100  # floor on eigenvalues
_ASYMMETRY = 1e-3  # largest relative asymmetry that counts as rounding


class BrokenContract(Exception):  # noqa: N818 - it is not raised to callers
    """What a component returned although its protocol does not allow it, as a clause; raised inside `attributing`."""


def shown(value: object) -> str:
    """Describe a value by its type, and an array by its shape and type."""
    return f"{value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"


# Sources


def require_info(info: Any) -> StreamInfo:
    """Return the `info` of a source."""
    checked: StreamInfo = require_instance(info, StreamInfo)
    for name in ("n_frames", "height", "width", "bit_depth"):
        size: Any = getattr(info, name)
        if not (isinstance(size, int | np.integer) and size >= 1):
            raise BrokenContract(f"info.{name} is a whole number of at least 1, got {size!r:.60}")
    if info.kind not in ("binary", "intensity"):
        raise BrokenContract(f"info.kind is binary or intensity, got {info.kind!r:.60}")
    if info.bayer not in (None, *get_args(Bayer)):
        raise BrokenContract(f"info.bayer is {', '.join(get_args(Bayer))} or None, got {info.bayer!r:.60}")
    rate: Any = info.frame_rate_hz
    if rate is not None and not (isinstance(rate, int | float | np.number) and 0 < rate < np.inf):
        raise BrokenContract(f"info.frame_rate_hz is a finite number above 0, or None if it is not known; got {rate!r:.60}")
    return checked


def require_mask(valid: Any, frame_shape: tuple[int, int]) -> BoolArray:
    """Return the mask `valid` of a source."""
    return require_array("valid", valid, frame_shape, "bool", "b")


def require_response(response: Any) -> Response:
    """Return the `response` of a source, after it was tried with a few values, NaN among them."""
    with np.errstate(all="ignore"):
        counts = response.mean_count(_FLUX)
        flux = response.flux(counts, 10_000.0)
        stabilised = response.stabilised(_FLUX, np.full(_FLUX.shape, 100, np.float32))
    for name, image in (("mean_count", counts), ("flux", flux), ("stabilised", stabilised)):
        require_array(f"the result of response.{name}()", image, _FLUX.shape, "float32", "f")
        if (np.isnan(image) != np.isnan(_FLUX)).any():
            raise BrokenContract(f"response.{name}() keeps NaN, and gives no other; {_FLUX.tolist()} became {image.tolist()}")
    if not np.allclose(flux, _FLUX, rtol=0.1, atol=0.01, equal_nan=True):
        raise BrokenContract(f"response.flux() inverts response.mean_count(); {_FLUX.tolist()} became {flux.tolist()}")
    tried: Response = response
    return tried


def require_read(found: Any, method: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the array that a source read."""
    if np.shape(found) != shape:
        raise BrokenContract(f"expected the shape {shape}, got {np.shape(found)}")
    if not (isinstance(found, np.ndarray) and found.dtype.kind in "uib"):
        raise BrokenContract(f"{method}() returns an array of whole numbers, got {shown(found)}")
    return found


def require_range(found: NDArray[Any], method: str, highest: int) -> None:
    """Refuse numbers that so many frames cannot have."""
    lowest, largest = int(found.min()), int(found.max())
    if lowest < 0 or largest > highest:
        wrong = lowest if lowest < 0 else largest
        raise BrokenContract(f"{method}() returns numbers from 0 to {highest} for these frames, got {wrong}")


def require_sharp_view(found: Any, shape: tuple[int, int]) -> NDArray[Any]:
    """Return the frame without noise that a simulator returned."""
    image = require_array("the result of sharp_view()", found, shape, "float32", "f")
    if bad := image.size - int(np.count_nonzero(np.isfinite(image))):
        raise BrokenContract(f"sharp_view() returns finite numbers; {bad} of {image.size} pixels are NaN or infinite")
    return image


def require_truth(found: Any) -> Mapping[str, NDArray[np.generic]]:
    """Return the ground truth of a simulator."""
    truth: Mapping[str, NDArray[np.generic]] = require_instance(found, Mapping)
    return truth


# The steps of a level


def require_groups(found: Any, n_frames: int, *_: Any) -> tuple[Group, ...]:
    """Return the groups of a resampler."""
    groups: tuple[Group, ...] = tuple(found)
    for group in groups:
        require_instance(group, Group)
    instants = [group.reference for group in groups]
    if not groups or any(later <= earlier for earlier, later in pairwise(instants)):
        raise BrokenContract(f"expected at least one group, in order, each instant once; got the instants {instants!s:.200}")
    for group in groups:
        if group.span.stop > n_frames:
            raise BrokenContract(f"the capture has {n_frames} frames (0 to {n_frames - 1}), got a group of {group}")
    return groups


def require_exposure(found: Any, source: Source, group: Group, _: Any, scale: float) -> VirtualExposure:
    """Return the exposure of a merger."""
    exposure: VirtualExposure = require_instance(found, VirtualExposure)
    if found.scale != scale:
        raise BrokenContract(f"expected an exposure of scale {scale:g}, got {found.scale:g}")
    if found.group != group:
        raise BrokenContract(
            f"expected the exposure of {group} at the instant {group.reference:g}, got that of {found.group!r:.120}"
        )
    if not callable(getattr(found.response, "stabilised", None)):
        raise BrokenContract(f"response is that of the source, got {shown(found.response)}")
    height, width = (max(1, round(side * scale)) for side in source.info.frame_shape)
    _require_images(found, (height, width))
    return exposure


def require_motion(found: Any, *_: Any) -> Located | NotLocated:
    """Return what a locator returned for a pair."""
    require_instance(found, Located, NotLocated)
    if not isinstance(found.evidence, Mapping):
        raise BrokenContract(f"evidence is a mapping of numbers by name, got {shown(found.evidence)}")
    for name, value in found.evidence.items():
        if not isinstance(value, Real | np.bool_):
            raise BrokenContract(f"evidence consists of numbers, got {name} = {value!r:.60}")
    if isinstance(found, NotLocated):
        if not isinstance(found.reason, str):
            raise BrokenContract(f"the reason of NotLocated is a text, got {shown(found.reason)}")
        return found
    located: Located = found
    _require_homography(located.homography)
    if located.information is not None and not is_inverse_covariance(located.information):
        raise BrokenContract(
            "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
        )
    if located.residual_px is not None and not 0 <= located.residual_px < np.inf:
        raise BrokenContract(
            f"residual_px is a finite number of at least 0, None if it is not known; got {located.residual_px!r}"
        )
    if located.patches is not None:
        require_finite("patches.shifts", located.patches.shifts, (PATCHES**2, 2))
        require_finite("patches.information", located.patches.information, (PATCHES**2, 2, 2))
    return located


def require_hypotheses(found: Sequence[Any], *_: Any) -> Sequence[Homography]:
    """Return the motions that a locator lists for a pair."""
    for each in found:
        _require_homography(each)
    return tuple(found)


def require_no_standstill(motion: Located, expected: Homography | None, frame_shape: tuple[int, int]) -> None:
    """Refuse nearly the identity if the motion known so far, in px of a frame, is far from it."""
    if expected is None or np.abs(motion.homography - np.eye(3)).max() > STILL_PX:
        return
    expected_px = float(corner_displacements(expected, np.eye(3), frame_shape).mean())
    if expected_px >= STILL_SHARE * min(frame_shape):
        raise BrokenContract(
            f"got the identity where the motion known so far moves the corners by {expected_px:.0f} px; a failure is NotLocated"
        )


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


def require_homographies(found: Any, frame_indices: ArrayLike) -> FloatArray:
    """Return what a trajectory returned for N instants, as float64: (N, 3, 3)."""
    frames, found = np.atleast_1d(np.asarray(frame_indices, np.float64)), np.asarray(found)
    require_array("the result of at()", found, (len(frames), 3, 3), "float64", "fiu")
    bad = ~np.isfinite(found).all(axis=(1, 2)) | (found[:, 2, 2] == 0)
    if bad.any():
        first = int(np.argmax(bad))
        raise BrokenContract(f"a homography is finite with h33 = 1, that of frame {frames[first]:g} is {found[first].tolist()}")
    return np.asarray(found, dtype=np.float64)


def require_near_knots(
    trajectory: Trajectory, instants: FloatArray, homographies: FloatArray, std_px: FloatArray, frame_shape: tuple[int, int]
) -> None:
    """Refuse a trajectory that has nothing to do with the knots that it was fitted to.

    The knots are (N, 3, 3) at (N,) instants, with (N,) expected errors, NaN where these are not known. A trajectory that
    smooths misses its knots by a few of their expected errors, and outliers may lie further away: so medians are compared.
    """
    points = corners(frame_shape)
    knots, between = transform_points(homographies, points), (instants[1:] + instants[:-1]) / 2
    fitted = transform_points(trajectory.at(np.concatenate([instants, between])), points)
    missed_px, expected_px = float(np.median(_distance_px(fitted[: len(instants)], knots))), float(np.median(std_px))
    allowed_px = max(KNOT_PX, KNOT_STDS * float(np.nan_to_num(expected_px)))
    if not missed_px <= allowed_px:
        raise BrokenContract(
            f"the trajectory misses half of its knots by {missed_px:.3g} px or more, where their expected error is "
            f"{pixels(expected_px)} px"
        )
    if not len(between):
        return
    beside_px = _distance_px(fitted[len(instants) :], (knots[1:] + knots[:-1]) / 2)
    strayed_px = float(np.median(beside_px - _distance_px(knots[1:], knots[:-1])))
    if not strayed_px <= allowed_px:
        raise BrokenContract(
            f"the trajectory passes its knots, but half-way between them it is typically {strayed_px:.3g} px further away than "
            "the next knot"
        )


def _distance_px(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the mean distance of four corners: (N, 4, 2) twice to (N,)."""
    return np.asarray(np.linalg.norm(first - second, axis=-1).mean(axis=-1))


# After the levels


def require_refined(found: Any, _source: Any, _trajectory: Any, std_px: FloatArray, *_: Any) -> Refined | None:
    """Return the motion of a refiner, whose expected errors were (T,) `std_px`; None if it found nothing."""
    if found is None:
        return None
    refined: Refined = require_instance(found, Refined)
    n_frames = len(std_px)
    require_array("homographies", found.homographies, (n_frames, 3, 3), "float64", "fiu")
    require_array("std_px", found.std_px, (n_frames,), "float64", "fiu")
    if not isinstance(found.summary, str):
        raise BrokenContract(f"the summary is a text, got {shown(found.summary)}")
    bad = ~np.isfinite(found.homographies).all(axis=(1, 2)) | ~(found.std_px >= 0)
    if bad.any():
        raise BrokenContract(f"the motion of frame {np.argmax(bad)} is not finite, or its std_px is negative or NaN")
    with np.errstate(all="ignore"):
        flat = ~(np.abs(np.linalg.det(found.homographies)) > 0) | (found.homographies[:, 2, 2] == 0)
    if flat.any():
        first = int(np.argmax(flat))
        raise BrokenContract(
            f"a homography is invertible and has h33 = 1, that of frame {first} is {found.homographies[first].tolist()}"
        )
    other = np.isfinite(found.std_px) != np.isfinite(std_px)
    if other.any():
        first = int(np.argmax(other))
        raise BrokenContract(
            f"std_px is infinite exactly where it was before; that of frame {first} was {std_px[first]:g}, and is "
            f"{found.std_px[first]:g}"
        )
    return refined


def require_panorama(found: Any, _source: Any, _trajectory: Any, _span: FrameSpan, canvas: Canvas, *_: Any) -> Panorama:
    """Return what a renderer returned for a canvas, in float32."""
    require_instance(found, Panorama)
    _require_images(found, canvas.shape)
    if not np.array_equal(np.asarray(found.canvas), canvas.transform):
        raise BrokenContract("the canvas of the panorama is the transform of the given canvas, got another one")
    flux, weight = (np.ascontiguousarray(image, np.float32) for image in (found.flux, found.weight))
    return Panorama(flux, weight, canvas.transform)


def require_files(written: Collection[str], path: Path) -> None:
    """Refuse what an exporter wrote, given the names of the new files and folders beside `path`."""
    if others := sorted({*written} - {path.name}):
        raise BrokenContract(f"expected {path.name} alone, got {', '.join(others)} as well")
    files = [path] if path.is_file() else [*path.rglob("*")]
    if not any(each.is_file() and not each.is_symlink() and each.stat().st_size for each in files):
        raise BrokenContract(f"expected a file or folder {path.name} with content, got none")


# For several kinds


def require_instance(found: Any, *kinds: type) -> Any:
    """Return a value, or refuse what is of none of these types."""
    if not isinstance(found, kinds):
        raise BrokenContract(f"expected {' or '.join(kind.__name__ for kind in kinds)}, got {shown(found)}")
    return found


def _require_methods(*names: str) -> Callable[..., Any]:
    """Return a check that a component, which another one returned, has some methods."""

    def require(found: Any, *_: Any) -> Any:
        if missing := [name for name in names if not callable(getattr(found, name, None))]:
            raise BrokenContract(f"expected an object with the method {missing[0]}(), got {shown(found)}")
        return found

    return require


def require_array(name: str, array: object, shape: tuple[int, ...], dtype: str, kinds: str = "f") -> NDArray[Any]:
    """Return an array of a shape, or refuse anything else; `kinds` are those of numbers that can become the `dtype`."""
    if not (isinstance(array, np.ndarray) and array.shape == shape and array.dtype.kind in kinds):
        raise BrokenContract(f"{name} must be {shape} of {dtype}, got {shown(array)}")
    return array


def require_finite(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Refuse what is not a finite array of a shape."""
    require_array(name, array, shape, "float64")
    if not np.isfinite(array).all():
        raise BrokenContract(f"{name} must be finite")


def _require_homography(found: Any) -> None:
    require_array("a homography", found, (3, 3), "float64; a failure is NotLocated", "fiu")
    with np.errstate(all="ignore"):
        right = found[2, 2] != 0 and (np.abs(found / found[2, 2]) < _LARGEST).all() and abs(np.linalg.det(found)) > 0
    if not right:
        raise BrokenContract(
            f"a homography is finite and invertible, with h33 = 1, got {found.tolist()}; a failure is NotLocated"
        )


def _require_images(found: Any, shape: tuple[int, ...]) -> None:
    """Require `flux` and `weight` of a shape: flux is finite exactly where the weight is positive, and NaN elsewhere."""
    require_array("flux", found.flux, shape, "float32")
    require_array("weight", found.weight, shape, "float32")
    flux, weight = np.asarray(found.flux, np.float32), np.asarray(found.weight, np.float32)
    finite, lowest = np.isfinite(flux), weight.min()
    bounded = 0 <= lowest <= weight.max() < np.inf
    if bounded and lowest > 0 and finite.all():
        return
    seen = weight > 0
    if bounded and not (finite != seen).any() and np.isnan(flux[~seen]).all():
        return
    row, column = np.argwhere((finite != seen) | np.isinf(flux) | ~(weight >= 0) | ~np.isfinite(weight))[0]
    raise BrokenContract(
        f"flux is finite where weight is positive, and NaN where weight is 0; at row {row}, column {column} flux is "
        f"{flux[row, column]:g} and weight {weight[row, column]:g}"
    )


# What is required of the result of each method of a component, given the arguments.
REQUIRED: Mapping[str, Callable[..., Any]] = {
    "groups": require_groups,
    "merge": require_exposure,
    "register": require_motion,
    "hypotheses": require_hypotheses,
    "turning": _require_methods("describe", "register"),
    "fit": _require_methods("at"),
    "fit_turns": _require_methods("__call__"),
    "at": require_homographies,
    "refine": require_refined,
    "render": require_panorama,
}


def is_inverse_covariance(matrix: object) -> bool:
    """Return whether a value is an (8, 8) array of real numbers, finite, symmetric and positive definite."""
    if not (isinstance(matrix, np.ndarray) and matrix.dtype.kind in "fiu" and matrix.shape == (8, 8)):
        return False
    if not np.isfinite(matrix).all() or np.diagonal(matrix).min() <= 0:
        return False
    _, scaled = _scaled(matrix)
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return bool(np.abs(scaled - scaled.T).max() < _ASYMMETRY)


def why_undetermined(motion: Located, frame_shape: tuple[int, int]) -> str | None:
    """Return why the images of a pair do not determine its motion, in px of a frame; None if they do.

    The expected error of a corner exceeds `UNDETERMINED` times the longer side, as of stripes that move along themselves.
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
    return f"the images do not determine the motion: its expected error is {pixels(worst_px)} px at a corner"


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the square roots of the diagonal, (8,), and the information in units of them: (8, 8) with ones on its diagonal."""
    units = np.sqrt(np.diagonal(information))
    return units, information / (units[:, None] * units)
