"""Source `mat-parts`: binary frames in a folder of MATLAB files, part_1.mat, part_2.mat, and so on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from photonpano import Config, FrameSpan, InputError, Recognised, SourceContribution, SpecPath
from photonpano.reading import BinarySource, FrameLayout, objections, read_json, require_readable
from photonpano_sensors.matlab import packed_frames, shape_of_frames

_NAME = re.compile(r"part_([1-9][0-9]*)\.mat")
_INFO = "info.json"
_MOST_PARTS = 4  # packed parts kept in memory: compressed files can only be read from the beginning


class MatPartsConfig(Config):
    """A capture in a folder of MATLAB files."""

    path: SpecPath = Field(
        description=f"the folder of part_1.mat, part_2.mat and so on, each with frames of zeros and ones as OUTPUT (height, "
        f"width, frames); an optional {_INFO} with no_parts and no_frames must agree with them"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


class _Info(BaseModel):
    no_parts: int
    no_frames: int


class MatPartsSource(BinarySource):
    """Frames of MATLAB files. A part is read whole when one of its frames is read, and the last four parts are kept."""

    def __init__(self, config: MatPartsConfig) -> None:
        self._paths = _parts(config.path)
        shapes = [shape_of_frames(path) for path in self._paths]
        for path, shape in zip(self._paths, shapes, strict=True):
            if shape[1:] != shapes[0][1:]:
                raise InputError(
                    f"{path} holds frames of {_size(shape)} px, and {self._paths[0].name} of {_size(shapes[0])}; parts of one "
                    "capture have the same size"
                )
        self._starts = list(accumulate((shape[0] for shape in shapes), initial=0))
        info, n_frames = _info(config.path), [shape[0] for shape in shapes]
        # Its no_frames is that of the capture, or that of each part but the last.
        if info and info.no_frames != sum(n_frames) and {*n_frames[:-1], max(n_frames)} != {info.no_frames}:
            raise InputError(
                f"{config.path / _INFO} speaks of {info.no_frames} frames, and the parts hold {sum(n_frames)}; correct it, or "
                "copy the parts again"
            )
        _, height, width = shapes[0]
        super().__init__(self._starts[-1], FrameLayout((height, width), (height, -(-width // 8))), config.frame_rate_hz)
        self._lock = Lock()
        self._packed = lru_cache(_MOST_PARTS)(packed_frames)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, one part after the other: see `BinarySource`."""
        for path, (first, last) in zip(self._paths, pairwise(self._starts), strict=True):
            start, stop = max(span.start, first), min(span.stop, last)
            if start < stop:
                with self._lock:  # otherwise several threads would read the same part
                    packed = self._packed(path)
                yield slice(start - span.start, stop - span.start), packed[start - first : stop - first]

    def close(self) -> None:
        """Release the parts that were read."""
        self._packed.cache_clear()


def _parts(folder: Path) -> list[Path]:
    """Return the parts in order; raise if one is missing."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; name the folder of part_1.mat and so on")
    require_readable(folder)
    numbers = {int(match[1]) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))}
    info = _info(folder)
    expected = max(numbers, default=0) if info is None else info.no_parts
    if not numbers:
        raise InputError(f"there is no part_1.mat in the folder {folder}; check the path")
    for number in range(1, expected + 1):
        if number not in numbers:
            raise InputError(f"there is no part_{number}.mat in the folder {folder}, which has {expected} parts; copy it again")
    if max(numbers) > expected:
        raise InputError(f"{folder / _INFO} speaks of {expected} parts, and there is a part_{max(numbers)}.mat; correct it")
    return [folder / f"part_{number}.mat" for number in sorted(numbers)]


def _info(folder: Path) -> _Info | None:
    path = folder / _INFO
    return read_json(path, _Info) if path.exists() else None


def _size(shape: tuple[int, int, int]) -> str:
    return f"{shape[1]}x{shape[2]}"


MAT_PARTS = SourceContribution(
    name="mat-parts",
    summary="Binary frames in a folder of MATLAB files, part_1.mat and so on",
    config=MatPartsConfig,
    build=lambda config, _: MatPartsSource(config),
    check=lambda config: objections(_parts, config.path),  # the names alone: reading a part takes seconds
    recognise=lambda path: None if objections(_parts, path) else Recognised({"path": str(path)}, "a folder with part_1.mat"),
    suffixes=(".mat",),
)
