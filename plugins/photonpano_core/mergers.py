"""Merge frames along a motion: the most likely flux (paper, section 4, "Merge", and equation 3), and lit pixels one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import (
    BoolArray,
    FloatArray,
    FrameSpan,
    Group,
    Homography,
    InputError,
    Source,
    Trajectory,
    VirtualExposure,
    capture_of,
)
from photonpano.compiling import compiled
from photonpano.geometry import corners, inverse, rescaling, transform_points, visible_columns
from photonpano.merging import Chunk, CountsCache, PhotonSum, accumulate, chunks_of, clipped, divided, gain_image
from photonpano_core.configs import PhotonMleConfig

Decide = Callable[[str, float, str], None]

_CACHE_BYTES = 64 * 1024**2  # for the sums that overlapping groups share: about those of one group
Image = NDArray[np.float32]
Frames = NDArray[np.unsignedinteger[Any]]

_WORD = np.uint64
_READ_BYTES = 1024**2  # unpacked frames read at a time: about the cache of a core
_RIGID = 0.01  # deviation of the pixel spacing from 1 px below which splat weights sum to 1 within its square


class PhotonMleMerger:
    """Warps the counts of a group to its reference instant and estimates the flux once.

    Warps are relative to the reference instant, not to the panorama, so that they are small. A pixel lit in every frame gets
    the flux that `BinaryResponse` states; a pixel that was seen in less than one whole frame is unknown.
    """

    def __init__(self, config: PhotonMleConfig, decide: Decide | None = None) -> None:
        """Take the keys of the spec, and what records the mean length of chunks along each motion, with the reason."""
        self._config, self._decide = config, decide
        self._shared: _Shared | None = None
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[PhotonMleMerger], tuple[PhotonMleConfig, Decide | None]]:
        """Travel without the sums of chunks."""
        return PhotonMleMerger, (self._config, self._decide)

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        if trajectory is None or not self._config.compensate:
            photons = unwarped_sum(source, group, scale)
        else:
            shared = self._shared_along(source, trajectory)
            chunks = clipped(shared.chunks, group.span, trajectory)
            shape = exposure_shape(source, scale)
            photons = accumulate(source, chunks, to_exposure(group, trajectory, scale), shape, counts_of=shared.counts)
        return exposure_of(photons, source, group, scale)

    def _shared_along(self, source: Source, trajectory: Trajectory) -> _Shared:
        with self._lock:
            shared = self._shared
            if shared is None or shared.source is not source or shared.trajectory is not trajectory:
                tolerance_px = self._config.tolerance_px
                cuts = [each.start for each in capture_of(source).pieces(source.info.span)]
                chunks = chunks_of(source.info.span, trajectory, source.info.frame_shape, tolerance_px, cuts)
                if self._decide is not None:
                    self._decide(
                        "chunk_frames",
                        round(source.info.n_frames / len(chunks), 1),
                        f"mean number of consecutive frames that move less than tolerance_px = {tolerance_px:g}; they are "
                        "summed before they are warped",
                    )
                shared = self._shared = _Shared(source, trajectory, chunks, CountsCache(source, _CACHE_BYTES))
            return shared


@dataclass(frozen=True, slots=True, eq=False)
class _Shared:
    """Chunks of a capture along a motion, with their sums: shared by the groups of a level."""

    source: Source
    trajectory: Trajectory
    chunks: tuple[Chunk, ...]
    counts: CountsCache


def equal_spans(span: FrameSpan, n: int) -> list[FrameSpan]:
    """Divide a span into `n` spans of nearly the same length; one at least."""
    return [FrameSpan(span.start + part.start, span.start + part.stop) for part in divided(len(span), max(1, n))]


def parts_of(group: Group, n: int) -> tuple[list[FrameSpan], int]:
    """Divide a group into `n` spans, and return also the index of the one that contains the reference instant."""
    spans = equal_spans(group.span, n)
    return spans, next(place for place, span in enumerate(spans) if group.reference < span.stop)


def require_plain(source: Source, merger: str) -> None:
    """Raise an `InputError` for a lens that distorts, or light that changes, which `photon-mle` handles."""
    capture = capture_of(source)
    if capture.camera is not None and capture.camera.distorts:
        raise InputError(f"merge.use: {merger} does not warp through a lens that distorts; use photon-mle")
    if capture.light is not None:
        raise InputError(f"merge.use: {merger} does not divide by light that changes; use photon-mle")


def exposure_shape(source: Source, scale: float) -> tuple[int, int]:
    """Return the (height, width) of an exposure."""
    height, width = source.info.frame_shape
    return max(1, round(height * scale)), max(1, round(width * scale))


def to_exposure(group: Group, trajectory: Trajectory, scale: float) -> Homography:
    """Return (3, 3): pixels of the reference plane to pixels of the exposure, at the group's reference instant."""
    return rescaling(scale) @ inverse(trajectory.at([group.reference])[0])


def unwarped_sum(source: Source, group: Group, scale: float) -> PhotonSum:
    """Sum the frames of a group as they are, while no motion is known."""
    chunks = [Chunk(each, np.eye(3)) for each in capture_of(source).pieces(group.span)]
    return accumulate(source, chunks, rescaling(scale), exposure_shape(source, scale))


def exposure_of(photons: PhotonSum, source: Source, group: Group, scale: float) -> VirtualExposure:
    """Estimate the flux of a sum."""
    flux, weight = photons.estimate(source.response)
    return VirtualExposure(flux, weight, group, scale, source.response)


class SplatMerger:
    """Warps lit pixels one by one, sums them, and estimates the flux once (paper, equation 3).

    Frames are not summed before they are warped, so that no photon is misplaced. Dark pixels cost nothing: the time per frame
    grows with the number of its photons, not with the motion. The weight is the warp of frames of ones, so that the quotient is
    not biased at masks, at borders and where the grid is finer than a frame. In changing light it is multiplied by the mean
    gain of the group.
    """

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`. Raises an `InputError` if sums are corrected, or the lens distorts."""
        capture = capture_of(source)
        if capture.corrects_sums:
            raise InputError(
                "merge.use: splat warps photons one by one, so that it cannot subtract dark counts, interpolate pixels or "
                "compare colours; use photon-mle, or only corrections that move or mask pixels"
            )
        if capture.camera is not None and capture.camera.distorts:
            raise InputError("merge.use: splat does not warp through a lens that distorts; use photon-mle")
        if trajectory is None:
            photons = unwarped_sum(source, group, scale)
        else:
            frames = np.arange(group.span.start, group.span.stop)
            to_grid = to_exposure(group, trajectory, scale) @ trajectory.at(frames)
            to_grid /= np.cbrt(np.linalg.det(to_grid))[:, None, None]
            shape = exposure_shape(source, scale)
            counts = np.zeros((shape[0] + 2, shape[1] + 2), np.float32)  # with a margin
            height, width = source.info.frame_shape
            for part in group.span.blocks(max(1, _READ_BYTES // (height * width))):
                maps = to_grid[part.start - group.span.start : part.stop - group.span.start]
                splat(source.frames(part), source.valid, maps, counts)
            photons = PhotonSum(_without_margin(counts), _weight(source.valid, to_grid, shape))
            if capture.light is not None:
                gain = gain_image(capture.light, group.span, inverse(to_exposure(group, trajectory, scale)), shape)
                photons = PhotonSum(photons.counts, photons.weight * gain)
        return exposure_of(photons, source, group, scale)


def _weight(valid: BoolArray, to_grid: FloatArray, shape: tuple[int, int]) -> Image:
    """Return the sum of splats of the valid pixels of frames of ones: (H, W)."""
    weight = np.zeros(shape, np.float32)
    # Where the pixels of all frames stay 1 px apart, weights need not be splatted.
    neighbours = corners(valid.shape)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    placed = transform_points(to_grid, neighbours.reshape(-1, 2)).reshape(len(to_grid), 4, 3, 2)
    rigid = bool(np.abs(placed[:, :, 1:] - placed[:, :, :1] - np.eye(2)).max() < _RIGID)
    if rigid:
        steps = np.zeros((shape[0], shape[1] + 1), np.float32)
        add_coverage(valid.shape, inverse(to_grid), weight, steps)
        weight += np.cumsum(steps, axis=1)[:, :-1]
    each = np.zeros((shape[0] + 2, shape[1] + 2), np.float32)  # with a margin
    counted = ~valid if rigid else valid
    if counted.any():
        ones = np.ones((1, *valid.shape), np.uint8)
        for one in to_grid[:, None]:
            splat(ones, counted, one, each)
    return np.maximum(weight - _without_margin(each), 0) if rigid else _without_margin(each)


def _without_margin(grid: Image) -> Image:
    return np.ascontiguousarray(grid[1:-1, 1:-1])


def splat(frames: Frames, used: BoolArray, to_grid: FloatArray, total: Image) -> None:
    """Add the (n, h, w) counts of frames to a grid, each with bilinear weights to four pixels, times the area of its pixel.

    This is the adjoint of bilinear interpolation. The `to_grid` maps have determinant 1, so that the area is `1 / depth^3` with
    the depth `h31 x + h32 y + h33`, positive in front of the camera. `total` is (H + 2, W + 2): it has a margin of a pixel for
    photons that cross its border.
    """
    lanes = _WORD().itemsize // frames.itemsize
    missing = -frames.shape[2] % lanes
    rows: Frames = np.pad(frames, ((0, 0), (0, 0), (0, missing))) if missing else np.ascontiguousarray(frames)
    _splat(rows, rows.view(_WORD), used, to_grid, total)


@compiled
def _splat(frames: Frames, words: NDArray[np.uint64], used: BoolArray, to_grid: FloatArray, total: Image) -> None:
    """Splat rows of whole words, and skip words that are 0."""
    n_frames, height, width = frames.shape
    words_a_row = words.shape[2]
    lanes = width // words_a_row
    columns, down, one = total.shape[1], np.uint64(total.shape[1]), np.uint64(1)
    right, bottom = total.shape[1] - 1.0, total.shape[0] - 1.0
    grid = total.reshape(-1)
    busy, lit = np.empty(words_a_row + 1, np.int64), np.empty(width + 1, np.int64)
    for index in range(n_frames):
        h00, h01, h02 = to_grid[index, 0]
        h10, h11, h12 = to_grid[index, 1]
        h20, h21, h22 = to_grid[index, 2]
        image, packed = frames[index].reshape(-1), words[index].reshape(-1)
        for y in range(height):
            # Photons are random, so that branches would be mispredicted: lit pixels are collected without a branch.
            n_busy = n_lit = 0
            for word in range(words_a_row):
                busy[np.uint64(n_busy)] = word
                n_busy += packed[np.uint64(y * words_a_row + word)] != 0
            for number in range(n_busy):
                first = busy[np.uint64(number)] * lanes
                for x in range(first, first + lanes):
                    lit[np.uint64(n_lit)] = x
                    n_lit += image[np.uint64(y * width + x)] != 0
            x_0, y_0, depth_0 = h01 * y + h02, h11 * y + h12, h21 * y + h22
            for number in range(n_lit):
                x = lit[np.uint64(number)]
                if not used[y, x]:
                    continue
                inverse_depth = 1 / (h20 * x + depth_0)
                # Relative to the corner of the margin, so that coordinates on the grid are not negative.
                u, v = (h00 * x + x_0) * inverse_depth + 1, (h10 * x + y_0) * inverse_depth + 1
                if not (inverse_depth > 0 and 0 <= u < right and 0 <= v < bottom):
                    continue
                left, top = int(u), int(v)
                mass = image[np.uint64(y * width + x)] * inverse_depth * inverse_depth * inverse_depth
                a, b = u - left, mass * (v - top)
                place = np.uint64(top * columns + left)
                grid[place] += np.float32((1 - a) * (mass - b))
                grid[place + one] += np.float32(a * (mass - b))
                grid[place + down] += np.float32((1 - a) * b)
                grid[place + down + one] += np.float32(a * b)


@compiled
def add_coverage(shape: tuple[int, int], to_frame: FloatArray, total: Image, steps: Image) -> None:
    """Add the sum of splats of frames of ones whose pixels stay 1 px apart, 1 inside a frame and less at its border, to (H, W).

    `to_frame` are (n, 3, 3) maps of the grid to frames. `steps` (H, W + 1) are row-wise differences, whose cumulative sums are
    to be added in the end.
    """
    height, width = shape
    rows, columns = total.shape
    for h in to_frame:
        for y in range(rows):
            first, last = visible_columns(h, y, -1.0, width, -1.0, height, columns)
            inside, outside = visible_columns(h, y, 0.0, width - 1.0, 0.0, height - 1.0, columns)
            if inside >= outside:
                inside = outside = last
            steps[y, inside] += 1
            steps[y, outside] -= 1
            for part in ((first, inside), (outside, last)):
                for x in range(part[0], part[1]):
                    inverse_depth = 1 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
                    u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * inverse_depth
                    v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * inverse_depth
                    along, across = 1 + min(u, width - 1 - u, 0.0), 1 + min(v, height - 1 - v, 0.0)
                    total[y, x] += max(along, 0.0) * max(across, 0.0)
