"""The files of a run that follows a capture: a picture of what was located so far, on a canvas that grows, and its page."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.errors import OutputError, PhotonpanoError
from photonpano.execution.context import Context
from photonpano.files.atomic import atomic_path
from photonpano.geometry import Canvas, corners, normalised, rescaling, transform_points, translation
from photonpano.merging import accumulate
from photonpano.merging.accumulate import PhotonSum
from photonpano.merging.chunks import chunks_of
from photonpano.photometry import picture_of
from photonpano.pipeline.following.located import LocatedSoFar, Window
from photonpano.reading import BinarySource, FrameLayout
from photonpano.report import LiveFigures, render_live
from photonpano.specs.plan import Plan
from photonpano.values import FloatArray, FluxImage, FrameSpan, Homography, Response

logger = logging.getLogger(__name__)

_MOST_PIXELS = 2_000_000  # maximum canvas size; a larger one is halved in scale
_LEAST_SCALE = 1 / 8  # minimum scale; below, the picture starts again
_MOST_AREA_CHANGE = 4.0  # maximum ratio of the areas of a frame and the first frame on the canvas, either way
_MARGIN = 0.25  # extra growth of the canvas, in longer sides of a frame
_TOLERANCE_PX = 1.0  # motion within which frames are summed before they are warped
_WHITE = 0.995  # quantile of the flux that is white
_SAMPLES = 100_000  # pixels from which that quantile is estimated
# The simulated capture of `rehearse`: shape, size of blocks, number of frames, length of the pan.
_SHAPE, _BLOCK_PX, _N_FRAMES, _LENGTH_PX = (64, 96), 8, 2048, 32


class PictureSoFar:
    """Sums the frames of windows.

    Convention: The plane of the canvas is that of the first window; (x, y) of the canvas are those of the plane times `scale`,
    the pixels of the canvas per pixel of a frame.
    """

    def __init__(self) -> None:
        self.scale = 1.0
        self._sums = np.zeros((2, 0, 0), np.float32)  # counts and weights (frames per pixel)
        self._origin: NDArray[np.integer] = np.zeros(2, int)  # (x, y) of the first pixel
        self._to_plane: Homography = np.eye(3)  # from the frame that the next window has in common with the last one
        self._response: Response | None = None

    def add(self, window: Window) -> None:
        """Add the new frames of a window. If they do not join, or lie too askew or too far away, the picture begins anew."""
        shape, self._response = window.source.info.frame_shape, window.source.response
        chunks = chunks_of(window.new, window.trajectory, shape, _TOLERANCE_PX)
        places = np.array([chunk.homography for chunk in chunks])
        if not (window.joins and _upright(self._to_plane @ places, shape) and self._grow(self._to_plane @ places, shape)):
            self.scale, self._sums, self._to_plane = 1.0, np.zeros((2, 0, 0), np.float32), np.eye(3)
            self._grow(places, shape)
        low, high = self._box(self._to_plane @ places, shape)
        low, high = np.maximum(low, self._origin), np.minimum(high, self._origin + self._sums.shape[:0:-1])
        (left, top), (width, height) = (low - self._origin).tolist(), (high - low).tolist()
        canvas = Canvas(height, width, translation(*-low.astype(float)) @ rescaling(self.scale) @ self._to_plane)
        added = accumulate(window.source, chunks, canvas, canvas.shape)
        self._sums[:, top : top + height, left : left + width] += added.counts, added.weight
        self._to_plane = normalised(self._to_plane @ window.to_next)

    def png(self) -> bytes | None:
        """Return the picture as PNG, in sRGB; None as long as nothing was added."""
        flux = self._flux()
        if flux is None:
            return None
        lit = flux[np.isfinite(flux)]
        white = float(np.quantile(lit[:: -(-lit.size // _SAMPLES)], _WHITE)) if lit.size else 0.0
        encoded, png = cv2.imencode(".png", picture_of(flux, white or 1.0), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return png.tobytes() if encoded else None

    def _flux(self) -> FluxImage | None:
        """Return the flux of the part of the canvas that was seen: (H, W), NaN where it is unknown."""
        counts, weight = self._sums
        rows, columns = (np.flatnonzero(weight.any(axis=axis)) for axis in (1, 0))
        if self._response is None or not rows.size:
            return None
        seen = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        return PhotonSum(counts[seen], weight[seen]).estimate(self._response)[0]

    def _grow(self, placed: FloatArray, shape: tuple[int, int]) -> bool:
        """Make room for frames at (N, 3, 3) places of the plane; return whether there is enough."""
        while True:
            low, high = self._box(placed, shape)
            first, last = self._origin, self._origin + self._sums.shape[:0:-1]
            if not self._sums.size:
                first, last = low, high
            elif (low >= first).all() and (high <= last).all():
                return True
            margin = round(_MARGIN * self.scale * max(shape))
            first, last = np.where(low < first, low - margin, first), np.where(high > last, high + margin, last)
            if np.prod(last - first) <= _MOST_PIXELS:
                self._enlarge(first, last)
                return True
            if self.scale <= _LEAST_SCALE:
                return False
            self._halve()

    def _enlarge(self, first: NDArray[np.integer], last: NDArray[np.integer]) -> None:
        """Enlarge the canvas to the pixels from `first` to the one before `last`, (x, y)."""
        (width, height), (left, top) = (last - first).tolist(), (self._origin - first).tolist()
        grown = np.zeros((2, height, width), np.float32)
        if self._sums.size:
            grown[:, top : top + self._sums.shape[1], left : left + self._sums.shape[2]] = self._sums
        self._sums, self._origin = grown, first

    def _halve(self) -> None:
        """Halve the scale: each pixel gets the mean of four, of counts and weights alike."""
        first, last = self._origin, self._origin + self._sums.shape[:0:-1]
        self._enlarge(first - first % 2, last + last % 2)
        height, width = self._sums.shape[1:]
        self._sums = self._sums.reshape(2, height // 2, 2, width // 2, 2).mean(axis=(2, 4), dtype=np.float32)
        self.scale, self._origin = self.scale / 2, self._origin // 2

    def _box(self, placed: FloatArray, shape: tuple[int, int]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Return the first (x, y) of the canvas that frames touch, and the one beyond the last."""
        points = transform_points(rescaling(self.scale) @ placed, corners(shape)).reshape(-1, 2)
        return np.floor(points.min(axis=0)).astype(int), np.ceil(points.max(axis=0)).astype(int) + 1


def _upright(placed: FloatArray, shape: tuple[int, int]) -> bool:
    """Return whether frames lie before the plane, and are neither much smaller nor much larger there than the first one."""
    outline = corners(shape)
    if not (np.isfinite(placed).all() and (outline @ placed[:, 2, :2, None] + placed[:, 2, 2, None, None] > 0).all()):
        return False
    x, y = np.moveaxis(transform_points(placed, outline), -1, 0)
    areas = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    change = areas / ((shape[0] - 1) * (shape[1] - 1))
    return bool(((change > 1 / _MOST_AREA_CHANGE) & (change < _MOST_AREA_CHANGE)).all())


def rehearse(plan: Plan, context: Context) -> None:
    """Locate a made-up capture, so that compiling does not delay the first frames; problems are only logged."""
    located, picture = LocatedSoFar(plan, context), PictureSoFar()
    try:
        with _Blocks() as source:
            if window := located.next_window(source, last=True):
                picture.add(window)
        picture.png()
    except PhotonpanoError as error:  # as with frames of another kind; the capture itself tells what is wrong
        logger.debug("the rehearsal failed: %s", error)


class _Blocks(BinarySource):
    """Frames of random blocks, over which the camera pans."""

    def __init__(self) -> None:
        height, width = _SHAPE
        super().__init__(_N_FRAMES, FrameLayout(_SHAPE, (height, width // 8)))
        self._rng = np.random.default_rng(0)
        blocks = self._rng.random((height // _BLOCK_PX, (width + _LENGTH_PX) // _BLOCK_PX))
        self._scene = np.kron(blocks, np.ones((_BLOCK_PX, _BLOCK_PX)))

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span: see `BinarySource`."""
        for frame in range(span.start, span.stop):
            left = frame * _LENGTH_PX // _N_FRAMES
            lit = self._rng.random(_SHAPE) < self._scene[:, left : left + _SHAPE[1]]
            yield slice(frame - span.start, frame - span.start + 1), np.packbits(lit, axis=-1)[None]


PAGE, PICTURE, FIGURES = "live.html", "live.png", "live.json"


class LivePage:
    """Writes the page of a run, each file whole or not at all; it shows `figures`."""

    def __init__(self, folder: Path, run_folder: Path) -> None:
        """Remove the files of an earlier run from `folder`; the report will be in `run_folder`, beside it."""
        self.figures = LiveFigures()
        self._folder, self._run_folder = folder, run_folder
        self._failed = False
        self._remove()

    def write(self, figures: LiveFigures, picture: PictureSoFar | None = None) -> None:
        """Write the page, and the picture if it is given. If the disk is full, a warning says so: the run goes on."""
        self.figures = figures
        try:
            self._write(figures, picture)
        except OutputError as error:
            if not self._failed:
                logger.warning(f"the page of the run is not up to date: {error}")
            self._failed = True

    def _write(self, figures: LiveFigures, picture: PictureSoFar | None) -> None:
        if picture is not None and (png := picture.png()) is not None:
            self._replace(PICTURE, png)
        shown = None
        if (self._folder / PICTURE).exists():
            shown = f"{PICTURE}?{time.time_ns()}"  # another address, so that no browser shows an old picture
        page = render_live(figures, self._run_folder.name, shown, f"../{quote(self._run_folder.name)}/report.html")
        self._replace(PAGE, page.encode())
        self._replace(FIGURES, f"{json.dumps(asdict(figures), indent=2)}\n".encode())

    def end(self, reason: str, n_frames: int) -> None:
        """Say why the run has stopped after a number of frames; without any, there is no page."""
        if n_frames:
            self.write(replace(self.figures, state="stopped", frames=n_frames, message=reason))
        else:
            self._remove()

    def _remove(self) -> None:
        for name in (PAGE, PICTURE, FIGURES):
            (self._folder / name).unlink(missing_ok=True)

    def _replace(self, name: str, content: bytes) -> None:
        with atomic_path(self._folder / name, flushed=False) as temporary:
            temporary.write_bytes(content)
