"""Positions of groups, shared by the resamplers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, Group, InputError, StreamInfo
from photonpano_core.configs import GroupedConfig

_SHORTEST = {"binary": 16, "intensity": 1}  # frames of the shortest group of `group_size: auto`; fewer are too noisy
_SHORTEST_END = 4  # frames of the shortest group at an end of the capture, where nothing else is measured


def shortest_of(stream: StreamInfo) -> int:
    """Return the frames of the shortest group that `group_size: auto` chooses."""
    return _SHORTEST[stream.kind]


def size_of(config: GroupedConfig) -> int:
    """Return the number of frames of a group.

    Raises:
        ValueError: it is `auto`; `AutoResampler` resolves that first.
    """
    if config.group_size == "auto":
        raise ValueError("group_size must be a number of frames here, not auto")
    return config.group_size


def too_short(group_size: int, n_frames: int) -> str | None:
    """Return the problem if a capture is shorter than a group; None if it is not."""
    if n_frames >= group_size:
        return None
    return (
        f"the capture has {n_frames} frames, fewer than one group of {group_size}; "
        f"set group_size to {max(1, n_frames // 4)} or less, so that at least four groups fit"
    )


def require_a_group(group_size: int, n_frames: int) -> None:
    """Raise if a capture is shorter than a group.

    Raises:
        InputError: the capture has fewer frames than a group.
    """
    if problem := too_short(group_size, n_frames):
        raise InputError(problem)


def evenly_spread(n_frames: int, size: int, count: int) -> NDArray[np.float64]:
    """Return evenly spaced starts of groups, from frame 0 to `n_frames - size`: (count,), in frames, with fractions.

    A single group lies in the middle.
    """
    last = n_frames - size
    return np.linspace(0, last, count) if count > 1 else np.array([last // 2], dtype=np.float64)


def spans_at(starts: NDArray[np.float64], size: int) -> list[FrameSpan]:
    """Return spans that start at the nearest whole frames, each once."""
    return [FrameSpan(int(start), int(start) + size) for start in np.unique(np.rint(starts))]


def with_ends(spans: list[FrameSpan], n_frames: int, size: int, level: int) -> list[FrameSpan]:
    """Add ever shorter groups at both ends (supplement S2): of m / 2 frames from level 2 on, of m / 4 from level 3, ..."""
    halves = [size >> step for step in range(level - 1, 0, -1) if size >> step >= _SHORTEST_END]
    first = [FrameSpan(0, half) for half in halves]
    last = [FrameSpan(n_frames - half, n_frames) for half in reversed(halves)]
    return [*first, *spans, *last]


def centred(spans: Iterable[FrameSpan]) -> tuple[Group, ...]:
    """Return groups whose reference instants are the centres of spans."""
    return tuple(Group(span, span.centre) for span in spans)
