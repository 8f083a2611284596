"""Resamplers: how a capture is divided into groups, and how groups get denser from level to level (paper, section 4)."""

from __future__ import annotations

import math

import numpy as np

from photonpano import FloatArray, FrameSpan, Group, InputError
from photonpano_core.configs import GroupedConfig, MidpointConfig, SlidingWindowConfig, StratifiedConfig

_SHORTEST_END = 4  # frames of the shortest group at an end of the capture, where nothing else is measured


class ConstantGroupsResampler:
    """floor(n / m) groups of m frames at every level: the ablation that fails in the paper."""

    def __init__(self, config: GroupedConfig) -> None:
        if config.group_size == "auto":
            raise ValueError("group_size must be a number of frames here, not auto")
        self._config = config
        self._size = config.group_size

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        """Return the groups of a level, whose references are their centres; raises an `InputError` if none fits.

        They are spread evenly: the first starts at frame 0, and the last ends with the capture. Frames that do not fill a group
        are left out between groups, never at an end. No instant comes twice.
        """
        if problem := too_short(self._size, n_frames):
            raise InputError(problem)
        return tuple(Group(span, span.centre) for span in self._spans(n_frames, level))

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        del level
        return self._at(self._evenly_spread(n_frames, n_frames // self._size))

    def _evenly_spread(self, n_frames: int, count: int) -> FloatArray:
        """Return evenly spaced starts of groups: (count,), in frames, with fractions; a single group lies in the middle."""
        last = n_frames - self._size
        return np.linspace(0, last, count) if count > 1 else np.array([last // 2], dtype=np.float64)

    def _at(self, starts: FloatArray) -> list[FrameSpan]:
        """Return spans that start at the nearest whole frames, each once."""
        return [FrameSpan(int(start), int(start) + self._size) for start in np.unique(np.rint(starts))]


class SlidingWindowResampler(ConstantGroupsResampler):
    """A group of m frames every s frames: the baseline of the paper (section 4, "Computational Considerations").

    With one step for all levels, the first level has as many groups as the last, O(n m / s) frames a level. Dense
    groups hardly help while the motion is inaccurate.
    """

    _config: SlidingWindowConfig

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        first = max(1, self._size // 2) if self._config.step_frames is None else self._config.step_frames
        step = max(1.0, first / self._config.step_shrink ** (level - 1))
        return self._at(self._evenly_spread(n_frames, math.ceil((n_frames - self._size) / step) + 1))


class MidpointResampler(ConstantGroupsResampler):
    """Midpoint resampling (supplement S2): each further level adds a group between every two neighbours.

    Of k = floor(n / m) groups at level 1, there are 2k - 1 at level 2, and 4k - 3 at level 3. Each further level also adds a
    group of m / 2, m / 4, ... frames at each end, which halves the time beyond the outermost references.
    """

    _config: MidpointConfig

    def _spans(self, n_frames: int, level: int) -> list[FrameSpan]:
        spans = self._at(self._starts(n_frames, level))
        if not self._config.endpoints:
            return spans
        halves = [self._size >> step for step in range(level - 1, 0, -1) if self._size >> step >= _SHORTEST_END]
        first = [FrameSpan(0, half) for half in halves]
        return [*first, *spans, *(FrameSpan(n_frames - half, n_frames) for half in reversed(halves))]

    def _starts(self, n_frames: int, level: int) -> FloatArray:
        return self._evenly_spread(n_frames, (n_frames // self._size - 1) * 2 ** (level - 1) + 1)


class StratifiedResampler(MidpointResampler):
    """As many groups as `midpoint` at each level, each at random in its stratum: half-way to its neighbours there.

    Evenly spaced groups sample a tremor of the same period always at the same phase, and miss it (aliasing). Random groups do
    not. They depend on the seed, the level and the length of the capture alone.
    """

    _config: StratifiedConfig

    def __init__(self, config: StratifiedConfig, seed: int) -> None:
        super().__init__(config)
        self._seed = seed

    def _starts(self, n_frames: int, level: int) -> FloatArray:
        starts = super()._starts(n_frames, level)
        if len(starts) > 2:
            width = self._config.jitter * (starts[1] - starts[0])
            rng = np.random.default_rng([self._seed, level])
            starts[1:-1] += width * rng.uniform(-0.5, 0.5, len(starts) - 2)
        return starts


def too_short(group_size: int, n_frames: int) -> str | None:
    """Return the problem if a capture is shorter than a group; None if it is not."""
    if n_frames >= group_size:
        return None
    return (
        f"the capture has {n_frames} frames, fewer than one group of {group_size}; "
        f"set group_size to {max(1, n_frames // 4)} or less, so that at least four groups fit"
    )
