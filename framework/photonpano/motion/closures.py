"""Loop closures: find exposures that may show a place seen before, and measure the similarity of two exposures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import corners, inverse, rescaled, rescaling, transform_points, translation
from photonpano.motion.graph import GraphOptions, GraphSolution
from photonpano.motion.level import FrameHomography
from photonpano.motion.pairs import instants_of, lengths_of
from photonpano.photometry import noise_free_correlation
from photonpano.values import FloatArray, FluxImage, Group, VirtualExposure

# Least similarity of a loop closure: that of one place is 0.9 and more in enough light, that of different places below 0.5.
MIN_SIMILARITY = 0.7
_GRID = 8  # the overlap of two fields of view is counted on a grid of this many points along each axis
_MIN_SKIP = 2.0  # the exposures of a loop closure are at least this many times as far apart in time as the longest skip
# Between two visits of a place the overlap falls by at least this share, two columns of the grid; a tremor does not count.
_PROMINENCE = 0.25
_MAX_CLOSURES = 3  # most loop closures of an exposure with earlier ones; those of the largest overlap are taken
# Most exposures of a level with loop closures to earlier ones, spread over the capture. Neighbours tie the others to them.
_MAX_EXPOSURES = 64
# Exposures are compared by averages of blocks of this side, px: these have less noise, and hide differences of motion blur.
_BLOCK = 4


def closure_candidates(
    groups: Sequence[Group], solution: GraphSolution, frame_shape: tuple[int, int], graph: GraphOptions
) -> list[tuple[int, int]]:
    """Return pairs (moving, fixed) of exposures that overlap at different times, ordered by the moving one.

    An exposure is paired with the best view of each earlier visit: a prominent maximum of the overlap, as a function of time.
    Exposures that are denser than their length are thinned out.
    """
    if graph.closure_overlap is None:
        return []
    instants, lengths = instants_of(groups), lengths_of(groups)
    length = float(np.quantile(lengths, 0.5, method="lower"))  # one that occurs
    spacing = float(np.median(np.diff(instants))) if len(groups) > 1 else length
    chosen = np.flatnonzero(solution.located & (lengths == length))[:: max(1, round(length / spacing))]
    min_interval = _MIN_SKIP * max([1.0, *graph.skips]) * length
    pairs: list[tuple[int, int]] = []
    for position, moving in list(enumerate(chosen))[:: max(1, -(-len(chosen) // _MAX_EXPOSURES))]:
        earlier = chosen[:position]
        overlap = _overlaps(solution.homographies[moving], solution.homographies[earlier], frame_shape)
        peaks = _visits(overlap, graph.closure_overlap)
        peaks = peaks[instants[earlier[peaks]] <= instants[moving] - min_interval]
        best = peaks[np.argsort(-overlap[peaks], kind="stable")[:_MAX_CLOSURES]]
        pairs += [(int(moving), int(fixed)) for fixed in np.sort(earlier[best])]
    return pairs


def exposure_similarity(moving: VirtualExposure, fixed: VirtualExposure, homography: FrameHomography) -> float:
    """Return the correlation of two exposures of one scale that they would have without photon noise, under a motion.

    It is 1 for the same place and around 0 for different ones; 0 where the overlap is small, or the scene does not stand out
    from the noise.
    """
    height, width = (side // _BLOCK for side in moving.flux.shape)
    if not height * width:
        return 0.0
    # From block numbers to the top left pixels of the nearest blocks of the other exposure: interpolation between averages
    # would change their noise.
    half = (_BLOCK - 1) / 2
    to_fixed = translation(-half, -half) @ rescaled(homography, moving.scale) @ rescaling(_BLOCK)
    first, first_variance = (image[::_BLOCK, ::_BLOCK][:height, :width] for image in _averages(moving))
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    second, second_variance = (
        cv2.warpPerspective(image, to_fixed, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        for image in _averages(fixed)
    )
    both = np.isfinite(first) & np.isfinite(second)
    if not both.any():
        return 0.0
    noise = float(first_variance[both].mean()), float(second_variance[both].mean())
    return noise_free_correlation(np.cov(first[both], second[both].astype(np.float32)), noise, float(both.sum()))


def _averages(exposure: VirtualExposure) -> tuple[FluxImage, FluxImage]:
    """Return the average of the block that starts at each pixel, on the scale where noise is uniform, and its variance.

    Both are NaN where part of the block was not seen.
    """
    seen = exposure.weight > 0
    values = np.where(seen, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(np.nan))
    variance = np.full_like(values, np.nan)
    variance[seen] = exposure.response.stabilised_std(exposure.weight[seen]) ** 2 / _BLOCK**2
    kernel = np.full((_BLOCK, _BLOCK), 1 / _BLOCK**2)
    rows, columns = (side - _BLOCK + 1 for side in values.shape)
    mean, mean_variance = (
        np.asarray(cv2.filter2D(image, -1, kernel, anchor=(0, 0))[:rows, :columns], np.float32) for image in (values, variance)
    )
    return mean, mean_variance


def _visits(overlap: FloatArray, min_overlap: float) -> NDArray[np.integer]:
    """Return the positions of the prominent maxima of the overlap: the best view of each earlier visit.

    Equal to `scipy.signal.find_peaks`, whose import takes a second.
    """
    # Bounded by no overlap before the first exposure, and the full overlap of the exposure with itself.
    profile = np.concatenate([[0.0], overlap, [1.0]])
    peaks = []
    inner = profile[1:-1]
    for peak in np.flatnonzero((inner >= min_overlap) & (inner > profile[:-2]) & (inner >= profile[2:])) + 1:
        higher_before, higher_after = (np.flatnonzero(side > profile[peak]) for side in (profile[:peak], profile[peak:]))
        start = higher_before[-1] if higher_before.size else 0
        stop = peak + (higher_after[0] if higher_after.size else len(profile) - peak)
        prominence = profile[peak] - max(profile[start:peak].min(), profile[peak:stop].min())
        if prominence >= _PROMINENCE:
            plateau = int(np.argmax(profile[peak:] != profile[peak]))
            peaks.append(peak - 1 + (plateau - 1) // 2)
    return np.array(peaks, dtype=int)


def _overlaps(moving: FloatArray, fixed: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the share of one field of view that each of N others sees: (N,)."""
    low, high = corners(frame_shape)[[0, 2]]
    # Centres of cells: points on the border would leave the field of view at the least motion.
    x, y = (low[axis] + (high[axis] - low[axis]) * (np.arange(_GRID) + 0.5) / _GRID for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    between = inverse(fixed) @ moving
    seen = transform_points(between, points)
    ahead = points @ between[:, 2, :2, None] + between[:, 2:, 2, None] > 0
    with np.errstate(invalid="ignore"):
        inside = np.all((seen >= low) & (seen <= high), axis=-1) & ahead[..., 0]
    return np.asarray(inside.mean(axis=-1))
