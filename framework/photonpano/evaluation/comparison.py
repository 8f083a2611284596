"""Compare runs of one capture: the difference of their motions, and their panoramas on one canvas."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.evaluation.inputs import RunTrajectory
from photonpano.evaluation.trajectory import corner_errors, turned_alignment
from photonpano.geometry import Canvas, inverse, rescaling
from photonpano.photometry import srgb_to_linear, tone_mapped
from photonpano.values import FloatArray, Homography

_ROUNDING_PX = 1e-6  # smaller differences are rounding errors: equal motions differ by 1e-14 px


@dataclass(frozen=True, slots=True, eq=False)
class MotionDifference:
    """How far a motion is from another one of the same frames."""

    # (T,) mean distance of the corners of a frame, in px of a frame; 0 for the same motion, NaN where either has not located it
    corners_px: FloatArray
    alignment: Homography  # (3, 3), pixels of the reference plane to pixels of that of the other motion


def motion_difference(run: RunTrajectory, other: RunTrajectory) -> MotionDifference | None:
    """Compare two motions of the same frames after the best alignment of their planes; None if no frame is located in both."""
    both = run.located & other.located
    if not both.any():
        return None
    start = None
    if run.turn is not None and other.turn is not None:
        start = turned_alignment(run.turn, other.turn, other.homographies, both)
    score = corner_errors(run.homographies, other.homographies, run.frame_shape, both, start)
    errors = np.where(score.errors_px < _ROUNDING_PX, 0.0, score.errors_px)
    return MotionDifference(np.where(both, errors, np.nan), score.alignment)


def on_canvas(
    picture: NDArray[np.uint8], canvas: Canvas, alignment: Homography, common: Canvas, whites: tuple[float, float] | None
) -> NDArray[np.uint8]:
    """Return a panorama's picture, (h, w) or (h, w, 3), on the `common` canvas.

    The picture may be smaller than its canvas. The alignment is (3, 3), pixels of its reference plane to pixels of that of the
    common canvas. `whites` are the flux that is white in the picture, and in the result; None keeps the levels.
    """
    pixels = np.stack(np.meshgrid(np.arange(float(common.width)), np.arange(float(common.height))), axis=-1)
    places = canvas.pixels(common.on_plane(pixels) @ (canvas.plane_to_rays @ inverse(alignment)).T).astype(np.float32)
    reduction = np.array([canvas.width / picture.shape[1], canvas.height / picture.shape[0]], np.float32)
    x, y = np.moveaxis((places + 0.5) / reduction - 0.5, -1, 0)
    moved = cv2.remap(picture, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    if whites is None:
        return np.asarray(moved, np.uint8)
    return tone_mapped(srgb_to_linear(np.asarray(moved, np.float32) / 255) * np.float32(whites[0]), whites[1])


def reduced(canvas: Canvas, longest: int) -> Canvas:
    """Return a canvas whose longer side has at most this many pixels."""
    factor = max(1.0, max(canvas.shape) / longest)
    height, width = (max(1, round(side / factor)) for side in canvas.shape)
    return replace(canvas, height=height, width=width, transform=rescaling(1 / factor) @ canvas.transform)
