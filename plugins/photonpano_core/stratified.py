"""Stratified sampling of instants: as dense as midpoint resampling, at random within even strata."""

from __future__ import annotations

import numpy as np

from photonpano import Group
from photonpano_core.configs import StratifiedConfig
from photonpano_core.grouping import centred, evenly_spread, require_a_group, size_of, spans_at, with_ends


class StratifiedResampler:
    """As many groups as `midpoint` at each level, each at random within its own stratum.

    Evenly spaced groups sample a tremor of the same period always at the same phase, and miss it (aliasing). Random groups do
    not.

    Raises:
        ValueError: the group size is `auto`.
    """

    def __init__(self, config: StratifiedConfig, seed: int) -> None:
        self._size = size_of(config)
        self._config = config
        self._seed = seed

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level; they depend on the seed, the level and the length of the capture alone.

        A stratum reaches half-way to the neighbours of a group of `midpoint`. The first group starts with the capture and
        the last ends with it, and shorter groups are added at the ends, as in `midpoint`. No instant comes twice.

        Raises:
            InputError: the capture has fewer frames than a group.
        """
        size = self._size
        require_a_group(size, n_frames)
        starts = evenly_spread(n_frames, size, (n_frames // size - 1) * 2 ** (level - 1) + 1)
        if len(starts) > 2:
            width = self._config.jitter * (starts[1] - starts[0])
            rng = np.random.default_rng([self._seed, level])
            starts[1:-1] += width * rng.uniform(-0.5, 0.5, len(starts) - 2)
        spans = spans_at(starts, size)
        return centred(with_ends(spans, n_frames, size, level) if self._config.endpoints else spans)
