"""Midpoint resampling (paper, section 4, "Re-sample", and supplement S2)."""

from __future__ import annotations

from photonpano import Group
from photonpano_core.configs import MidpointConfig
from photonpano_core.grouping import centred, evenly_spread, require_a_group, size_of, spans_at, with_ends


class MidpointResampler:
    """floor(n / m) groups at the first level; each further level adds one centred between every two.

    Raises:
        ValueError: the config leaves the group size open.
    """

    def __init__(self, config: MidpointConfig) -> None:
        self._size = size_of(config)
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
        require_a_group(size, n_frames)
        count = (n_frames // size - 1) * 2 ** (level - 1) + 1
        spans = spans_at(evenly_spread(n_frames, size, count), size)
        return centred(with_ends(spans, n_frames, size, level) if self._config.endpoints else spans)
