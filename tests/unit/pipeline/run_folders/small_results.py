"""Small results, and how a run writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from photonpano import FrameSpan, Panorama
from photonpano.geometry import Canvas, translation
from photonpano.merging.panorama import RenderedPanorama, Tile
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.testing import KnownMotion

FLUX = np.random.default_rng(0).random((60, 90), np.float32)
FLUX[:, :5] = np.nan
PANORAMA = Panorama(FLUX, np.where(np.isnan(FLUX), np.float32(0), np.float32(7)), translation(3, 4))
CANVAS = Canvas(60, 90, PANORAMA.canvas)
PICTURE = np.arange(60 * 90, dtype=np.uint8).reshape(60, 90)
FILES = {"panorama.tiff", "panorama.png", "coverage.tiff", "trajectory.npz", "run.json", "report.html"}
MOTION = FrameMotion(
    KnownMotion(lambda _: np.eye(3)),
    FrameSpan(0, 500),
    np.random.default_rng(0).random((500, 3, 3)),
    np.ones(500, bool),
    np.ones(500),
    250,
    (48, 64),
)
RENDERED = RenderedPanorama(CANVAS, PANORAMA, 1, PICTURE, 1.0, 0.9, 2.0)
RECORD: Any = {"photonpano": "0", "spec": {}, "warnings": ["a line"] * 2000}


def write_panorama(folder: RunFolder) -> None:
    folder.write_tile(Tile(0, 0, CANVAS), PANORAMA, CANVAS)


def write_results(folder: RunFolder) -> None:
    folder.write_results(RENDERED, MOTION)


def write_record(folder: RunFolder) -> None:
    folder.commit(RECORD)


WRITERS = (write_panorama, write_results, write_record)


def write_all(folder: RunFolder) -> None:
    """Write a run as `run` does: the results, and then the report."""
    for write in WRITERS:
        write(folder)
    folder.reopen()
    folder.write_report("<html>µ</html>" * 2000)
    folder.commit(RECORD)


def run_into(directory: Path, **options: Any) -> None:
    with run_folder(directory, **options) as folder:
        write_all(folder)


def files_in(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}
