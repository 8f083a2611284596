"""Keys of all simulated captures: frames, rate, light, and dropped and repeated frames."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from photonpano import Config, InputError


class FrameRange(Config):
    """Successive frames, counted before any are dropped or repeated."""

    at: int = Field(ge=0, description="index of the first frame, counted before any are dropped or repeated")
    frames: int = Field(1, ge=1, le=10_000_000, description="number of frames")


Side: TypeAlias = Annotated[int, Field(ge=8, le=8192)]

FrameCount: TypeAlias = Annotated[int, Field(ge=1, le=10_000_000, description="number of frames that the camera takes")]
FrameShape: TypeAlias = Annotated[tuple[Side, Side], Field(description="height and width of a frame, in px")]
FrameRate: TypeAlias = Annotated[float, Field(gt=0, le=1e9, description="frames a second, in Hz")]
Drift: TypeAlias = Annotated[
    float,
    Field(
        ge=1e-3,
        le=1e3,
        description="light of the last frame divided by that of the first; between them it changes exponentially",
    ),
]
Drops: TypeAlias = Annotated[tuple[FrameRange, ...], Field(description="frames that are missing in the capture")]
Repeats: TypeAlias = Annotated[
    tuple[FrameRange, ...],
    Field(description="frames that the capture holds twice: all of the range, and then all of it again"),
]


def _ordered(part: tuple[float, float]) -> tuple[float, float]:
    if part[0] >= part[1]:
        raise ValueError(f"{list(part)} is no part of the capture: its start is not before its stop; give [start, stop]")
    return part


_Share = Annotated[float, Field(ge=0, le=1)]
Part: TypeAlias = Annotated[tuple[_Share, _Share], AfterValidator(_ordered)]


def within(parts: tuple[tuple[float, float], ...], n_frames: int) -> NDArray[np.bool_]:
    """Return which frames lie in parts of the capture, given as shares of its length: (n_frames,)."""
    found = np.zeros(n_frames, dtype=bool)
    for start, stop in parts:
        found[round(start * n_frames) : round(stop * n_frames)] = True
    return found


def delivered(n_frames: int, drops: tuple[FrameRange, ...], repeats: tuple[FrameRange, ...]) -> NDArray[np.int64]:
    """Return, for each frame of the capture, the index of the frame that the camera took.

    Raises an `InputError` if a range lies beyond the last frame, or no frame is left.
    """
    for key, ranges in (("drops", drops), ("repeats", repeats)):
        for each in ranges:
            if each.at + each.frames > n_frames:
                raise InputError(
                    f"{key} names the frames {each.at} to {each.at + each.frames - 1}, but the camera takes {n_frames} "
                    f"frames (0 to {n_frames - 1}); shorten the range, or raise n_frames"
                )
    # A repeated range follows its own last frame: a stable sort by where a frame comes puts it there.
    taken = [np.arange(n_frames), *(np.arange(each.at, each.at + each.frames) for each in repeats)]
    places = [np.arange(n_frames), *(np.full(each.frames, each.at + each.frames - 1) for each in repeats)]
    order = np.concatenate(taken)[np.argsort(np.concatenate(places), kind="stable")]
    kept = np.ones(n_frames, dtype=bool)
    for each in drops:
        kept[each.at : each.at + each.frames] = False
    if not kept.any():
        raise InputError(f"drops leaves none of the {n_frames} frames; drop fewer of them")
    return order[kept[order]]
