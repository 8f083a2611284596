"""The run folder: every file is written whole, and all of them arrive together."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile

from photonpano.atomic import atomic_files
from photonpano.errors import OutputError
from photonpano.geometry import Canvas
from photonpano.merging.panorama import RenderedPanorama, Tile
from photonpano.motion.frame_motion import FrameMotion
from photonpano.record.schema import RunRecord
from photonpano.values import FluxImage, Panorama


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A folder in which the files of a run are gathered before they get their final names.

    Attributes:
        directory: where they end up.
        staging: where they are written.
    """

    directory: Path
    staging: Path

    def write_tile(self, tile: Tile, rendered: Panorama, canvas: Canvas) -> None:
        """Write a part of panorama.tiff and coverage.tiff (float32); the parts make up the canvas."""
        with _writing(self.directory):
            _write_box(self.staging / "panorama.tiff", rendered.flux, tile, canvas)
            _write_box(self.staging / "coverage.tiff", rendered.weight, tile, canvas)

    def write_results(self, panorama: RenderedPanorama, motion: FrameMotion, record: RunRecord) -> None:
        """Write panorama.png (8 bits, sRGB), trajectory.npz and run.json."""
        encoded, png = cv2.imencode(".png", panorama.picture)
        if not encoded:
            raise OutputError(f"OpenCV could not encode the panorama of {panorama.picture.shape} as PNG")
        with _writing(self.directory):
            (self.staging / "panorama.png").write_bytes(png.tobytes())
            np.savez(
                self.staging / "trajectory.npz",
                homographies=motion.homographies,
                canvas=panorama.canvas.transform,
                frame_shape=np.array(motion.frame_shape),
                reference=np.array(motion.reference),
                located=motion.located,
                std_px=motion.std_px,
            )
        self._write_text("run.json", json.dumps(record, indent=2, allow_nan=False) + "\n")

    def write_report(self, page: str) -> None:
        """Write report.html."""
        self._write_text("report.html", page)

    def _write_text(self, name: str, text: str) -> None:
        with _writing(self.directory):
            (self.staging / name).write_text(text, encoding="utf-8")


@contextmanager
def run_folder(directory: Path) -> Iterator[RunFolder]:
    """Gather the files of a run, and give them their final names when the block ends well.

    The folder is made, and proved to be writable, before the work starts. When the block raises, what was there before stays
    as it was, and folders that were not there are gone again.

    Raises:
        OutputError: the folder cannot be made or written to, or the disk is full.
    """
    with ExitStack() as stack:
        try:
            staging = stack.enter_context(atomic_files(directory, last="run.json"))
        except OSError as error:
            raise OutputError(
                f"{directory}: the run folder cannot be written to ({error.strerror}); choose another one with --output"
            ) from error
        yield RunFolder(directory, staging)
        with _writing(directory):
            stack.close()


@contextmanager
def _writing(directory: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        # A short write of an array comes without the system's words.
        reason = error.strerror or "a file was cut short"
        raise OutputError(
            f"{directory}: the results could not be written ({reason}); what was there before is unchanged. "
            "Make room, or choose another folder with --output"
        ) from error


def _write_box(path: Path, image: FluxImage, tile: Tile, canvas: Canvas) -> None:
    """Write a box of pixels into a TIFF file, which the first one lays out."""
    if not path.exists():
        room = 4 * canvas.height * canvas.width
        if room > shutil.disk_usage(path.parent).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        tifffile.imwrite(path, shape=canvas.shape, dtype=np.float32, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as file:
        start = file.pages.first.dataoffsets[0]
    with path.open("rb+") as stream:
        if image.shape[1] == canvas.width:
            stream.seek(start + 4 * tile.top * canvas.width)
            image.tofile(stream)
            return
        for row, pixels in enumerate(image, start=tile.top):
            stream.seek(start + 4 * (row * canvas.width + tile.left))
            pixels.tofile(stream)
