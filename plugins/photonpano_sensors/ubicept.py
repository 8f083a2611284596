"""Source `ubicept-h5`: sums of binary frames in HDF5, one dataset a frame, with its number as its name, in one group."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonpano import Bayer, Config, InputError, Recognised, Requirement, SourceContribution, SpecPath, StreamInfo
from photonpano.photometry import BinarySumResponse
from photonpano.reading import SingleFrameSource, missing_file, read_start, reading

_SUFFIX = ".ubi.h5"
_HDF = b"\x89HDF\r\n\x1a\n"
_DAMAGED = "cannot be read as a .ubi.h5 file: it is damaged or something else; copy it again"


class UbiceptConfig(Config):
    """A capture in one file, whose frames are sums of binary frames."""

    path: SpecPath = Field(description="the .ubi.h5 file")
    binary_frames: int | None = Field(
        None, ge=1, le=65535, description="number of binary frames in each sum; by default from the file"
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, description="frames (sums) a second, in Hz; by default from the file, if known"
    )


class UbiceptSource(SingleFrameSource):
    """Sums of binary frames. The HDF5 library reads one at a time, whatever the number of threads."""

    def __init__(self, config: UbiceptConfig) -> None:
        import h5py

        self._path = config.path
        with reading(self._path, _DAMAGED):
            self._file = h5py.File(self._path)
        try:
            with reading(self._path, _DAMAGED):
                self._describe(config)
        except BaseException:
            self._file.close()
            raise

    def _describe(self, config: UbiceptConfig) -> None:
        # That of the first dataset whose name is a number.
        self._group: Any = self._file.visititems(lambda name, item: item.parent if _is_frame(name, item) else None)
        if self._group is None:
            raise InputError(
                f"{self._path} has no group of frames, that is, datasets with numbers as names; choose another source"
            )
        self._names = sorted((name for name in self._group if _is_number(name)), key=int)
        first = self._group[self._names[0]]
        if first.ndim < 2 or min(first.shape[:2]) < 1 or any(size != 1 for size in first.shape[2:]):
            raise InputError(
                f"{self._path} holds frames of shape {first.shape}; they are (height, width) or (height, width, 1, 1)"
            )
        if first.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self._path} holds {first.dtype} values; sums of binary frames are uint8 or uint16")
        metadata = json.loads(first.attrs.get("metadata", "{}"))
        binary_frames = config.binary_frames or _binary_frames(metadata)
        if binary_frames is None:
            raise InputError(f"{self._path} does not contain the number of binary frames of each sum; set binary_frames")
        height, width = first.shape[:2]
        self._dtype = first.dtype
        self.info = StreamInfo(
            n_frames=len(self._names),
            height=int(height),
            width=int(width),
            frame_rate_hz=config.frame_rate_hz or _frame_rate_hz(metadata, binary_frames),
            kind="intensity",
            bit_depth=binary_frames.bit_length(),
            bayer=_bayer(metadata),
        )
        self.response = BinarySumResponse(binary_frames)
        self.valid = np.ones(self.info.frame_shape, np.bool_)

    def frame(self, index: int) -> NDArray[Any]:
        """Return a frame: (H, W), the sum of binary frames."""
        name = self._names[index]
        with reading(self._path, _DAMAGED):
            values: NDArray[Any] = self._group[name][()].reshape(self.info.frame_shape)
        if values.dtype != self._dtype or values.max() > self.response.n:
            raise InputError(
                f"{self._path} holds {values.dtype} values up to {values.max()} in frame {name}, which cannot be the sum of "
                f"{self.response.n} binary frames, as {self._dtype}; correct binary_frames, or copy the file again"
            )
        return values

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


def _is_frame(name: str, item: object) -> bool:
    import h5py

    return isinstance(item, h5py.Dataset) and _is_number(name.rpartition("/")[2])


def _binary_frames(metadata: dict[str, Any]) -> int | None:
    """Return the number of binary frames of a sum, from the metadata of a frame; None if unknown."""
    key = "num_integrated_binary_frames"
    number = metadata.get("polycam_metadata", {}).get(key, metadata.get(key))
    return int(number) if number is not None and 1 <= int(number) <= 65535 else None


def _frame_rate_hz(metadata: dict[str, Any], binary_frames: int) -> float | None:
    """Return the rate of the sums, from the rate of the binary frames in the metadata; None if unknown."""
    for node in metadata.get("node_history", [])[:1]:
        rate = node.get("schedule", {}).get("base_schedule", {}).get("binary_frame_rate_fps")
        if rate is not None and 0 < float(rate) < float("inf"):
            return float(rate) / binary_frames
    return None


def _bayer(metadata: dict[str, Any]) -> Bayer | None:
    """Return the Bayer array before the pixels, from the metadata of a frame; None for a grey sensor and for other arrays."""
    key = "cfa_pattern"
    written = str(metadata.get("polycam_metadata", {}).get(key, metadata.get(key))).lower()
    known: tuple[Bayer, ...] = get_args(Bayer)
    return next((order for order in known if order == written), None)


def _check(config: UbiceptConfig) -> Sequence[str]:
    """Check for HDF5 by the first bytes; the content needs a library that may be missing."""
    if not config.path.is_file():
        return (missing_file(config.path),)
    if read_start(config.path, len(_HDF)) != _HDF:
        return (f"{config.path} is not an HDF5 file, by its first bytes; copy it again, or choose another source",)
    return ()


def _recognise(path: Path) -> Recognised | None:
    if not path.name.lower().endswith(_SUFFIX) or _check(UbiceptConfig(path=path)):
        return None
    return Recognised({"path": str(path)}, f"an HDF5 file whose name ends in {_SUFFIX}")


UBICEPT_H5 = SourceContribution(
    name="ubicept-h5",
    summary="Sums of binary frames in the .ubi.h5 files of Ubicept",
    config=UbiceptConfig,
    build=lambda config, _: UbiceptSource(config),
    check=_check,
    recognise=_recognise,
    suffixes=(".h5",),
    requires=(Requirement("h5py", "photonpano[hdf5]"),),
)
