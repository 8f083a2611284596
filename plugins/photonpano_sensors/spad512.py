"""Source `spad512`: the .bin files of the SPAD512 of Pi Imaging."""

from __future__ import annotations

from pathlib import Path

from photonpano import Recognised
from photonpano.reading import FrameLayout, objections
from photonpano_sensors.bin_files import BinConfig, bin_source, frame_files, sizes_of

LAYOUT = FrameLayout((512, 512), (512, 64))
FOOTER_BYTES = 4
# Sizes by which a file is recognised. 256 frames without a footer have the size of files of SwissSPAD2.
_FILE_SIZES = {1000 * LAYOUT.stored_bytes: "1000 frames", 256 * LAYOUT.stored_bytes + FOOTER_BYTES: "256 frames and a footer"}


class Spad512Config(BinConfig):
    """A capture of the SPAD512, 512 x 512 px."""


def _recognise(path: Path) -> Recognised | None:
    sizes = sizes_of(path)
    if not sizes or sizes[0] not in _FILE_SIZES or objections(frame_files, path, LAYOUT, FOOTER_BYTES):
        return None
    return Recognised({"path": str(path)}, f"{sizes[0]:,} bytes a file, which are {_FILE_SIZES[sizes[0]]} of 512 x 512 px")


SPAD512 = bin_source(
    "spad512",
    "Binary frames of the SPAD512, 512 x 512 px, in .bin files of 1000, or of 256 with a footer",
    Spad512Config,
    LAYOUT,
    _recognise,
    FOOTER_BYTES,
)
