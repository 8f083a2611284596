"""Contributions of the sources of grey levels, without heavy imports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import Requirement, SourceContribution
from photonpano.reading import missing_file, objections
from photonpano_sensors import intensity
from photonpano_sensors.intensity.configs import FastcamMrawConfig, ImageFolderConfig, VideoConfig
from photonpano_sensors.intensity.recognition import (
    PICTURES,
    is_file,
    recognise_mraw,
    recognise_pictures,
    recognise_video,
    refuse_mdat,
)

if TYPE_CHECKING:
    from collections.abc import Sequence


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
