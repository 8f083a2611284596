"""Midpoint resampling (paper, section 4, "Re-sample", and supplement S2)."""

from __future__ import annotations

from photonpano import Group
from photonpano_core.configs import MidpointConfig
from photonpano_core.grouping import centred, evenly_spread, require_a_group, size_of, spans_at, with_ends


class MidpointResampler:
    """floor(n / m) groups at the first level; each further level adds one centred between every two neighbours.

    Raises:
        ValueError: the group size is `auto`.
    """

    def __init__(self, config: MidpointConfig) -> None:
        self._size = size_of(config)
        self._config = config

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return k = floor(n / m) groups at level 1, 2k - 1 at level 2, 4k - 3 at level 3, ..., and shorter ones at the ends.

        The k groups are spread evenly: the first starts at frame 0, and the last ends with the capture. At level 1, frames that
        do not fill a group are left out between groups, never at an end. The reference of a group is its centre. Each further
        level adds a group of m / 2, m / 4, ... frames at each end, which halves the time beyond the outermost references. No
        instant comes twice: once groups start at every frame, no more are added.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        size = self._size
        require_a_group(size, n_frames)
        count = (n_frames // size - 1) * 2 ** (level - 1) + 1
        spans = spans_at(evenly_spread(n_frames, size, count), size)
        return centred(with_ends(spans, n_frames, size, level) if self._config.endpoints else spans)
