"""Files as cameras write them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest


def swissspad_half(frames: np.ndarray) -> bytes:
    return np.packbits(frames, axis=-1, bitorder="little").tobytes()


def swissspad_full(frames: np.ndarray) -> bytes:
    """Write the top half and the bottom half upside down, 128 columns of each in turn."""
    zones = []
    for left in range(0, 512, 128):
        zones += [frames[:, :256, left : left + 128], frames[:, :255:-1, left : left + 128]]
    return np.packbits(np.concatenate(zones, axis=2), axis=-1, bitorder="little").tobytes()


def spad512(frames: np.ndarray) -> bytes:
    return np.packbits(frames, axis=-1).tobytes() + b"foot"


def spad512_sparse(frames: np.ndarray) -> bytes:
    return b"".join(np.append(np.flatnonzero(frame), 512 * 512).astype("<u4").tobytes() for frame in frames)


WRITERS = {
    "swissspad-half": swissspad_half,
    "swissspad-full": swissspad_full,
    "spad512": spad512,
    "spad512-sparse": spad512_sparse,
}


@pytest.fixture(scope="session")
def bin_file() -> Callable[[str, np.ndarray], bytes]:
    """Make the content of a .bin file of a source from frames (n, H, W)."""
    return lambda source, frames: WRITERS[source](frames)


@pytest.fixture
def moving() -> Callable[..., np.ndarray]:
    """Return frames, (n, 48, 66) uint8, of a pattern that moves by a pixel a frame, so that each differs from all others."""

    def make(n_frames: int = 40) -> np.ndarray:
        rows = np.linspace(40, 200, 48)[:, None]
        wave = 25 * np.sin(np.arange(66 + n_frames) / 3)
        return np.stack([rows + wave[first : first + 66] for first in range(n_frames)]).astype(np.uint8)

    return make
