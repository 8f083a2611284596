"""Videos that are written for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def moving() -> Callable[..., np.ndarray]:
    """Return frames, (n, 48, 66) uint8, of a pattern that moves by a pixel a frame, so that each differs from all others."""

    def make(n_frames: int = 40) -> np.ndarray:
        rows = np.linspace(40, 200, 48)[:, None]
        wave = 25 * np.sin(np.arange(66 + n_frames) / 3)
        return np.stack([rows + wave[first : first + 66] for first in range(n_frames)]).astype(np.uint8)

    return make


@pytest.fixture
def write_video(tmp_path: Path) -> Callable[..., Path]:
    """Write the levels of frames as the luma of a video."""
    av = pytest.importorskip("av")

    def write(frames: np.ndarray, name: str, codec: str, pixels: str, **options: Any) -> Path:
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream(codec, rate=30, options={key: str(value) for key, value in options.items()})
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
            for levels in frames:
                frame = av.VideoFrame(levels.shape[1], levels.shape[0], pixels)
                luma = np.zeros((levels.shape[0], frame.planes[0].line_size), np.uint8)
                flat = levels.reshape(len(levels), -1).view(np.uint8)
                luma[:, : flat.shape[1]] = flat
                for plane, content in zip(frame.planes, [luma] + 2 * [None], strict=False):
                    plane.update(np.full(plane.buffer_size, 128, np.uint8) if content is None else content)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return tmp_path / name

    return write
