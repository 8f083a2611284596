"""Source `fastcam-mraw`: raw frames of Photron FASTCAM cameras."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from photonpano import InputError
from photonpano_sensors.intensity.cih import read_header
from photonpano_sensors.intensity.recognition import header_beside, mraw_beside, refuse_mdat
from photonpano_sensors.intensity.source import IntensitySource
from photonpano_sensors.intensity.summing import unpack_12_bits

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from photonpano import FrameSpan
    from photonpano_sensors.intensity.cih import Header
    from photonpano_sensors.intensity.configs import FastcamMrawConfig
    from photonpano_sensors.intensity.summing import Levels


class FastcamMrawSource(IntensitySource):
    """Frames of 8, 12 or 16 bits in one .mraw file, described by the .cih or .cihx file beside it.

    Raises:
        InputError: a file is missing, the header tells of frames that cannot be read, or of more than there are.
    """

    def __init__(self, config: FastcamMrawConfig) -> None:
        self._path, header = open_recording(config.path)
        super().__init__(config, (header.n_frames, header.height, header.width), header.frame_rate_hz, header.encoding)
        self._header = header
        self._file = self._path.open("rb", buffering=0)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def _read(self, span: FrameSpan, levels: Levels) -> None:
        flat = levels.reshape(-1)
        if self._header.bits != 12:
            self._fill(flat.view(np.uint8), span)
            return
        packed = np.empty(len(span) * self._header.frame_bytes, np.uint8)
        self._fill(packed, span)
        unpack_12_bits(packed, flat.view(np.uint16))

    def _fill(self, content: NDArray[np.uint8], span: FrameSpan) -> None:
        target, position = content.data, span.start * self._header.frame_bytes
        while target:
            try:
                done = os.preadv(self._file.fileno(), [target], position)
            except OSError as error:
                raise InputError(f"cannot read {span} of {self._path}: {error.strerror}") from error
            if not done:
                raise InputError(f"{self._path} has become shorter: {span} are no longer in it; copy or record it again")
            target, position = target[done:], position + done


def open_recording(path: Path) -> tuple[Path, Header]:
    """Return the .mraw file of a recording and what its header tells.

    Args:
        path: the .mraw file or its header.

    Raises:
        InputError: a file is missing, the header cannot be used, or the .mraw file is shorter than it says.
    """
    refuse_mdat(path)
    if not path.exists():
        raise InputError(f"there is no file {path}; check the path")
    suffix = path.suffix.lower()
    if suffix == ".mraw":
        header_path = header_beside(path)
        if header_path is None:
            raise InputError(
                f"{path} has no .cihx or .cih file beside it, which tells size and bits of its frames; copy it too"
            )
        mraw = path
    elif suffix in (".cih", ".cihx"):
        header_path, beside = path, mraw_beside(path)
        if beside is None:
            raise InputError(f"{path} has no .mraw file beside it, which holds the frames; copy it from the camera too")
        mraw = beside
    else:
        raise InputError(f"{path} is no recording of a FASTCAM: name its .cih, .cihx or .mraw file")
    header = read_header(header_path)
    needed, size = header.n_frames * header.frame_bytes, mraw.stat().st_size
    if size < needed:
        raise InputError(
            f"{mraw} is cut short: {header.n_frames} frames of {header.height}x{header.width} pixels of {header.bits} bits, as "
            f"{header_path.name} promises, are {needed} bytes, the file has {size}; copy or record it again"
        )
    return mraw, header
