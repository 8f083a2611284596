"""Which exposures are registered with which: neighbours, those a few group lengths away, and places seen again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from photonpano.values import FloatArray, FrameSpan, Group


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
    instants, lengths = instants_of(groups), lengths_of(groups)
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
    return min(1.0, float(np.median(np.diff(instants_of(groups))) / np.median(lengths_of(groups))))


def _parts(n_groups: int, pairs: set[tuple[int, int]]) -> NDArray[np.integer]:
    """Number the sets of groups that pairs tie together: (N,)."""
    moving, fixed = np.array(sorted(pairs), dtype=int).reshape(-1, 2).T
    ties = sparse.csr_array((np.ones(len(moving)), (moving, fixed)), shape=(n_groups, n_groups))
    return np.asarray(connected_components(ties, directed=False)[1])


def instants_of(groups: Sequence[Group]) -> FloatArray:
    """Return the reference instants of the groups: (N,)."""
    return np.array([group.reference for group in groups])


def lengths_of(groups: Sequence[Group]) -> FloatArray:
    """Return the number of frames of each group: (N,)."""
    return np.array([float(len(group.span)) for group in groups])
