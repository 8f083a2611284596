"""Where groups lie: what the resamplers share."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, Group, InputError, StreamInfo
from photonpano_core.configs import GroupedConfig

_SHORTEST = {"binary": 16, "intensity": 1}
"""Groups whose length is chosen by us get no shorter than this: too few binary frames tell nothing, a grey one is a picture."""
_SHORTEST_END = 4
"""Those at the ends may: otherwise the motion there is not measured at all."""


def shortest_of(stream: StreamInfo) -> int:
    """Return the least frames of a group whose length is chosen by us."""
    return _SHORTEST[stream.kind]


def size_of(config: GroupedConfig) -> int:
    """Return the frames of a group.

    Raises:
        ValueError: the config leaves them open; `AutoResampler` chooses them.
    """
    if config.group_size == "auto":
        raise ValueError("group_size is a number of frames here, not auto")
    return config.group_size


def too_short(group_size: int, n_frames: int) -> str | None:
    """Say that a capture is shorter than a group, if it is."""
    if n_frames >= group_size:
        return None
    return (
        f"the capture has {n_frames} frames, fewer than one group of {group_size}; "
        f"set group_size to {max(1, n_frames // 4)} or less, so that at least four groups fit"
    )


def require_a_group(group_size: int, n_frames: int) -> None:
    """Refuse a capture that is shorter than a group.

    Raises:
        InputError: it is.
    """
    if problem := too_short(group_size, n_frames):
        raise InputError(problem)


def evenly_spread(n_frames: int, size: int, count: int) -> NDArray[np.float64]:
    """Return where groups start, from frame 0 to `n_frames - size`: (count,), in frames, fractions included.

    A single group lies in the middle.
    """
    last = n_frames - size
    return np.linspace(0, last, count) if count > 1 else np.array([last // 2], dtype=np.float64)


def spans_at(starts: NDArray[np.float64], size: int) -> list[FrameSpan]:
    """Return groups that start at the nearest whole frames, each once: between neighbouring frames there is nothing."""
    return [FrameSpan(int(start), int(start) + size) for start in np.unique(np.rint(starts))]


def with_ends(spans: list[FrameSpan], n_frames: int, size: int, level: int) -> list[FrameSpan]:
    """Add ever shorter groups at both ends (supplement S2): of m / 2 frames from level 2 on, of m / 4 from level 3, ..."""
    halves = [size >> step for step in range(level - 1, 0, -1) if size >> step >= _SHORTEST_END]
    first = [FrameSpan(0, half) for half in halves]
    last = [FrameSpan(n_frames - half, n_frames) for half in reversed(halves)]
    return [*first, *spans, *last]


def centred(spans: Iterable[FrameSpan]) -> tuple[Group, ...]:
    """Return groups that are seen from the centres of spans."""
    return tuple(Group(span, span.centre) for span in spans)
