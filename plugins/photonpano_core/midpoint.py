"""Midpoint resampling (paper, section 4, "Re-sample", and supplement S2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano import FrameSpan, Group, InputError

if TYPE_CHECKING:
    from photonpano_core.configs import MidpointConfig


class MidpointResampler:
    """floor(n / m) groups at the first level; each further level adds one centred between every two."""

    def __init__(self, config: MidpointConfig) -> None:
        self._config = config

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return k = floor(n / m) groups at level 1, 2k - 1 at level 2, 4k - 3 at level 3, ..., and the two end groups.

        The k groups are spread evenly, so that the first starts at frame 0 and the last ends with the capture; frames that do
        not fill a group are left out between groups at level 1, never at one end. References are the centres, but for the
        end groups, whose references are the first and the last frame. No instant comes twice: where groups start at every
        frame, there is nothing between them.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        size = self._config.group_size
        if problem := too_short(size, n_frames):
            raise InputError(problem)
        count = n_frames // size
        density = 2 ** (level - 1) if self._config.densify else 1
        starts = np.unique(np.rint(np.linspace(0, n_frames - size, (count - 1) * density + 1)).astype(int))
        if count == 1:
            starts = np.array([(n_frames - size) // 2])
        spans = [FrameSpan(int(start), int(start) + size) for start in starts]
        groups = [Group(span, span.centre) for span in spans]
        if level > 1 and self._config.endpoints and size > 1:
            first, last = FrameSpan(0, size), FrameSpan(n_frames - size, n_frames)
            groups = [Group(first, 0.0), *groups, Group(last, float(n_frames - 1))]
        return tuple(groups)


def too_short(group_size: int, n_frames: int) -> str | None:
    """Say that a capture is shorter than a group, if it is."""
    if n_frames >= group_size:
        return None
    return (
        f"the capture has {n_frames} frames, fewer than one group of {group_size}; "
        f"set group_size to {max(1, n_frames // 4)} or less, so that at least four groups fit"
    )
