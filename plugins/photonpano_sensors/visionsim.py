"""Source `visionsim`: a .npy file of binary frames with the transforms.json that visionsim writes beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from photonpano import Config, FrameSpan, InputError, Recognised, Source, SourceContribution, SpecPath
from photonpano.photometry import packed_along_width
from photonpano.reading import (
    FrameFile,
    FrameLayout,
    PackedFileSource,
    ThreeChannels,
    npy_header,
    objections,
    of_channel,
    read_json,
    require_whole,
)

_TRANSFORMS = "transforms.json"


class VisionsimConfig(Config):
    """A capture simulated by visionsim."""

    path: SpecPath = Field(description=f"the {_TRANSFORMS} beside the .npy file, or their folder")
    channel: int | None = Field(
        None, ge=0, le=2, description="the one channel that is read of a capture in colour: 0, 1 or 2; by default all"
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, description=f"frames a second, in Hz; by default `fps` of {_TRANSFORMS}, if it is there"
    )


class _Part(BaseModel):
    """Keys that describe all frames, or one."""

    model_config = ConfigDict(frozen=True)

    file_path: Path | None = None
    bitpack_dim: Literal[1, 2] | None = None
    offset: int | None = Field(None, ge=0)


class _Transforms(_Part):
    """The keys of a transforms.json that describe how frames are stored. Its poses are not used."""

    h: int = Field(ge=1)
    w: int = Field(ge=1)
    c: Literal[1, 3] = 1
    fps: float | None = Field(None, gt=0, allow_inf_nan=False)
    bitpack: bool | None = None
    frames: tuple[_Part, ...] = Field(min_length=1)


def _open(config: VisionsimConfig) -> Source:
    files, layout_of, fps, in_colour = _read(config)

    def opened(channel: int | None) -> PackedFileSource:
        return PackedFileSource(files, layout_of(channel), config.frame_rate_hz or fps)

    return ThreeChannels(opened) if in_colour and config.channel is None else opened(config.channel)


def _read(config: VisionsimConfig) -> tuple[list[FrameFile], Callable[[int | None], FrameLayout], float | None, bool]:
    """Return the files, the layout of a channel, the frame rate, and whether there are three channels; frames are not read."""
    path = config.path / _TRANSFORMS if config.path.is_dir() else config.path
    transforms = read_json(path, _Transforms)
    frames = [_completed(each, transforms, path) for each in transforms.frames]
    packing = {each.bitpack_dim for each in frames}
    if len(packing) > 1:
        raise InputError(f"{path} describes frames that are packed along different dimensions, which this source cannot read")
    if transforms.c == 1 and config.channel is not None:
        raise InputError(f"{path} says that frames have c: 1; leave out the channel")
    layout_of = partial(_layout, transforms, packing.pop(), path)
    return _files(frames, transforms, layout_of(None), path.parent), layout_of, transforms.fps, transforms.c == 3


def _completed(frame: _Part, transforms: _Transforms, path: Path) -> _Part:
    """Return a frame, completed by the keys that describe all frames."""
    packing = frame.bitpack_dim or transforms.bitpack_dim
    if transforms.bitpack is False:
        packing = None
    elif transforms.bitpack and packing is None:
        raise InputError(f"{path} says that frames are packed, but not along which dimension; add bitpack_dim: 1 or 2")
    file = frame.file_path or transforms.file_path
    if file is None:
        raise InputError(f"{path} names no file_path; add that of the .npy file")
    if file.suffix != ".npy" or "\0" in file.name:
        raise InputError(f"{path} names {file}, not a .npy file; convert the images with visionsim")
    return _Part(file_path=file, bitpack_dim=packing, offset=frame.offset)


def _files(frames: Sequence[_Part], transforms: _Transforms, layout: FrameLayout, folder: Path) -> list[FrameFile]:
    """Return runs of consecutive frames in a file."""
    runs: list[tuple[Path, int, int]] = []
    for index, frame in enumerate(frames):
        assert frame.file_path is not None, "it was completed"
        place = index if frame.offset is None else frame.offset
        if runs and runs[-1][0] == frame.file_path and sum(runs[-1][1:]) == place:
            runs[-1] = (frame.file_path, runs[-1][1], runs[-1][2] + 1)
        else:
            runs.append((frame.file_path, place, 1))
    headers = {file: _header(folder / file, transforms, layout) for file in dict.fromkeys(run[0] for run in runs)}
    found = []
    for file, start, n_frames in runs:
        header = headers[file]
        if start + n_frames > header.n_frames:
            raise InputError(
                f"{folder / _TRANSFORMS} lists frame {start + n_frames - 1} of {file}, which has {header.n_frames}; "
                "write it again"
            )
        found.append(FrameFile(header.path, n_frames, header.offset + start * layout.stored_bytes))
    return found


def _header(path: Path, transforms: _Transforms, layout: FrameLayout) -> FrameFile:
    """Return all frames of a .npy file."""
    header = npy_header(path)
    expected = layout.stored_shape
    if header.shape[1:] != expected and not (transforms.c == 1 and header.shape[1:] == expected[:-1]):
        raise InputError(
            f"{path} holds frames of shape {header.shape[1:]}, and the {_TRANSFORMS} beside it promises {expected}; correct "
            "its h, w, c, bitpack or bitpack_dim"
        )
    if header.dtype not in (np.uint8, np.bool_) or header.fortran_order:
        raise InputError(
            f"{path} holds {header.dtype} values{' in Fortran order' if header.fortran_order else ''}; binary frames are uint8 "
            "or bool in C order"
        )
    require_whole(path, header)
    return FrameFile(path, header.shape[0], header.offset)


def _layout(transforms: _Transforms, packed_dim: int | None, path: Path, channel: int | None) -> FrameLayout:
    """Return the layout of frames in the file. `channel` selects one of three, None all; `path` is for error messages."""
    height, width = transforms.h, transforms.w

    def along_width(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return of_channel(stored, channel)

    def along_height(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return packed_along_width(of_channel(stored, channel))[:, :height]

    def not_packed(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        values = of_channel(stored, channel)
        # 255 becomes 0 here, 0 becomes 1, 1 becomes 2.
        if (values + np.uint8(1)).max() > 2:
            raise InputError(f"{path} describes frames with values other than 0, 1 and 255: they are not binary")
        return np.packbits(values, axis=2)

    stored, to_rows = {
        None: ((height, width), not_packed),
        1: ((math.ceil(height / 8), width), along_height),
        2: ((height, math.ceil(width / 8)), along_width),
    }[packed_dim]
    return FrameLayout((height, width), (*stored, transforms.c), to_rows=to_rows)


def _recognise(path: Path) -> Recognised | None:
    """Take a folder with a transforms.json, that file, and a .npy file that it names."""
    transforms = (path if path.is_dir() else path.parent) / _TRANSFORMS
    if not transforms.is_file():
        return None

    config = VisionsimConfig(path=transforms)
    try:
        files, _, _, in_colour = _read(config)
        with _open(config) as source:
            source.frames(FrameSpan(0, 1))  # which fails if they are not binary
    except InputError:
        return None
    if path not in (transforms, transforms.parent, *(file.path for file in files)):
        return None
    channels = ", in three channels" if in_colour else ""
    because = f"a {_TRANSFORMS} and the .npy file of binary frames that it names{channels}"
    return Recognised({"path": str(transforms)}, because)


VISIONSIM = SourceContribution(
    name="visionsim",
    summary="Binary frames simulated by visionsim: a .npy file and its transforms.json",
    config=VisionsimConfig,
    build=lambda config, _: _open(config),
    check=lambda config: objections(_read, config),
    recognise=_recognise,
    suffixes=(".json",),
)
