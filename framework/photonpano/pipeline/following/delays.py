"""How long frames waited until they were located, in memory that does not grow."""

from __future__ import annotations

import numpy as np

# Resolution and number of the bins of delays: 10 ms, up to two minutes.
_STEP_S, _STEPS = 0.01, 12_000


class Delays:
    """Counts delays."""

    def __init__(self) -> None:
        self._counts = np.zeros(_STEPS, np.int64)
        self._sum, self._longest = 0.0, 0.0

    def add(self, n_frames: int, seconds: float) -> None:
        """Count frames that waited that long."""
        self._counts[min(int(seconds / _STEP_S), _STEPS - 1)] += n_frames
        self._sum += n_frames * seconds
        self._longest = max(self._longest, seconds)

    @property
    def n_frames(self) -> int:
        """How many frames were counted."""
        return int(self._counts.sum())

    @property
    def mean(self) -> float | None:
        """Mean delay, in seconds; None if no frame was counted."""
        return self._sum / self.n_frames if self.n_frames else None

    @property
    def longest(self) -> float | None:
        """Greatest delay, in seconds; None if no frame was counted."""
        return self._longest if self.n_frames else None

    def quantile(self, share: float) -> float | None:
        """Return the delay that this share of the frames did not exceed, in seconds, to 10 ms; None if there are none."""
        if not self.n_frames:
            return None
        step = int(np.searchsorted(np.cumsum(self._counts), share * self.n_frames))
        return min((step + 1) * _STEP_S, self._longest)
