from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano.captures.obstacles import order_warning
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource
from photonpano.testing import MemorySource


@pytest.mark.parametrize("read", ["big", "little"])
@pytest.mark.parametrize("stored", ["big", "little"])
def test_packed_source_that_is_read_in_another_order_is_warned_of(
    tmp_path: Path, clouds: Callable[..., np.ndarray], stored: str, read: str
) -> None:
    np.packbits(clouds(), axis=2, bitorder=stored).tofile(tmp_path / "cube.bin")
    with PackedFileSource([FrameFile(tmp_path / "cube.bin", 384)], FrameLayout((64, 96), (64, 12), read)) as source:
        warning = order_warning(source)
    if stored == read:
        assert warning is None
    else:
        assert warning is not None
        assert warning.startswith(
            "the pixels of the frames seem to be in another order than they are read in: pixels correlate"
        )
        assert warning.endswith(" if the first pixel is the lowest bit; check the source and its keys")


def test_source_without_packed_frames_is_not_judged(clouds: Callable[..., np.ndarray]) -> None:
    assert order_warning(MemorySource(clouds(n_frames=16))) is None
