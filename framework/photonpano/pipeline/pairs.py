"""Which exposures are registered with which: neighbours, and those a few group lengths away."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from photonpano.values import FrameSpan, Group


def pairs_of(groups: Sequence[Group], skips: Sequence[float]) -> list[tuple[int, int]]:
    """Return the pairs (moving, fixed) of a level, moving later than fixed, ordered by the moving exposure.

    Args:
        groups: the groups of the level, in order of their instants.
        skips: besides its predecessor, each exposure is paired with the one whose instant lies closest to so many group
            lengths before its own. A pair a whole group length apart shares no photons, so that its noise cannot vote for
            the motion known so far; a distant pair ties down drift.
    """
    instants = np.array([group.reference for group in groups])
    pairs = {(later, later - 1) for later in range(1, len(groups))}
    for later, group in enumerate(groups):
        for skip in skips:
            target = group.reference - skip * len(group.span)
            if target >= instants[0] - 0.5:
                earlier = int(np.argmin(np.abs(instants - target)))
                if earlier < later:
                    pairs.add((later, earlier))
    return sorted(pairs)


def shared_share(first: FrameSpan, second: FrameSpan) -> float:
    """Return which share of its frames the shorter of two spans has in common with the other."""
    common = min(first.stop, second.stop) - max(first.start, second.start)
    return max(0, common) / min(len(first), len(second))
