"""Loop closures: which exposures may show a place seen before, and whether two exposures show the same place."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import apply, corners, inverse, rescaled, rescaling, translation
from photonpano.motion.pairs import instants_of, lengths_of
from photonpano.photometry import noise_free_correlation
from photonpano.values import BoolArray, FloatArray, FluxImage, Group, Homography, VirtualExposure

_GRID = 8
"""The overlap of two fields of view is counted on so many points squared."""
_CLOSURE_SKIP = 2.0
"""Places seen again lie so many times further away in time than the most distant skip."""
_PROMINENCE = 0.25
"""Between two visits the overlap falls by at least this: a camera that only trembles has not been away. It is what two
columns of the grid hold."""
_MOST_REVISITS = 3
"""An exposure is registered with so many earlier visits at most, those that it shares most with."""
_MOST_RETURNS = 64
"""So many exposures, spread over the capture, are registered with earlier visits at most. Neighbours tie the others to them."""
_BLOCK = 4
"""Averages of so many pixels squared are compared: what motion blurs differently does not count, and noise counts less."""


def revisits(
    groups: Sequence[Group],
    homographies: FloatArray,
    located: BoolArray,
    frame_shape: tuple[int, int],
    skips: Sequence[float],
    min_overlap: float,
) -> list[tuple[int, int]]:
    """Return pairs (moving, fixed) of exposures that see one place at different times: candidates for loop closures.

    For an exposure, the best view of each earlier visit counts: going back in time, the overlap first falls and then rises.
    Exposures that lie denser than their length are thinned out, since they say the same; of very many, some will do.

    Args:
        groups: the groups of the level, in order of their instants.
        homographies: (N, 3, 3) frame pixels to a common plane.
        located: (N,) which of them are known.
        frame_shape: (height, width) of a frame.
        skips: the pairs that are registered anyway, in group lengths.
        min_overlap: the least share of the field of view that both see.
    """
    instants, lengths = instants_of(groups), lengths_of(groups)
    length = float(np.median(lengths))
    spacing = float(np.median(np.diff(instants))) if len(groups) > 1 else length
    chosen = np.flatnonzero(located & (lengths == length))[:: max(1, round(length / spacing))]
    away = _CLOSURE_SKIP * max([1.0, *skips]) * length
    pairs: list[tuple[int, int]] = []
    every = -(-len(chosen) // _MOST_RETURNS)
    for position, moving in list(enumerate(chosen))[::every]:
        earlier = chosen[:position]
        overlap = _overlaps(homographies[moving], homographies[earlier], frame_shape)
        peaks = _visits(overlap, min_overlap)
        peaks = peaks[instants[earlier[peaks]] <= instants[moving] - away]
        best = peaks[np.argsort(-overlap[peaks], kind="stable")[:_MOST_REVISITS]]
        pairs += [(int(moving), int(fixed)) for fixed in np.sort(earlier[best])]
    return pairs


def agreement(moving: VirtualExposure, fixed: VirtualExposure, homography: Homography) -> float:
    """Return how alike two exposures are under a motion: the correlation they would have without photon noise.

    Args:
        moving: one exposure.
        fixed: another one, of the same scale.
        homography: (3, 3), pixels of the moving exposure's frame to pixels of the fixed one's.

    Returns:
        1 for the same place, around 0 for different ones; 0 where little is seen by both, or only noise is.
    """
    height, width = (side // _BLOCK for side in moving.flux.shape)
    if not height * width:
        return 0.0
    # From numbers of blocks to the top left pixels of the averages in the other exposure that lie closest: interpolation
    # between averages would change their noise.
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
    """Return the average of the block that starts at each pixel, on the scale on which noise is uniform, and its variance.

    They are NaN where not all of the block was seen.
    """
    known = exposure.weight > 0
    values = np.where(known, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(np.nan))
    variance = np.full_like(values, np.nan)
    variance[known] = exposure.response.stabilised_std(exposure.weight[known]) ** 2 / _BLOCK**2
    kernel = np.full((_BLOCK, _BLOCK), 1 / _BLOCK**2)
    rows, columns = (side - _BLOCK + 1 for side in values.shape)
    mean, mean_variance = (
        np.asarray(cv2.filter2D(image, -1, kernel, anchor=(0, 0))[:rows, :columns], np.float32) for image in (values, variance)
    )
    return mean, mean_variance


def _visits(overlap: FloatArray, least: float) -> NDArray[np.integer]:
    """Return where overlap is largest in each earlier visit: it is at least `least`, and prominent.

    As `scipy.signal.find_peaks` does, whose import alone takes a second.
    """
    # Between nothing before the first exposure and the exposure itself.
    profile = np.concatenate([[0.0], overlap, [1.0]])
    peaks = []
    for peak in np.flatnonzero((profile[1:-1] >= least) & (profile[1:-1] > profile[:-2]) & (profile[1:-1] >= profile[2:])) + 1:
        before, after = (np.flatnonzero(side > profile[peak]) for side in (profile[:peak], profile[peak:]))
        start, stop = before[-1] if before.size else 0, peak + (after[0] if after.size else len(profile) - peak)
        rises = profile[peak] - max(profile[start:peak].min(), profile[peak:stop].min())
        if rises >= _PROMINENCE:
            level = int(np.argmax(profile[peak:] != profile[peak]))
            peaks.append(peak - 1 + (level - 1) // 2)
    return np.array(peaks, dtype=int)


def _overlaps(moving: FloatArray, fixed: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the share of one field of view that each of N others sees: (N,)."""
    low, high = corners(frame_shape)[[0, 2]]
    # Centres of cells: on the border, points would leave the field of view at the least motion.
    x, y = (low[axis] + (high[axis] - low[axis]) * (np.arange(_GRID) + 0.5) / _GRID for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = apply(inverse(fixed) @ moving, points)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all((seen >= low) & (seen <= high), axis=-1).mean(axis=-1))
