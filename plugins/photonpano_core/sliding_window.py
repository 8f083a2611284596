"""Sliding windows, the baseline of the paper (section 4, "Computational Considerations")."""

from __future__ import annotations

import math

from photonpano import Group
from photonpano_core.configs import SlidingWindowConfig
from photonpano_core.grouping import centred, evenly_spread, require_a_group, size_of, spans_at


class SlidingWindowResampler:
    """A group of m frames every s frames.

    With one step for all levels, the first level has as many groups as the last, O(n m / s) frames a level. Dense
    groups hardly help while the motion is inaccurate.

    Raises:
        ValueError: the group size is `auto`.
    """

    def __init__(self, config: SlidingWindowConfig) -> None:
        self._size = size_of(config)
        self._step = max(1, self._size // 2) if config.step_frames is None else config.step_frames
        self._shrink = config.step_shrink

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return groups of m frames, at most a step apart, spread evenly from the first frame to the last.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        require_a_group(self._size, n_frames)
        step = max(1.0, self._step / self._shrink ** (level - 1))
        count = math.ceil((n_frames - self._size) / step) + 1
        return centred(spans_at(evenly_spread(n_frames, self._size, count), self._size))
