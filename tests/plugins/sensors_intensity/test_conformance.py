"""The sources of grey levels keep what every source promises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

from photonpano import discover
from photonpano.testing import SourceConformance

CATALOG = discover()
CIH = """#Camera Information Header
Record Rate(fps) : 500
Total Frame : {0}
Image Width : {2}
Image Height : {1}
Color Type : Mono
Color Bit : {3}
File Format : MRaw
EffectiveBit Depth : {3}
EffectiveBit Side : Lower
"""


class TestVideo(SourceConformance):
    """FFV1 loses nothing; a key frame every 12 frames, so that decoding has to begin before what is asked for."""

    contribution = CATALOG.find("source", "video").contribution
    bit_depth = 8
    wrong = ({"path": "there-is-no-such-file.mp4"}, {"path": "capture.mdat"})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        import av

        pixels = "gray" if self.bit_depth == 8 else "gray16le"
        with av.open(str(folder / "capture.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30, options={"g": "12"})
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], pixels
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels)))
            container.mux(stream.encode())
        return {"path": folder / "capture.mkv"}


class TestVideoOf16Bits(TestVideo):
    bit_depth = 16


class TestFastcamMraw(SourceConformance):
    contribution = CATALOG.find("source", "fastcam-mraw").contribution
    bit_depth = 8
    wrong = ({"path": "there-is-no-such-file.cih"},)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        (folder / "capture.cih").write_text(CIH.format(*frames.shape, self.bit_depth))
        if self.bit_depth == 12:
            first, second = frames.reshape(-1, 2).T
            frames = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=-1).astype(np.uint8)
        frames.tofile(folder / "capture.mraw")
        return {"path": folder / "capture.cih"}


class TestFastcamMrawOf12Bits(TestFastcamMraw):
    bit_depth = 12


class TestFastcamMrawOf16Bits(TestFastcamMraw):
    bit_depth = 16


class TestImageFolder(SourceConformance):
    """Without leading zeros, so that the order of letters is a wrong one."""

    contribution = CATALOG.find("source", "image-folder").contribution
    bit_depth = 8
    suffix = "png"
    wrong = ({"path": "there-is-no-such-folder"},)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        for index, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"frame{index}.{self.suffix}"), frame)
        return {"path": folder}


class TestImageFolderOf16Bits(TestImageFolder):
    bit_depth = 16


class TestImageFolderOfTiff(TestImageFolder):
    bit_depth = 16
    suffix = "tif"


class TestPagesOfTiff(TestImageFolder):
    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        tifffile.imwrite(folder / "capture.tif", frames)
        return {"path": folder / "capture.tif"}
