from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photonpano_sensors.intensity.contributions import INTENSITY_SOURCES

REAL = Path(__file__).parents[2] / "data" / "photron"


def recognised(path: Path) -> dict[str, str]:
    """Return which sources take a path for their own, and why; and check that the keys are a config of theirs."""
    found = {}
    for contribution in INTENSITY_SOURCES:
        if (answer := contribution.recognise(path)) is not None:
            assert contribution.config.model_validate(answer.keys).path == path
            found[contribution.name] = answer.because
    return found


@pytest.mark.parametrize("name", ["beam.cihx", "beam.mraw"])
def test_fastcam_recordings_are_recognised(name: str) -> None:
    other = {"beam.cihx": "beam.mraw beside it holds the frames", "beam.mraw": "beam.cihx beside it is its header"}
    assert recognised(REAL / name) == {"fastcam-mraw": other[name]}


@pytest.mark.parametrize(
    ("name", "codec", "because"),
    [
        ("a.avi", "mjpeg", "by its first bytes it is an AVI file"),
        ("a.mp4", "mpeg4", "by its first bytes it is an MP4 or MOV file"),
        ("a.mkv", "mpeg4", "by its first bytes it is a Matroska or WebM file"),
    ],
)
def test_videos_are_recognised_by_their_first_bytes(
    moving: Callable, write_video: Callable, tmp_path: Path, name: str, codec: str, because: str
) -> None:
    path = write_video(moving(2), name, codec, "yuvj420p" if codec == "mjpeg" else "yuv420p")
    assert recognised(shutil.copy(path, tmp_path / "without-a-suffix")) == {"video": because}


def test_folders_of_pictures_and_tiff_files_are_recognised(tmp_path: Path) -> None:
    assert recognised(tmp_path) == {}
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    assert recognised(tmp_path) == {"image-folder": "it holds 1 .png file"}
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((2, 4, 4), np.uint8))
    assert recognised(tmp_path / "b.tif") == {"image-folder": "by its first bytes it is a TIFF file"}


def test_infinicam_files_are_recognised(tmp_path: Path) -> None:
    (tmp_path / "a.mdat").write_bytes(b"")
    (tmp_path / "a.cih").write_bytes(b"")
    assert recognised(tmp_path / "a.mdat") == {"fastcam-mraw": "Photron's cameras write .mdat files"}
    assert recognised(tmp_path / "a.cih") == {"fastcam-mraw": "a.mdat beside it holds the frames"}


def test_other_files_are_not_recognised(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY")
    (tmp_path / "lonely.cih").write_bytes(b"")
    for path in (tmp_path / "a.npy", tmp_path / "lonely.cih", tmp_path / "missing.mp4", tmp_path / "missing"):
        assert recognised(path) == {}
