"""Scores of the motion of a run, of its camera and of its panorama against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonpano.geometry import (
    PROJECTIONS,
    Camera,
    Canvas,
    align_planes,
    align_rotations,
    corner_displacements,
    rotation_vectors,
)
from photonpano.photometry import linear_to_srgb
from photonpano.values import BoolArray, FloatArray, FluxImage, Homography


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryScore:
    """Corner errors of a trajectory after the best alignment of the two planes.

    The error of a frame is the mean, over its four corners, of the distance between the true and the estimated position, in
    pixels of the frame. Statistics are over the located frames.
    """

    errors_px: FloatArray  # (T,) error of every frame, located or not
    located: BoolArray
    alignment: Homography  # (3, 3), pixels of the estimated reference plane to pixels of the true plane
    mean_px: float
    median_px: float
    p95_px: float  # 95 % quantile of the errors
    max_px: float
    located_share: float


def corner_errors(
    estimated: FloatArray,
    true: FloatArray,
    frame_shape: tuple[int, int],
    located: BoolArray | None = None,
    start: Homography | None = None,
) -> TrajectoryScore:
    """Score a trajectory against the true one.

    Convention: Homographies, (T, 3, 3), map pixels of a frame to pixels of a plane; points are (x, y), integers are pixel
    centres.

    Only `located` frames, (T,), are compared, and the planes aligned to them; by default all. Where a camera turns too far for
    one plane, the alignment needs a `start` near it.

    Raises:
        ValueError: the trajectories differ in length, or no frame is located.
    """
    counted = np.ones(len(true), dtype=bool) if located is None else np.asarray(located, dtype=bool)
    if not len(estimated) == len(true) == len(counted):
        raise ValueError(f"{len(estimated)} estimated and {len(true)} true homographies, {len(counted)} flags: give one each")
    alignment = align_planes(estimated[counted], true[counted], frame_shape, start)
    in_frame = np.linalg.inv(true) @ (alignment @ estimated)
    errors = corner_displacements(in_frame, np.eye(3), frame_shape).mean(axis=-1)
    compared = errors[counted]
    return TrajectoryScore(
        errors_px=errors,
        located=counted,
        alignment=alignment,
        mean_px=float(compared.mean()),
        median_px=float(np.median(compared)),
        p95_px=float(np.quantile(compared, 0.95)),
        max_px=float(compared.max()),
        located_share=float(counted.mean()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The motion of a camera that only rotates: (T, 3, 3) rotations from the directions of frames to those of one camera."""

    rotations: FloatArray
    camera: Camera


def of_focal_length(relative_error: float, expected: float | None = None) -> str:
    """Write the error of a focal length in words: "5.20 % too short, where 4.00 % was expected"."""
    percent = 100 * relative_error
    if abs(percent) < 0.005:
        return "right within 0.01 %"
    error = f"{abs(percent):.2f} % too {'long' if percent > 0 else 'short'}"
    return f"{error}, where {100 * expected:.2f} % was expected" if expected else error


@dataclass(frozen=True, slots=True, eq=False)
class RotationScore:
    """Errors of rotations after the best common rotation, and of the focal length.

    Statistics are over the located frames. `errors_deg`, (T,), is the angle between the true and the estimated rotation of
    every frame. `focal_error` is relative, above 0 if the estimate is too long; `focal_std` is the relative error that the run
    expected, 0 of a focal length that was given, None if the run does not say.
    """

    errors_deg: FloatArray
    mean_deg: float
    max_deg: float
    focal_error: float
    focal_std: float | None = None


def rotation_errors(estimated: Turn, true: Turn, located: BoolArray) -> RotationScore:
    """Score the rotations of a run and its camera at the located frames, (T,)."""
    common = align_rotations(estimated.rotations[located], true.rotations[located])
    between = np.swapaxes(true.rotations, -1, -2) @ common @ estimated.rotations
    errors_deg = np.rad2deg(np.linalg.norm(rotation_vectors(between), axis=-1))
    return RotationScore(
        errors_deg=errors_deg,
        mean_deg=float(errors_deg[located].mean()),
        max_deg=float(errors_deg[located].max()),
        focal_error=estimated.camera.focal_px / true.camera.focal_px - 1,
    )


def turned_alignment(estimated: Turn, true: Turn, true_homographies: FloatArray, located: BoolArray) -> FloatArray:
    """Return about which homography maps the reference plane of a run to the true plane: (3, 3), of positive determinant.

    The true homographies are (T, 3, 3), ideal pixels of a frame to the true plane: P R K^-1 with the same P for all frames.
    """
    common = align_rotations(estimated.rotations[located], true.rotations[located])
    to_plane = true_homographies[0] @ true.camera.matrix @ true.rotations[0].T
    return np.asarray(to_plane @ common @ np.linalg.inv(estimated.camera.matrix))


# Quantile of the true scene that is white: the maximum may be a lamp, which would darken everything else.
_WHITE_QUANTILE = 0.999

MIN_COVERAGE = 0.05  # minimum coverage of compared pixels, relative to the median coverage of the seen pixels

_SSIM_SIGMA = 1.5
_SSIM_RADIUS = 5
_ROWS = 256  # rows of the true scene sampled at a time, to bound the memory


@dataclass(frozen=True, slots=True)
class ImageScore:
    """Similarity of an image to the truth, in sRGB from 0 to 1, over the compared pixels."""

    psnr_db: float  # peak signal-to-noise ratio, `-10 log10(mean squared difference)`; infinite for equal images
    # mean structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5 px) over the pixels whose whole window is
    # compared; NaN if there is none
    ssim: float
    compared_share: float  # share of the pixels of the image that are compared


def covered(weight: FluxImage) -> BoolArray:
    """Return which pixels were seen in enough frames to be compared, (H, W): see `MIN_COVERAGE`.

    The weight is the number of frames in which each pixel was seen; of (H, W, 3), the sum over the colours counts.
    """
    weight = weight if weight.ndim == 2 else weight.sum(axis=-1)
    seen = weight > 0
    if not seen.any():
        return seen
    return np.asarray(weight >= MIN_COVERAGE * np.median(weight[seen])) & seen


def known(image: FluxImage) -> BoolArray:
    """Return where an image, (H, W) or (H, W, 3), is finite, in all colours: (H, W)."""
    finite = np.isfinite(image)
    return finite if finite.ndim == 2 else np.asarray(finite.all(axis=-1))


def white_flux(scene: FluxImage) -> float:
    """Return the flux that becomes white in a comparison, of a scene that is NaN where unknown: see `_WHITE_QUANTILE`."""
    return float(np.nanquantile(scene, _WHITE_QUANTILE))


def image_score(panorama: FluxImage, truth: FluxImage, compared: BoolArray, white: float) -> ImageScore:
    """Compare a panorama with the truth on the same pixels: flux, (H, W), or (H, W, 3), of which all colours count alike.

    Pixels of `compared`, (H, W), where either image is not finite in any colour are left out. Flux brighter than `white`, such
    as the `white_flux` of the true scene, is clipped to it.

    Raises:
        ValueError: no pixel is compared, or white is not positive.
    """
    import cv2
    from skimage.metrics import structural_similarity

    if not white > 0:
        raise ValueError(f"white must be a positive flux, got {white}")
    if panorama.ndim == 2:
        panorama, truth = panorama[..., None], truth[..., None]
    compared = compared & known(panorama) & known(truth)
    if not compared.any():
        raise ValueError("no pixel is compared")
    first, second = (np.where(compared[..., None], linear_to_srgb(image / white), np.float32(0)) for image in (panorama, truth))
    squared = np.square(first[compared] - second[compared], dtype=np.float64).mean()
    # Windows that contain pixels that are not compared, or pixels beyond the border of the image, are left out.
    window = np.ones((2 * _SSIM_RADIUS + 1,) * 2, dtype=np.uint8)
    whole = cv2.erode(compared.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)).astype(bool)
    ssim = np.nan
    if whole.any():
        similarity_of: Callable[..., Any] = structural_similarity
        _, similarity = similarity_of(
            first,
            second,
            data_range=1.0,
            gaussian_weights=True,
            sigma=_SSIM_SIGMA,
            use_sample_covariance=False,
            full=True,
            channel_axis=-1,
        )
        ssim = float(similarity[whole].mean(dtype=np.float64))
    with np.errstate(divide="ignore"):
        psnr = float(-10 * np.log10(squared))
    return ImageScore(psnr_db=psnr, ssim=ssim, compared_share=float(compared.mean()))


def true_panorama(scene: FluxImage, canvas: Canvas, alignment: Homography, around: FloatArray | None = None) -> FluxImage:
    """Return the true scene on the canvas of a panorama, interpolated bilinearly; NaN outside of the scene.

    A scene that is finer than the canvas is averaged over the areas of its pixels, rounded to whole pixels of the scene.

    The alignment is (3, 3), pixels of the estimated reference plane to pixels of the true plane. `around` is (3, 3), the matrix
    of the camera to whose pixels the alignment maps, if the scene is an equirectangular panorama, 360 degrees wide, whose
    middle that camera looks at.
    """
    import cv2
    from scipy.ndimage import map_coordinates

    shape = scene.shape
    # The pixels of the scene along the side of a pixel in the middle of the canvas.
    middle = canvas.part((canvas.width - 1) // 2, (canvas.height - 1) // 2, 2, 2)
    (here, right), (below, _) = _scene_points(middle, alignment, around, shape)
    (a, b), (c, d) = right - here, below - here
    area = abs(a * d - b * c)
    side = max(1, round(float(np.sqrt(area)))) if np.isfinite(area) else 1
    margin = side if around is not None else 0
    if margin:  # the scene goes on all around
        scene = np.concatenate([scene[:, -margin:], scene, scene[:, :margin]], axis=1)
    if side > 1:  # averages of squares, whose middles lie beyond their first pixels
        averages = cv2.boxFilter(scene, cv2.CV_32F, (side, side), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
        scene = np.asarray(averages, np.float32)
    offset = (side - 1) / 2
    image = np.empty((*canvas.shape, *shape[2:]), dtype=np.float32)
    for top in range(0, canvas.height, _ROWS):
        part = canvas.part(0, top, min(_ROWS, canvas.height - top), canvas.width)
        x, y = np.moveaxis(_scene_points(part, alignment, around, shape), -1, 0)
        places = [y - offset, x - offset + margin]
        for single, into in zip(_colours(scene), _colours(image), strict=True):
            sampled = map_coordinates(single, places, order=1, mode="constant", cval=np.nan, output=np.float32)
            into[top : top + part.height] = sampled
    return image


def _scene_points(canvas: Canvas, alignment: Homography, around: FloatArray | None, scene_shape: tuple[int, ...]) -> FloatArray:
    """Return the pixels of the scene that the pixels of a canvas show: (H, W, 2); see `true_panorama`."""
    pixels = np.stack(np.meshgrid(np.arange(float(canvas.width)), np.arange(float(canvas.height))), axis=-1)
    on_plane = canvas.on_plane(pixels) @ alignment.T
    if around is None:
        depth = on_plane[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(on_plane[..., :2] / (depth if canvas.planar else np.where(depth > 0, depth, np.nan)))
    height, width = scene_shape[:2]
    angles = PROJECTIONS["spherical"].points(on_plane @ np.linalg.inv(around).T)
    return np.asarray(angles * (width / (2 * np.pi)) + [(width - 1) / 2, (height - 1) / 2])


def _colours(image: FluxImage) -> list[FluxImage]:
    """Return views of the colours of an image; of a grey one, itself."""
    return [image] if image.ndim == 2 else list(np.moveaxis(image, -1, 0))
