"""Frames that are written as captures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest


@pytest.fixture
def moving() -> Callable[..., np.ndarray]:
    """Return frames, (n, 48, 66) uint8, of a pattern that moves by a pixel a frame, so that each differs from all others."""

    def make(n_frames: int = 40) -> np.ndarray:
        rows = np.linspace(40, 200, 48)[:, None]
        wave = 25 * np.sin(np.arange(66 + n_frames) / 3)
        return np.stack([rows + wave[first : first + 66] for first in range(n_frames)]).astype(np.uint8)

    return make
