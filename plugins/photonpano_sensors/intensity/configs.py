"""Configs of the sources of grey levels, without heavy imports."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from photonpano import Config, SpecPath

Gamma = Annotated[float, Field(gt=0, le=10)]


class ResponseConfig(Config):
    """How a camera converts photons to the grey levels of its file."""

    curve: Literal["linear", "srgb"] | Gamma = Field(
        "linear",
        description="encoding of the grey levels, which is undone before frames are summed: linear for raw levels, "
        "srgb, or the exponent that makes them linear, such as 2.2",
    )
    curve_file: SpecPath | None = Field(
        None,
        description="measured curve, instead of `curve`: a text file with a number for each level from 0 on, "
        "proportional to the light",
    )
    black_level: float | None = Field(
        None, ge=0, description="level without light; by default 0, and 16 (of 8 bits) in a video of limited range"
    )
    white_level: float | None = Field(
        None,
        gt=0,
        description="level at which a pixel saturates; by default the highest, and 235 (of 8 bits) in a video of limited range",
    )
    saturation_photons: float = Field(
        10_000.0,
        gt=0,
        le=1e9,
        description="detected photons per pixel per frame at white_level; scales the flux, and determines the photon noise",
    )
    read_noise: float = Field(
        20.0,
        ge=0,
        le=1e6,
        description="standard deviation of the read noise, in photons, without quantisation noise",
    )

    @model_validator(mode="after")
    def _one_curve(self) -> Self:
        if self.curve_file is not None and self.curve != "linear":
            raise ValueError(f"curve_file takes the place of the curve {self.curve}; leave out one of them")
        return self


class IntensityConfig(Config):
    """Keys of all sources of grey levels."""

    path: SpecPath = Field(description="the capture")
    frame_rate_hz: float | None = Field(
        None, gt=0, description="frames a second while recording, in Hz; by default from the file, if known"
    )
    response: ResponseConfig = Field(ResponseConfig(), description="conversion of photons to grey levels")


class VideoConfig(IntensityConfig):
    """A video file of any camera."""

    path: SpecPath = Field(description="the video, such as an .mp4 or .avi file")


class FastcamMrawConfig(IntensityConfig):
    """Raw frames of a Photron FASTCAM."""

    path: SpecPath = Field(description="the .cih or .cihx file, or the .mraw file of the same name beside it")


class ImageFolderConfig(IntensityConfig):
    """A picture for each frame."""

    path: SpecPath = Field(
        description="a folder of .png or .tif files, one per frame, in natural order (2 before 10), or one .tif file "
        "with a page per frame"
    )
