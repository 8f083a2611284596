"""Keys that the configs of all simulated cameras share: frames, rate, light, and what the capture loses."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from photonpano import Config


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
