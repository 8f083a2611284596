"""Which exposures are registered with which: neighbours, those a few group lengths away, and places seen again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from photonpano.geometry import apply, corners, inverse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from photonpano.values import BoolArray, FloatArray, FrameSpan, Group

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


def pairs_of(groups: Sequence[Group], skips: Sequence[float]) -> list[tuple[int, int]]:
    """Return the pairs (moving, fixed) of a level, moving later than fixed, ordered by the moving exposure.

    A pair that shares photons shares their noise, which lies where the motion known so far puts it, and votes for that
    motion. So neighbours that overlap in time are no pairs, unless there are no others.

    Args:
        groups: the groups of the level, in order of their instants.
        skips: each exposure is paired with those whose instants lie closest to so many group lengths before and after its
            own; between groups of different lengths, their mean counts. At the least of them, also with the one beyond, so
            that the exposures between do not fall into chains that know nothing of each other. None of them leaves a chain of
            neighbours.
    """
    instants, lengths = _instants(groups), _lengths(groups)
    pairs: set[tuple[int, int]] = set()
    for index, (instant, length) in enumerate(zip(instants, lengths, strict=True)):
        distances = (instants - instant) / ((lengths + length) / 2)
        for skip in skips:
            for target in (-skip, skip):
                if not distances[0] - 0.5 / length <= target <= distances[-1] + 0.5 / length:
                    continue
                partner = int(np.argmin(np.abs(distances - target)))
                beyond = partner + (1 if target > 0 else -1)
                partners = [partner, beyond] if skip == min(skips) else [partner]
                pairs |= {
                    (max(index, each), min(index, each)) for each in partners if each != index and 0 <= each < len(groups)
                }
    # Neighbours tie what falls apart without them, as in a capture that is hardly longer than a group.
    parts = _parts(len(groups), pairs)
    pairs |= {
        (later, later - 1)
        for later in range(1, len(groups))
        if parts[later] != parts[later - 1] or not shared_share(groups[later].span, groups[later - 1].span)
    }
    return sorted(pairs)


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
    instants, lengths = _instants(groups), _lengths(groups)
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


def shared_share(first: FrameSpan, second: FrameSpan) -> float:
    """Return which share of its frames the shorter of two spans has in common with the other."""
    common = min(first.stop, second.stop) - max(first.start, second.start)
    return max(0, common) / min(len(first), len(second))


def independent_share(groups: Sequence[Group]) -> float:
    """Return which share of the photons of a typical group no earlier group holds.

    Groups that lie denser than their length hold the same photons several times, and so the same noise: pairs of them say the
    same several times.
    """
    if len(groups) < 2:
        return 1.0
    return min(1.0, float(np.median(np.diff(_instants(groups))) / np.median(_lengths(groups))))


def _parts(n_groups: int, pairs: set[tuple[int, int]]) -> NDArray[np.integer]:
    """Number the sets of groups that pairs tie together: (N,)."""
    moving, fixed = np.array(sorted(pairs), dtype=int).reshape(-1, 2).T
    ties = sparse.csr_array((np.ones(len(moving)), (moving, fixed)), shape=(n_groups, n_groups))
    return np.asarray(connected_components(ties, directed=False)[1])


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


def _instants(groups: Sequence[Group]) -> FloatArray:
    return np.array([group.reference for group in groups])


def _lengths(groups: Sequence[Group]) -> FloatArray:
    return np.array([float(len(group.span)) for group in groups])


def _overlaps(moving: FloatArray, fixed: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the share of one field of view that each of N others sees: (N,)."""
    low, high = corners(frame_shape)[[0, 2]]
    # Centres of cells: on the border, points would leave the field of view at the least motion.
    x, y = (low[axis] + (high[axis] - low[axis]) * (np.arange(_GRID) + 0.5) / _GRID for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = apply(inverse(fixed) @ moving, points)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all((seen >= low) & (seen <= high), axis=-1).mean(axis=-1))
