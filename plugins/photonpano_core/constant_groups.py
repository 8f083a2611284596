"""Constant number of groups: the ablation that fails in the paper (section 4, "Re-sample")."""

from __future__ import annotations

from photonpano import Group
from photonpano_core.configs import GroupedConfig
from photonpano_core.grouping import centred, evenly_spread, require_a_group, size_of, spans_at


class ConstantGroupsResampler:
    """floor(n / m) groups at every level: those of the first level of `midpoint`.

    Raises:
        ValueError: the group size is `auto`.
    """

    def __init__(self, config: GroupedConfig) -> None:
        self._size = size_of(config)

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the same groups at every level, spread evenly from the first frame to the last.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        del level
        require_a_group(self._size, n_frames)
        starts = evenly_spread(n_frames, self._size, n_frames // self._size)
        return centred(spans_at(starts, self._size))
