"""Source `fastcam-mraw`: raw frames of Photron FASTCAM cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError
from photonpano.compiling import compiled
from photonpano.reading import OpenFiles, missing_file
from photonpano_sensors.intensity.cih import Header, read_header
from photonpano_sensors.intensity.configs import FastcamMrawConfig
from photonpano_sensors.intensity.recognition import header_beside, mraw_beside, refuse_mdat
from photonpano_sensors.intensity.source import IntensitySource, Levels


class FastcamMrawSource(IntensitySource):
    """Frames of 8, 12 or 16 bits in one .mraw file, described by the .cih or .cihx file beside it."""

    def __init__(self, config: FastcamMrawConfig) -> None:
        self._path, header = open_recording(config.path)
        super().__init__(config, (header.n_frames, header.height, header.width), header.frame_rate_hz, header.encoding)
        self._header = header
        self._files = OpenFiles()

    def close(self) -> None:
        """Close the file."""
        self._files.close()

    def _read(self, span: FrameSpan, levels: Levels) -> None:
        frame_bytes = self._header.frame_bytes
        flat, position = levels.reshape(-1), span.start * frame_bytes
        if self._header.bits != 12:
            self._files.read(self._path, position, flat.view(np.uint8))
            return
        packed = np.empty(len(span) * frame_bytes, np.uint8)
        self._files.read(self._path, position, packed)
        _unpack_12_bits(packed, flat.view(np.uint16))


def open_recording(path: Path) -> tuple[Path, Header]:
    """Return the .mraw file and the header of a recording, named by either; raises an `InputError` if one is unfit."""
    refuse_mdat(path)
    if not path.exists():
        raise InputError(missing_file(path))
    suffix = path.suffix.lower()
    if suffix == ".mraw":
        header_path = header_beside(path)
        if header_path is None:
            raise InputError(
                f"{path} has no .cihx or .cih file beside it, with the size and the bits of its frames; copy it too"
            )
        mraw = path
    elif suffix in (".cih", ".cihx"):
        header_path, beside = path, mraw_beside(path)
        if beside is None:
            raise InputError(f"{path} has no .mraw file beside it, which holds the frames; copy it from the camera too")
        mraw = beside
    else:
        raise InputError(f"{path} is not a recording of a FASTCAM: name its .cih, .cihx or .mraw file")
    header = read_header(header_path)
    needed, size = header.n_frames * header.frame_bytes, mraw.stat().st_size
    if size < needed:
        raise InputError(
            f"{mraw} is cut short: {header.n_frames} frames of {header.height}x{header.width} pixels of {header.bits} bits, as "
            f"{header_path.name} promises, are {needed} bytes, the file has {size}; copy or record it again"
        )
    return mraw, header


@compiled
def _unpack_12_bits(packed: NDArray[np.uint8], levels: NDArray[np.uint16]) -> None:
    """Unpack two levels from every three bytes, the higher bits first: (3 n,) to (2 n,)."""
    for pair in range(len(levels) // 2):
        first, middle, last = packed[3 * pair], packed[3 * pair + 1], packed[3 * pair + 2]
        levels[2 * pair] = np.uint16(first) << 4 | np.uint16(middle) >> 4
        levels[2 * pair + 1] = (np.uint16(middle) & 15) << 8 | np.uint16(last)
