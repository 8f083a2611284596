"""Scores of a run folder against the truth of its capture, and differences between runs of one capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.protocols import Trajectory
from photonpano.errors import InputError
from photonpano.evaluation.inputs import RunTrajectory, Truth, load_panorama, load_run_trajectory, load_truth
from photonpano.evaluation.scores import (
    ImageScore,
    RotationScore,
    TrajectoryScore,
    corner_errors,
    covered,
    image_score,
    known,
    of_focal_length,
    rotation_errors,
    true_panorama,
    turned_alignment,
    white_flux,
)
from photonpano.geometry import Camera, Canvas, FrameTrajectory, inverse, rescaling, scaled_ahead
from photonpano.notebooks import facts
from photonpano.photometry import srgb_to_linear, tone_mapped
from photonpano.record.contents import recorded_json, require_one_run
from photonpano.values import FloatArray, FluxImage, Homography, Panorama

# Renders the capture of a run along another motion on a canvas, with the settings of the run.
Render: TypeAlias = "Callable[[Trajectory, Canvas], Panorama]"


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Scores of a run.

    Attributes:
        trajectory: corner errors.
        rotation: errors of the rotations and of the focal length; None if the run, or the truth, knows none.
        honest_share: share of the located frames whose corner error is at most three times the expected one, `std_px`.
        panorama: the panorama against the true scene; None if the truth has no scene.
        oracle: the panorama along the true motion, over the same pixels; None if it was not requested.
        white_flux: flux that is white in the comparison, photons per pixel per frame; None without a scene.
    """

    trajectory: TrajectoryScore
    honest_share: float
    panorama: ImageScore | None = None
    oracle: ImageScore | None = None
    white_flux: float | None = None
    rotation: RotationScore | None = None

    @property
    def below_oracle_db(self) -> float | None:
        """Difference of the PSNR to that of the oracle, in dB: the loss due to errors of the motion."""
        if self.panorama is None or self.oracle is None:
            return None
        return self.oracle.psnr_db - self.panorama.psnr_db

    def rows(self) -> list[tuple[str, str]]:
        """Return the scores with their names, for people."""
        motion, rotation = self.trajectory, self.rotation
        rows = [
            ("corner error, mean", f"{motion.mean_px:.3f} px"),
            ("corner error, median", f"{motion.median_px:.3f} px"),
            ("corner error, 95 %", f"{motion.p95_px:.3f} px"),
            ("corner error, worst frame", f"{motion.max_px:.3f} px"),
            ("frames located", f"{100 * motion.located_share:.1f} %"),
            ("frames within 3 std_px", f"{100 * self.honest_share:.1f} %"),
        ]
        if rotation is not None:
            rows += [
                ("rotation error, mean", f"{rotation.mean_deg:.4f} degrees"),
                ("rotation error, worst", f"{rotation.max_deg:.4f} degrees"),
                ("focal length", of_focal_length(rotation.focal_error, rotation.focal_std)),
            ]
        for name, score in (("panorama", self.panorama), ("oracle", self.oracle)):
            if score is not None:
                rows += [(f"PSNR, {name}", f"{score.psnr_db:.2f} dB"), (f"SSIM, {name}", f"{score.ssim:.4f}")]
        if self.below_oracle_db is not None:
            rows.append(("PSNR below the oracle", f"{self.below_oracle_db:.2f} dB"))
        return rows

    def data(self) -> dict[str, Any]:
        """Return the scores with their names, for programs."""
        motion = self.trajectory
        return {
            "corner_error_px": {name: getattr(motion, f"{name}_px") for name in ("mean", "median", "p95", "max")},
            "located_share": motion.located_share,
            "within_three_std_share": self.honest_share,
            "rotation": _given(self.rotation, "mean_deg", "max_deg", "focal_error", "focal_std"),
            "panorama": _given(self.panorama, "psnr_db", "ssim", "compared_share"),
            "oracle": _given(self.oracle, "psnr_db", "ssim", "compared_share"),
            "below_oracle_db": self.below_oracle_db,
        }

    def figures(self) -> dict[str, Any]:
        """Return what the summary of a batch shows."""
        return {"true_error_px": self.trajectory.mean_px, "psnr_db": None if self.panorama is None else self.panorama.psnr_db}

    def _repr_html_(self) -> str:
        return facts(self.rows())


def _given(score: ImageScore | RotationScore | None, *names: str) -> dict[str, float | None] | None:
    return None if score is None else {name: getattr(score, name) for name in names}


def evaluate(run_folder: Path | str, truth_path: Path | str, render: Render | None = None) -> Evaluation:
    """Score a run against the truth of its capture.

    Args:
        run_folder: folder that `photonpano run` wrote.
        truth_path: the `truth.npz` that `photonpano simulate` stored beside the capture.
        render: renders the oracle, the panorama along the true motion; without it there is no oracle.

    Raises:
        InputError: a file is missing or damaged, or run and truth belong to different captures.
    """
    folder, truth_path = Path(run_folder), Path(truth_path)
    require_one_run(folder, ["trajectory.npz", "panorama.tiff", "coverage.tiff"])
    run = load_run_trajectory(folder)
    truth = load_truth(truth_path)
    frames, true_frames = len(run.homographies), len(truth.homographies)
    if frames != true_frames:
        raise InputError(
            f"{truth_path} is the truth of {true_frames} frames, but the run in {folder} has {frames}; "
            "they belong to different captures"
        )
    if run.frame_shape != truth.frame_shape:
        (height, width), (true_height, true_width) = run.frame_shape, truth.frame_shape
        raise InputError(
            f"{truth_path} is the truth of frames of {true_height}x{true_width}, but the run in {folder} has frames of "
            f"{height}x{width}; they belong to different captures"
        )
    if not run.located.any():
        raise InputError(f"{folder}: the run located no frame, so that it has no score")
    result = score(run, truth, lambda: load_panorama(folder), render, folder)
    if result.rotation is None or run.camera is None:
        return result
    return replace(result, rotation=replace(result.rotation, focal_std=_expected_focal_error(folder, run.camera)))


def _expected_focal_error(folder: Path, camera: Camera) -> float | None:
    """Return the relative error that a run expects of its focal length; None if its run.json does not say."""
    levels = (recorded_json(folder) or {}).get("levels") or [{}]
    std_px = (levels[-1].get("camera") or {}).get("std_focal_px")
    return None if std_px is None else std_px / camera.focal_px


def score(
    run: RunTrajectory,
    truth: Truth,
    panorama: Callable[[], tuple[FluxImage, FluxImage]] | None,
    render: Render | None,
    origin: Path,
) -> Evaluation:
    """Score a motion against the truth of the same capture, and the panorama, of flux and weight, if there is one.

    Raises:
        InputError: panorama and scene cannot be compared; `origin` is named as what was scored.
    """
    motion, rotation = _motion_scores(run, truth)
    honest_share = float((motion.errors_px <= 3 * run.std_px)[run.located].mean())
    evaluation = Evaluation(motion, honest_share, rotation=rotation)
    if truth.scene is None or panorama is None:
        return evaluation
    flux, weight = panorama()
    canvas = run.canvas_of((flux.shape[0], flux.shape[1]))
    true_homographies = truth.homographies if run.camera is None else truth.ideal_homographies
    picture, oracle, white = picture_scores(
        flux,
        weight,
        truth,
        canvas=canvas,
        alignment=motion.alignment,
        true_homographies=true_homographies,
        render=render,
        origin=origin,
    )
    return replace(evaluation, panorama=picture, oracle=oracle, white_flux=white)


def picture_scores(
    flux: FluxImage,
    weight: FluxImage,
    truth: Truth,
    *,
    canvas: Canvas,
    alignment: Homography,
    true_homographies: FloatArray,
    render: Render | None,
    origin: Path,
) -> tuple[ImageScore, ImageScore | None, float]:
    """Score a panorama, and the one that is rendered along the true motion, on the same pixels; and the flux that is white.

    Flux and weight are (H, W) or (H, W, 3). The alignment, (3, 3), maps the plane of the canvas to that of the truth, as the
    true homographies, (T, 3, 3), map pixels of a frame. Raises as `score`.
    """
    assert truth.scene is not None
    white = white_flux(truth.scene)
    if not white > 0:
        raise InputError(f"{truth.path}: the scene is dark, so that the panorama cannot be compared with it")
    if flux.shape[2:] != truth.scene.shape[2:]:
        kinds = ["grey" if image.ndim == 2 else "in colour" for image in (flux, truth.scene)]
        raise InputError(f"{origin}: the panorama is {kinds[0]}, and the true scene of {truth.path} is {kinds[1]}")
    around = truth.turn.camera.matrix if truth.around and truth.turn is not None else None
    true_image = true_panorama(truth.scene, canvas, alignment, around)
    compared = covered(weight) & known(true_image) & known(flux)
    oracle = None
    if render is not None:
        oracle = render(FrameTrajectory(scaled_ahead(inverse(alignment) @ true_homographies)), canvas)
        compared &= covered(oracle.weight)
    if not compared.any():
        raise InputError(f"{origin}: the panorama and the true scene have no pixel in common")
    of_oracle = None if oracle is None else image_score(oracle.flux, true_image, compared, white)
    return image_score(flux, true_image, compared, white), of_oracle, white


def _motion_scores(run: RunTrajectory, truth: Truth) -> tuple[TrajectoryScore, RotationScore | None]:
    shape, located, found, estimated = run.frame_shape, run.located, run.turn, run.corner_homographies
    if found is not None and truth.turn is not None:
        start = turned_alignment(found, truth.turn, truth.ideal_homographies, located)
        motion = corner_errors(estimated, truth.homographies, shape, located, start)
        return motion, rotation_errors(found, truth.turn, located)
    if not truth.around:
        return corner_errors(estimated, truth.homographies, shape, located), None
    # No plane before the camera holds a whole turn, but that of a located frame holds what the run located in a plane.
    places = np.flatnonzero(located)
    plane = truth.homographies[places[len(places) // 2]]
    motion = corner_errors(estimated, scaled_ahead(np.linalg.inv(plane) @ truth.homographies), shape, located)
    return replace(motion, alignment=plane @ motion.alignment), None


_MOST_PX = 32_766  # OpenCV warps no larger pictures
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
    if (factor := _MOST_PX / max(picture.shape[:2])) < 1:
        picture = np.asarray(cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)
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
