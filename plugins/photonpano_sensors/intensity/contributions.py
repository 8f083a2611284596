"""Contributions of the sources of grey levels, without heavy imports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano import Requirement, SourceContribution
from photonpano.reading import missing_file, objections
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

    from photonpano import Source, SourceContext


def _build_video(config: VideoConfig, context: SourceContext) -> Source:
    from photonpano_sensors.intensity.video import VideoSource

    return VideoSource(config, context)


def _check_video(config: VideoConfig) -> Sequence[str]:
    """Check the name of the file only: indexing its packets takes as long as reading it."""
    if found := objections(refuse_mdat, config.path):
        return found
    return () if is_file(config.path) else (missing_file(config.path),)


def _build_mraw(config: FastcamMrawConfig, context: SourceContext) -> Source:
    from photonpano_sensors.intensity.mraw import FastcamMrawSource

    del context
    return FastcamMrawSource(config)


def _check_mraw(config: FastcamMrawConfig) -> Sequence[str]:
    from photonpano_sensors.intensity.mraw import open_recording

    return objections(open_recording, config.path)


def _build_pictures(config: ImageFolderConfig, context: SourceContext) -> Source:
    from photonpano_sensors.intensity.pictures import ImageFolderSource

    del context
    return ImageFolderSource(config)


def _check_pictures(config: ImageFolderConfig) -> Sequence[str]:
    from photonpano_sensors.intensity.pictures import ImageFolderSource

    return objections(lambda: ImageFolderSource(config).close())


INTENSITY_SOURCES: tuple[SourceContribution, ...] = (
    SourceContribution(
        name="video",
        summary="Grey frames of a video, such as an MP4 or AVI file of a high-speed camera",
        config=VideoConfig,
        build=_build_video,
        check=_check_video,
        recognise=recognise_video,
        suffixes=(".mp4", ".avi", ".mov", ".mkv"),
        requires=(Requirement("av", "photonpano[video]"),),
    ),
    SourceContribution(
        name="fastcam-mraw",
        summary="Raw frames of a Photron FASTCAM: .mraw with .cih or .cihx",
        config=FastcamMrawConfig,
        build=_build_mraw,
        check=_check_mraw,
        recognise=recognise_mraw,
        suffixes=(".mraw", ".cih", ".cihx"),
    ),
    SourceContribution(
        name="image-folder",
        summary="Grey PNG or TIFF files, one a frame, or the pages of a TIFF file",
        config=ImageFolderConfig,
        build=_build_pictures,
        check=_check_pictures,
        recognise=recognise_pictures,
        suffixes=PICTURES,
    ),
)
