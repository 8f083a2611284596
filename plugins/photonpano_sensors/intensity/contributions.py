"""Contributions of the sources of grey levels, and their configs, without heavy imports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from photonpano import Config, Requirement, SourceContribution, SpecPath
from photonpano.reading import missing_file, objections
from photonpano_sensors import intensity
from photonpano_sensors.intensity.recognition import (
    PICTURES,
    is_file,
    recognise_mraw,
    recognise_pictures,
    recognise_video,
    refuse_mdat,
)

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


def _check_video(config: VideoConfig) -> Sequence[str]:
    """Check the name of the file only: indexing its packets takes as long as reading it."""
    if found := objections(refuse_mdat, config.path):
        return found
    return () if is_file(config.path) else (missing_file(config.path),)


INTENSITY_SOURCES: tuple[SourceContribution, ...] = (
    SourceContribution(
        name="video",
        summary="Grey frames of a video, such as an MP4 or AVI file of a high-speed camera",
        config=VideoConfig,
        build=lambda config, context: intensity.VideoSource(config, context),
        check=_check_video,
        recognise=recognise_video,
        suffixes=(".mp4", ".avi", ".mov", ".mkv"),
        requires=(Requirement("av", "photonpano[video]"),),
    ),
    SourceContribution(
        name="fastcam-mraw",
        summary="Raw frames of a Photron FASTCAM: .mraw with .cih or .cihx",
        config=FastcamMrawConfig,
        build=lambda config, _: intensity.FastcamMrawSource(config),
        check=lambda config: objections(intensity.open_recording, config.path),
        recognise=recognise_mraw,
        suffixes=(".mraw", ".cih", ".cihx"),
    ),
    SourceContribution(
        name="image-folder",
        summary="Grey PNG or TIFF files, one a frame, or the pages of a TIFF file",
        config=ImageFolderConfig,
        build=lambda config, _: intensity.ImageFolderSource(config),
        check=lambda config: objections(lambda: intensity.ImageFolderSource(config).close()),
        recognise=recognise_pictures,
        suffixes=PICTURES,
    ),
)
