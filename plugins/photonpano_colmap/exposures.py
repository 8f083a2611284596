"""Exposures that are merged along the path of a camera, through its lens and the depth of the scene; and tremor within groups.

The path is a spline through some poses, or a pose for every frame. The depth is interpolated between points.

Tremor is found from short spans of frames against the merged exposures. Only rotations are corrected. A tremor of half a
millimetre moves things at 4 m by a tenth of what its rotations move them, and within a group a translation looks almost like a
rotation: noise, or an error of depth, would be taken for it. The power of the translation is estimated from the spectrum of the
shifts, above a noise floor that is the same at all frequencies.

Convention:
    A pose (3, 4) maps points of the world to points of the camera, X_c = R X_w + t: x right, y down, z ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, LinearNDInterpolator, NearestNDInterpolator, make_interp_spline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, RotationSpline

from photonpano import FloatArray, FrameSpan, Group, Source, VirtualExposure, capture_of
from photonpano.compiling import compiled
from photonpano.filtering import exceeding_noise
from photonpano.geometry import Camera, inverse, positions_of, rotation_matrices, rotation_vectors, scaled_ahead
from photonpano.merging import PhotonSum, chunks_of
from photonpano.photometry import flux_std
from photonpano_poses import Lens, between, lens_of, seen_at

_NOISE_PX = 0.1  # standard error of the shift of a span that determines its length, within the limits below
_SHORTEST, _LONGEST = 6, 32  # frames of a span
_FEWEST = 16  # fewest spans that have a spectrum
_BLUR_PX = 1.0  # standard deviation of the blur of an exposure before its gradient is computed
# variance of the gradient of noise, relative to that of a pixel before the blur
_SLOPE_NOISE = (1 - np.exp(-1 / _BLUR_PX**2)) / (8 * np.pi * _BLUR_PX**2)
_BORDER = 4  # pixels nearer to masked ones have no gradient
# Unknowns of a span: rotation about three axes, translation along them, and the gain of the light.
_ROTATIONS, _MOTION, _GAIN = slice(3), slice(6), 6
# The translations that are well determined; along the third axis the camera translates as much.
_SIDEWAYS, _AXES = slice(3, 5), 3
_LEAST_INFORMATION = 1e-2  # modes with a standard error above 10 px are unknown


_DEGREE = 5  # degree of the polynomial in time that is always kept: gauge and drift


class PoseSpline:
    """Cubic splines of positions and of rotations; beyond the first and the last pose the camera keeps its velocity.

    That of positions is a natural one: others magnify the noise of the outermost poses.
    """

    def __init__(self, instants: FloatArray, poses: FloatArray) -> None:
        """Fit (N, 3, 4) poses at increasing instants, in frames; N is at least 2."""
        self._ends = float(instants[0]), float(instants[-1])
        self._positions = CubicSpline(instants, positions_of(poses), bc_type="natural")
        self._rotations = RotationSpline(instants, Rotation.from_matrix(poses[:, :, :3]))

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of N instants: (N, 3, 4)."""
        instants = np.asarray(instants, dtype=np.float64)
        inside = np.clip(instants, *self._ends)
        beyond = (instants - inside)[:, None]
        places = self._positions(inside) + beyond * self._positions(inside, 1)
        # Rates are those of the camera in the world, in its own axes.
        rotated = Rotation.from_rotvec(beyond * self._rotations(inside, 1))
        rotations = (self._rotations(inside) * rotated).as_matrix()
        return np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)


def left_out(instants: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return leave-one-out errors of the spline at inner poses: distances and angles in radians, (N - 2,) each."""
    apart, angles = [], []
    for place in range(1, len(instants) - 1):
        others = np.delete(np.arange(len(instants)), place)
        [predicted] = PoseSpline(instants[others], poses[others]).at(instants[place : place + 1])
        apart.append(float(np.linalg.norm(positions_of(predicted) - positions_of(poses[place]))))
        angles.append(float(Rotation.from_matrix(predicted[:, :3] @ poses[place, :, :3].T).magnitude()))
    return np.array(apart), np.array(angles)


class Path:
    """The poses of all frames, interpolated between them."""

    def __init__(self, poses: FloatArray) -> None:
        """Take the (T, 3, 4) poses of at least two frames."""
        self.poses = poses
        self._centres = positions_of(poses)

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of M instants, in frames: (M, 3, 4). Before the first frame and after the last, the camera rests."""
        at = np.clip(np.atleast_1d(np.asarray(instants, dtype=np.float64)), 0, len(self.poses) - 1)
        first = np.minimum(at.astype(int), len(self.poses) - 2)
        share = (at - first)[:, None, None]
        rotations = (1 - share) * self.poses[first, :, :3] + share * self.poses[first + 1, :, :3]
        # The mean of two rotation matrices is not orthogonal; a step of Newton's method makes it so.
        rotations = rotations @ (3 * np.eye(3) - np.swapaxes(rotations, 1, 2) @ rotations) / 2
        centres = (1 - share[:, 0]) * self._centres[first] + share[:, 0] * self._centres[first + 1]
        return posed(rotations, centres)

    def corrected(self, borders: FloatArray, means: FloatArray) -> Path:
        """Return this path, corrected where groups of frames were located along it.

        The frames of a group were merged along the path, so a group's pose gives the mean correction of its frames, (N, 6), not
        that of one instant. Rotations are corrected by the function with these means and the least second derivative: the
        derivative of the natural quintic spline through its integral at the borders of the groups, (N + 1,) in frames.
        Positions become such a function: within a group they were interpolated only, from poses with more noise.
        """
        starts = np.ceil(borders).astype(int)
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self._centres, axis=0)])[starts]
        centres = np.diff(sums, axis=0) / np.diff(starts)[:, None]
        means = np.concatenate([means[:, :3], centres + means[:, 3:]], axis=1)
        integral = np.concatenate([np.zeros((1, 6)), np.cumsum(means * np.diff(borders)[:, None], axis=0)])
        end = [(3, np.zeros(6)), (4, np.zeros(6))]
        ends: Any = end, end  # which the library's types do not have
        smooth = make_interp_spline(borders, integral, k=5, bc_type=ends).derivative()(np.arange(len(self.poses)))
        return Path(posed(rotation_matrices(smooth[:, :3]) @ self.poses[:, :, :3], smooth[:, 3:]))

    def rotated(self, rotations: FloatArray) -> Path:
        """Return this path with the camera rotated on the spot at each frame, by (T, 3) rotation vectors in its own axes."""
        return Path(rotation_matrices(rotations) @ self.poses)


def posed(rotations: FloatArray, centres: FloatArray) -> FloatArray:
    """Return the poses of cameras with (N, 3, 3) rotations from the world, at (N, 3) places of the world: (N, 3, 4)."""
    shifts = -np.einsum("nij,nj->ni", rotations, centres)
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def moves(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return how poses differ, (N, 3, 4) each: rotation vectors of the camera, and shifts of its place in the world; (N, 6)."""
    rotations = rotation_vectors(after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2))
    return np.concatenate([rotations, positions_of(after) - positions_of(before)], axis=1)


def projected(poses: FloatArray, points: FloatArray, camera_matrix: FloatArray) -> FloatArray:
    """Return where cameras see points of the world: (N, 3, 4) poses and (N, 3) points to (N, 2) px; NaN behind a camera."""
    seen = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
    depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    return np.asarray((seen @ camera_matrix.T)[:, :2] / depth)


def exceeding_noise_of_poses(moves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Denoise (N, 6) corrections of poses, in px, with a Wiener filter, and keep their slow part; `covariance` is (N, 6, 6)."""
    times = np.linspace(-1, 1, len(moves))
    basis = np.polynomial.legendre.legvander(times, min(_DEGREE, len(moves) - 1))
    slow = basis @ np.linalg.lstsq(basis, moves, rcond=None)[0]
    # In these modes, errors are independent of each other.
    _, modes = np.linalg.eigh(np.linalg.inv(covariance).mean(axis=0))
    variances = np.einsum("ka,nkl,la->na", modes, covariance, modes)
    rest = [exceeding_noise(*columns).signal for columns in zip(((moves - slow) @ modes).T, variances.T, strict=True)]
    return np.asarray(slow + np.stack(rest, axis=1) @ modes.T)


Image = NDArray[np.float32]

_CHUNK_PX = 1.0  # frames that move less than this are summed before they are warped
_STEP_PX = 8  # spacing of the grid on which depth is interpolated
_MARGIN = 0.05  # points up to this far outside of the frame are used, in its longer side
# A point is an outlier if its inverse depth differs from the median of its 7 neighbours by half of it.
_NEIGHBOURS = 7
_APART = 0.5
_LEAST = 4  # fewest points of a depth map


@dataclass(frozen=True, slots=True, eq=False)
class PosedExposure:
    """A virtual exposure, with its place in the world."""

    exposure: VirtualExposure  # flux and weight, seen from the reference instant of its group
    pose: FloatArray  # (3, 4) of that instant
    inverse_depth: Image  # (H, W) of its pixels


def merge_through_depth(source: Source, group: Group, path: Path, inverse_depth: Image, camera: Camera) -> PosedExposure:
    """Merge the frames of a group as its reference instant sees them (paper, section 6: aggregation that is consistent in 3D).

    Each chunk of frames is interpolated once, where its frames see the points of the reference view. Occlusions are ignored.
    """
    pose = path.at([group.reference])[0]
    counts, weight = np.zeros((2, *source.info.frame_shape), np.float32)
    lens = lens_of(camera, source.info.frame_shape)
    plane = _Plane(path, pose, float(np.median(inverse_depth)), camera)
    for chunk in chunks_of(group.span, plane, source.info.frame_shape, _CHUNK_PX):
        turn, shift = between(pose, path.at([chunk.span.centre])[0], camera.matrix)
        valid = capture_of(source).masked_in(chunk.span).valid.astype(np.float32)
        frames = lit_counts(source, chunk.span) * valid
        _add(frames, valid * np.float32(len(chunk.span)), inverse_depth, lens, turn, shift, counts, weight)
    flux, seen = PhotonSum(counts, weight).estimate(source.response)
    return PosedExposure(VirtualExposure(flux, seen, group, 1.0, source.response), pose, inverse_depth)


class _Plane:
    """The motion of a plane before a view at the median depth, by which frames are divided into chunks."""

    def __init__(self, path: Path, pose: FloatArray, inverse_depth: float, camera: Camera) -> None:
        self._path, self._pose, self._inverse_depth, self._matrix = path, pose, inverse_depth, camera.matrix

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the maps from pixels of frames to those of the view: (N, 3, 3)."""
        maps, shifts = between(self._pose, self._path.at(frame_indices), self._matrix)
        maps[:, :, 2] += self._inverse_depth * shifts
        return scaled_ahead(inverse(maps))


def lit_counts(source: Source, span: FrameSpan) -> Image:
    """Return the sum of the frames of a span, of the flux alone: (H, W)."""
    return capture_of(source).corrected_counts(span).astype(np.float32)


@compiled
def _add(  # noqa: PLR0917
    frames: Image,
    frame_weight: Image,
    inverse_depth: Image,
    lens: Lens,
    turn: FloatArray,
    shift: FloatArray,
    counts: Image,
    weight: Image,
) -> None:
    """Add (H, W) counts and weights of frames to those of a view, interpolated bilinearly; see `path.between`."""
    height, width = frames.shape
    for y in range(height):
        row, counts_of, weight_of = inverse_depth[y], counts[y], weight[y]
        for x in range(width):
            u, v, _ = seen_at(lens, turn, shift, lens.ideal[y, x, 0], lens.ideal[y, x, 1], row[x])
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            i, j = min(int(u), width - 2), min(int(v), height - 2)
            a, b = np.float32(u - i), np.float32(v - j)
            upper, lower = frames[j], frames[j + 1]
            upper_weight, lower_weight = frame_weight[j], frame_weight[j + 1]
            one = np.float32(1)
            counts_of[x] += (one - b) * ((one - a) * upper[i] + a * upper[i + 1]) + b * (
                (one - a) * lower[i] + a * lower[i + 1]
            )
            weight_of[x] += (one - b) * ((one - a) * upper_weight[i] + a * upper_weight[i + 1]) + b * (
                (one - a) * lower_weight[i] + a * lower_weight[i + 1]
            )


def inverse_depth_of(pose: FloatArray, points: FloatArray, camera: Camera, shape: tuple[int, int]) -> Image | None:
    """Return the inverse depth of the pixels of a view, (H, W), from points of the world; None if it sees fewer than 4.

    It is linear between points, as that of a plane is. At the edges of things it is wrong by the width of a triangle; within a
    group, the camera moves so little that this hardly matters.
    """
    height, width = shape
    seen = points @ pose[:, :3].T + pose[:, 3]
    seen = seen[seen[:, 2] > 0]
    pixels = seen @ camera.matrix.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    margin = _MARGIN * max(shape)
    ideal = lens_of(camera, shape).ideal
    low, high = np.nanmin(ideal, axis=(0, 1)) - margin, np.nanmax(ideal, axis=(0, 1)) + 1 + margin
    inside = ((pixels > low) & (pixels < high)).all(axis=1)
    pixels, inverse_depth = pixels[inside], 1 / seen[inside, 2]
    if len(pixels) >= _NEIGHBOURS:
        _, nearest = cKDTree(pixels).query(pixels, k=_NEIGHBOURS)
        median = np.median(inverse_depth[nearest], axis=1)
        kept = np.abs(inverse_depth - median) < _APART * median
        pixels, inverse_depth = pixels[kept], inverse_depth[kept]
    if len(pixels) < _LEAST or np.linalg.matrix_rank(pixels - pixels.mean(axis=0), tol=1.0) < 2:
        return None
    rows, columns = -(-height // _STEP_PX), -(-width // _STEP_PX)
    middle = (_STEP_PX - 1) / 2
    x, y = np.meshgrid(np.arange(columns) * _STEP_PX + middle, np.arange(rows) * _STEP_PX + middle)
    places = camera.ideal(np.stack([x, y], axis=-1))
    places = np.where(np.isfinite(places), places, camera.centre_px)
    grid = LinearNDInterpolator(pixels, inverse_depth)(places)
    grid = np.where(np.isfinite(grid), grid, NearestNDInterpolator(pixels, inverse_depth)(places)).astype(np.float32)
    fine = cv2.resize(grid, (columns * _STEP_PX, rows * _STEP_PX), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width])


@dataclass(frozen=True, slots=True, eq=False)
class Tremor:
    """Motion of the camera at higher frequencies than its path."""

    rotations: FloatArray  # (T, 3) small rotation vectors of the camera at each frame
    std: FloatArray  # (T,) their noise, in radians
    rms_px: float  # root mean square of the displacement in the image
    shift: float  # root mean square of the shifts within groups, which are not corrected, in units of the world


def find_tremor(
    source: Source, exposures: Sequence[PosedExposure], path: Path, camera: Camera, pool: ThreadPoolExecutor
) -> Tremor | None:
    """Find how the camera moves within groups, side by side, that were merged along a path; None if the frames are too few.

    A span of a few frames shows the exposure of its group, moved by a step of the camera. Steps are estimated by weighted least
    squares, and denoised with a Wiener filter. The result does not depend on the number of threads of the pool.
    """
    inverse_depth = float(np.median([np.median(each.inverse_depth) for each in exposures]))
    predicted = list(pool.map(lambda posed: _prediction(posed, camera, inverse_depth), exposures))
    # Frames of a span that shows a shift with little noise.
    of_frame = np.mean([each.information[:2, :2] for each in predicted], axis=0)
    variance = float(np.trace(np.linalg.pinv(of_frame))) / 2
    size = int(np.clip(np.ceil(variance / _NOISE_PX**2), _SHORTEST, _LONGEST))

    def measured(posed: PosedExposure, prediction: _Prediction) -> list[_Equations]:
        group = posed.exposure.group.span
        borders = np.linspace(group.start, group.stop, max(1, round(len(group) / size)) + 1).round().astype(int).tolist()
        spans = [FrameSpan(*ends) for ends in pairwise(borders)]
        maps = between(posed.pose, path.at([span.centre for span in spans]), camera.matrix)
        return [
            _measured(source, span, turn, shift=shift, posed=posed, predicted=prediction)
            for span, turn, shift in zip(spans, *maps, strict=True)
        ]

    found = [equations for each in pool.map(measured, exposures, predicted) for equations in each]
    if len(found) < _FEWEST:
        return None
    gradient, information = np.array([each.gradient for each in found]), np.array([each.information for each in found])
    of_rotations, mean = information[:, _ROTATIONS, _ROTATIONS], information[:, _ROTATIONS, _ROTATIONS].mean(axis=0)
    # In these modes, errors are independent of each other.
    _, modes = np.linalg.eigh(mean)
    steps, variances = _solved(gradient[:, _ROTATIONS] @ modes, modes.T @ of_rotations @ modes)
    filtered = [exceeding_noise(*columns) for columns in zip(steps.T, variances.T, strict=True)]
    rotations = np.stack([each.signal for each in filtered], axis=1) @ modes.T
    noise = np.sqrt(sum(each.std**2 for each in filtered))
    instants, frames = np.array([each.instant for each in found]), np.arange(source.info.n_frames)
    at_frames = CubicSpline(instants, rotations)(np.clip(frames, instants[0], instants[-1]))
    # A turn about x or y moves all pixels alike, but for the corners.
    moved_px = np.sqrt(np.mean(np.einsum("si,ij,sj->s", rotations, mean, rotations)) / max(np.trace(mean[:2, :2]) / 2, 1e-12))
    focal_px = camera.focal_px
    shift = _beyond_noise(_solved(gradient, information)[0][:, _SIDEWAYS]) / (focal_px * inverse_depth)
    return Tremor(at_frames / focal_px, np.interp(frames, instants, noise) / focal_px, float(moved_px), shift)


def _beyond_noise(shifts: FloatArray) -> float:
    """Return the root mean square of the shifts along all axes beyond noise that is white, from those along two: (S, 2)."""
    power = np.abs(np.fft.rfft(shifts - shifts.mean(axis=0), axis=0)[1:]) ** 2
    # The median of an exponential distribution is its mean times ln 2.
    excess = float((power.mean(axis=0) - np.median(power, axis=0) / np.log(2)).sum()) / len(shifts)
    return float(np.sqrt(max(0.0, _AXES / shifts.shape[1] * excess)))


class _Prediction(NamedTuple):
    """Expected counts of a frame of a group, seen from its reference instant."""

    mean: Image  # (H, W) expected count of a frame
    slope_x: Image  # (H, W) its slope along x of ideal pixels, divided by the variance of a frame; 0 where it is not known
    slope_y: Image  # (H, W) the same along y
    gain: Image  # (H, W) the mean, divided by that variance; 0 where the slopes are not known
    inverse_depth: Image  # (H, W)
    mean_depth: float  # inverse depth at which a shift of the camera counts in px
    lens: Lens
    information: FloatArray  # (7, 7) of one frame that sees all of it


class _Equations(NamedTuple):
    """Normal equations of the motion of a span, with its gain eliminated, in px of the image."""

    instant: float  # centre of the span, in frames
    gradient: FloatArray  # (6,) right-hand side
    information: FloatArray  # (6, 6)


def _solved(gradient: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the solutions of (S, N) and (S, N, N) equations, and their variances, infinite if unknown: (S, N) each."""
    known = np.linalg.eigvalsh(information)[:, 0] > _LEAST_INFORMATION
    covariance = np.linalg.inv(np.where(known[:, None, None], information, np.eye(gradient.shape[1])))
    steps = np.einsum("sab,sb->sa", covariance, gradient)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    return np.where(known[:, None], steps, 0.0), np.where(known[:, None], variances, np.inf)


def _prediction(posed: PosedExposure, camera: Camera, mean_depth: float) -> _Prediction:
    exposure, response = posed.exposure, posed.exposure.response
    known = np.isfinite(exposure.flux) & (exposure.weight > 0)
    flux, frames = np.where(known, exposure.flux, np.float32(0)), np.where(known, exposure.weight, np.float32(1))
    mean = response.mean_count(flux)
    little = np.float32(1e-2) * np.maximum(flux, np.float32(1e-2))
    by_flux = (response.mean_count(flux + little) - mean) / little
    variance = np.maximum((by_flux * flux_std(flux, frames, response)) ** 2 * frames, np.float32(1e-6))
    inner = cv2.erode(known.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8), borderValue=0).astype(bool)
    smooth = cv2.GaussianBlur(mean, (0, 0), _BLUR_PX)
    slope_x, slope_y = (np.where(inner, cv2.filter2D(smooth, cv2.CV_32F, each), np.float32(0)) for each in _DIFFERENCES)
    lens = lens_of(camera, flux.shape)
    (x_x, x_y), (y_x, y_y) = np.moveaxis(lens.slopes.astype(np.float32), (2, 3), (0, 1))
    slope_x, slope_y = slope_x * x_x + slope_y * y_x, slope_x * x_y + slope_y * y_y
    # The gradient of noise would count as structure.
    noise = np.where(inner, np.float32(_SLOPE_NOISE) * (x_x * y_y - x_y * y_x) / frames, np.float32(0))
    gain = np.where(inner, mean / variance, np.float32(0))
    information = np.zeros((_GAIN + 1, _GAIN + 1))
    predicted = _Prediction(
        mean, slope_x / variance, slope_y / variance, gain, posed.inverse_depth, mean_depth, lens, information
    )
    _add_information(predicted, slope_x, slope_y, noise)
    information += np.triu(information, 1).T
    return predicted


_DIFFERENCES = [np.array(kernel, np.float32) for kernel in ([[-0.5, 0, 0.5]], [[-0.5], [0], [0.5]])]


def _measured(
    source: Source, span: FrameSpan, turn: FloatArray, *, shift: FloatArray, posed: PosedExposure, predicted: _Prediction
) -> _Equations:
    """Return the motion of the camera in a span, beyond that along which its group was merged."""
    valid = capture_of(source).masked_in(span).valid.astype(np.float32)
    sums = np.zeros(_GAIN + 2)
    frames, weight = lit_counts(source, span) * valid, valid * np.float32(len(span))
    _add_residuals(frames, weight, predicted, turn, shift, sums)
    gradient, seen, every = sums[:-1], sums[-1], predicted.information
    every = every * (seen / every[_GAIN, _GAIN] if every[_GAIN, _GAIN] > 0 else 0.0)
    mixed, gain = every[_MOTION, _GAIN], max(every[_GAIN, _GAIN], _LEAST_INFORMATION)
    # The exposure holds the frames of the span, and follows them by their share.
    others = 1 - len(span) / len(posed.exposure.group.span)
    information = (every[_MOTION, _MOTION] - np.outer(mixed, mixed) / gain) * others
    return _Equations(span.centre, gradient[_MOTION] - mixed * (gradient[_GAIN] / gain), information)


@compiled
def _add_information(predicted: _Prediction, slope_x: Image, slope_y: Image, noise: Image) -> None:
    """Add the upper triangle of the information of one frame, from the slopes (H, W) of the mean count.

    `noise` is (H, W), the variance of a slope that is noise, divided by that of a frame.
    """
    height, width = slope_x.shape
    along_x, along_y = np.zeros(6), np.zeros(6)
    total = predicted.information
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            q = predicted.inverse_depth[row, column]
            _moves(row, column, q / predicted.mean_depth, predicted.lens, along_x, along_y)
            x_x = predicted.slope_x[row, column] * slope_x[row, column] - noise[row, column]
            x_y = predicted.slope_x[row, column] * slope_y[row, column]
            y_y = predicted.slope_y[row, column] * slope_y[row, column] - noise[row, column]
            mean = predicted.mean[row, column]
            x_m, y_m = predicted.slope_x[row, column] * mean, predicted.slope_y[row, column] * mean
            for i in range(6):
                u, v = along_x[i] * x_x + along_y[i] * x_y, along_x[i] * x_y + along_y[i] * y_y
                for j in range(i, 6):
                    total[i, j] += u * along_x[j] + v * along_y[j]
                total[i, 6] -= along_x[i] * x_m + along_y[i] * y_m
            total[6, 6] += gain * mean


@compiled
def _add_residuals(  # noqa: PLR0917
    frames: Image, frame_weight: Image, predicted: _Prediction, turn: FloatArray, shift: FloatArray, sums: FloatArray
) -> None:
    """Add the right-hand side of the equations of a span, and the light that it sees, to the (8,) sums; see `path.between`."""
    (height, width), lens = frames.shape, predicted.lens
    along_x, along_y = np.zeros(6), np.zeros(6)
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            q = predicted.inverse_depth[row, column]
            u, v, _ = seen_at(lens, turn, shift, lens.ideal[row, column, 0], lens.ideal[row, column, 1], q)
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            i, j = min(int(u), width - 2), min(int(v), height - 2)
            a, b = u - i, v - j
            seen = (1 - b) * ((1 - a) * frame_weight[j, i] + a * frame_weight[j, i + 1]) + b * (
                (1 - a) * frame_weight[j + 1, i] + a * frame_weight[j + 1, i + 1]
            )
            lit = (1 - b) * ((1 - a) * frames[j, i] + a * frames[j, i + 1]) + b * (
                (1 - a) * frames[j + 1, i] + a * frames[j + 1, i + 1]
            )
            mean = predicted.mean[row, column]
            residual = lit - seen * mean
            _moves(row, column, q / predicted.mean_depth, predicted.lens, along_x, along_y)
            by_x, by_y = residual * predicted.slope_x[row, column], residual * predicted.slope_y[row, column]
            # The image moves against the camera.
            for k in range(6):
                sums[k] -= by_x * along_x[k] + by_y * along_y[k]
            sums[6] += residual * gain
            sums[7] += seen * gain * mean


@compiled
def _moves(row: int, column: int, q: float, lens: Lens, along_x: FloatArray, along_y: FloatArray) -> None:  # noqa: PLR0917
    """Write, (6,) each, how rotations about the camera's axes and translations along them move a pixel, in focal lengths."""
    x = (lens.ideal[row, column, 0] - lens.centre[0]) / lens.focal
    y = (lens.ideal[row, column, 1] - lens.centre[1]) / lens.focal
    along_x[0], along_x[1], along_x[2] = -x * y, 1 + x * x, -y
    along_y[0], along_y[1], along_y[2] = -(1 + y * y), x * y, x
    along_x[3], along_x[4], along_x[5] = q, 0.0, -x * q
    along_y[3], along_y[4], along_y[5] = 0.0, q, -y * q
