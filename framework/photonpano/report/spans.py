"""Runs of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.values import FrameSpan

if TYPE_CHECKING:
    from photonpano.values import BoolArray


def true_spans(flags: BoolArray) -> list[FrameSpan]:
    """Return the runs of frames whose flag is set, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [FrameSpan(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]
