"""The component of this plugin keeps what every source promises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import StreamInfo, discover
from photonpano.testing import SourceConformance

ZARR = discover().find("source", "zarr").contribution


class TestZarr(SourceConformance):
    contribution = ZARR
    wrong = ({"path": "there-is-no-such-folder"}, {"width": 80})
    compressed = False

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        if self.compressed:
            pytest.importorskip("numcodecs", reason="compression needs photonpano[zarr]")
        array = folder / "cube.zarr"
        array.mkdir()
        info = StreamInfo(len(frames), *frames.shape[1:], 96800)
        ZARR.write(
            array,
            info,
            iter(np.packbits(frames, axis=-1)[None, index] for index in range(len(frames))),
            compressed=self.compressed,
        )
        return {"path": array}


class TestCompressedZarr(TestZarr):
    compressed = True
