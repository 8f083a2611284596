"""Midpoint resampling (paper, section 4, "Re-sample", and supplement S2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano import FrameSpan, Group, InputError

if TYPE_CHECKING:
    from photonpano_core.configs import MidpointConfig


SHORTEST = 16
"""Groups whose length is chosen by us get no shorter than this: too few photons tell nothing."""
_SHORTEST_END = 4
"""Those at the ends may: otherwise the motion there is not measured at all."""


class MidpointResampler:
    """floor(n / m) groups at the first level; each further level adds one centred between every two.

    Raises:
        ValueError: the config leaves the group size open; `AutoMidpointResampler` chooses it.
    """

    def __init__(self, config: MidpointConfig) -> None:
        if config.group_size == "auto":
            raise ValueError("group_size is a number of frames here, not auto")
        self._size: int = config.group_size
        self._config = config

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return k = floor(n / m) groups at level 1, 2k - 1 at level 2, 4k - 3 at level 3, ..., and shorter ones at the ends.

        The k groups are spread evenly, so that the first starts at frame 0 and the last ends with the capture; frames that do
        not fill a group are left out between groups at level 1, never at one end. Every reference is the centre of its
        group. Each further level halves what remains beyond the first and the last reference, by a group of m / 2, of m / 4,
        ... frames. No instant comes twice: where groups start at every frame, there is nothing between them.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        size = self._size
        if problem := too_short(size, n_frames):
            raise InputError(problem)
        count = n_frames // size
        density = 2 ** (level - 1) if self._config.densify else 1
        starts = np.unique(np.rint(np.linspace(0, n_frames - size, (count - 1) * density + 1)).astype(int))
        if count == 1:
            starts = np.array([(n_frames - size) // 2])
        spans = [FrameSpan(int(start), int(start) + size) for start in starts]
        if self._config.endpoints:
            halves = [size >> step for step in range(level - 1, 0, -1) if size >> step >= _SHORTEST_END]
            spans = [
                *(FrameSpan(0, half) for half in halves),
                *spans,
                *(FrameSpan(n_frames - half, n_frames) for half in reversed(halves)),
            ]
        return tuple(Group(span, span.centre) for span in spans)


def too_short(group_size: int, n_frames: int) -> str | None:
    """Say that a capture is shorter than a group, if it is."""
    if n_frames >= group_size:
        return None
    return (
        f"the capture has {n_frames} frames, fewer than one group of {group_size}; "
        f"set group_size to {max(1, n_frames // 4)} or less, so that at least four groups fit"
    )
