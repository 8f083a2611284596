from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import InputError
from photonpano_sensors.intensity.contributions import ImageFolderConfig
from photonpano_sensors.intensity.pictures import ImageFolderSource


def test_pictures_are_in_natural_order_without_other_files(tmp_path: Path) -> None:
    for number in (10, 2, 9, 100):
        cv2.imwrite(str(tmp_path / f"shot_7_{number}.PNG"), np.full((4, 6), number, np.uint8))
    (tmp_path / "notes.txt").write_text("of the day")
    with ImageFolderSource(ImageFolderConfig(path=tmp_path)) as source:
        assert source.frames(source.info.span)[:, 0, 0].tolist() == [2, 9, 10, 100]


def test_compressed_tiff_pages_are_read(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 4096, (20, 8, 6)).astype(np.uint16)
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for frame in frames:
            writer.write(frame, compression="zlib", contiguous=False)
    with ImageFolderSource(ImageFolderConfig(path=tmp_path / "a.tif")) as source:
        assert (source.info.n_frames, source.info.bit_depth) == (20, 16)
        np.testing.assert_array_equal(source.frames(source.info.span), frames)


def test_picture_damaged_or_replaced_while_open_is_refused(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.random.default_rng(number).integers(0, 255, (40, 60), np.uint8))
    with ImageFolderSource(ImageFolderConfig(path=tmp_path)) as source:
        whole = (tmp_path / "1.png").read_bytes()
        (tmp_path / "1.png").write_bytes(whole[: len(whole) // 2])
        with pytest.raises(InputError, match=r"1.png is damaged: frame 1 cannot be read; copy it again$"):
            source.counts(source.info.span)
        cv2.imwrite(str(tmp_path / "1.png"), np.zeros((40, 61), np.uint8))
        with pytest.raises(InputError, match=r"1.png has changed: it had 40x60 pixels of 8 bits when the capture was opened$"):
            source.counts(source.info.span)
