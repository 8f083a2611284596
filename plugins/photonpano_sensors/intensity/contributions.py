"""Contributions of the sources of grey levels: their configs, and how captures are recognised, without heavy imports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from photonpano import Config, InputError, Recognised, Requirement, SourceContribution, SpecPath
from photonpano.reading import missing_file, natural_order, objections, read_start
from photonpano_sensors import intensity

Gamma = Annotated[float, Field(gt=0, le=10)]
PICTURES = (".png", ".tif", ".tiff")
_CONTAINERS = (
    ("an AVI file", re.compile(rb"RIFF....AVI ", re.DOTALL)),
    ("an MP4 or MOV file", re.compile(rb"....(ftyp|moov|mdat|wide|free)", re.DOTALL)),
    ("a Matroska or WebM file", re.compile(rb"\x1a\x45\xdf\xa3")),
)
_START_BYTES = 16
_TIFF = re.compile(rb"II[\x2a\x2b]\0|MM\0[\x2a\x2b]")


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
        ge=1,
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


def recognise_video(path: Path) -> Recognised | None:
    """Recognise videos by their first bytes."""
    start = read_start(path, _START_BYTES)
    for name, pattern in _CONTAINERS:
        if pattern.match(start):
            return Recognised({"path": path}, f"by its first bytes it is {name}")
    return None


def recognise_mraw(path: Path) -> Recognised | None:
    """Recognise headers and frames of Photron cameras, including those of an Infinicam: opening these says what to do."""
    suffix = path.suffix.lower()
    if not is_file(path):
        return None
    if suffix == ".mdat":
        return Recognised({"path": path}, "Photron's cameras write .mdat files")
    if suffix == ".mraw" and (header := header_beside(path)):
        return Recognised({"path": path}, f"{header.name} beside it is its header")
    if suffix in (".cih", ".cihx") and (mraw := mraw_beside(path) or _beside(path, ".mdat")):
        return Recognised({"path": path}, f"{mraw.name} beside it holds the frames")
    return None


def recognise_pictures(path: Path) -> Recognised | None:
    """Recognise folders of pictures, and TIFF files."""
    if _TIFF.match(read_start(path, _START_BYTES)):
        return Recognised({"path": path}, "by its first bytes it is a TIFF file")
    found = pictures_in(path)
    if not found:
        return None
    return Recognised({"path": path}, f"it holds {len(found)} {found[0].suffix} file{'s' if len(found) > 1 else ''}")


def refuse_mdat(path: Path) -> None:
    """Refuse raw files of an Infinicam, or the header of one, with an `InputError` that says what to do."""
    header_of = _beside(path, ".mdat") if path.suffix.lower() in (".cih", ".cihx") and not mraw_beside(path) else None
    if path.suffix.lower() == ".mdat" or header_of is not None:
        raise InputError(
            f"{header_of or path} is compressed by the camera, and only Photron's own library for Windows decodes it; "
            "export it as AVI or MP4 in the camera's viewer, and read that with the source video"
        )


def header_beside(mraw: Path) -> Path | None:
    """Return the header of an .mraw file; None if there is none."""
    return _beside(mraw, ".cihx") or _beside(mraw, ".cih")


def mraw_beside(header: Path) -> Path | None:
    """Return the .mraw file of a header; None if there is none."""
    return _beside(header, ".mraw")


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures of a folder in natural order; none if the folder cannot be read."""
    try:
        pictures = [file for file in folder.iterdir() if file.suffix.lower() in PICTURES]
    except OSError:
        return []
    return sorted(pictures, key=natural_order)


def _beside(path: Path, suffix: str) -> Path | None:
    candidates = (path.with_suffix(each) for each in (suffix, suffix.upper()))
    return next((each for each in candidates if is_file(each)), None)


def is_file(path: Path) -> bool:
    """Return whether there is such a file; False if the system refuses to answer."""
    try:
        return path.is_file()
    except OSError:
        return False


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
