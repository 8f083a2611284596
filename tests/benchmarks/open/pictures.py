"""Register a panorama of any program with the true scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.evaluation.inputs import Truth
from photonpano.evaluation.scores import true_panorama, white_flux
from photonpano.geometry import Canvas, corners, transform_points, translation
from photonpano.photometry import linear_to_srgb, srgb_to_linear
from photonpano.reading import read_picture
from photonpano.values import BoolArray, FluxImage, Homography

PICTURES = (".png", ".tiff", ".tif", ".jpg", ".jpeg")
_RATIO = 0.8  # of the distances to the best and second match (Lowe 2004)
_INLIER_PX = 3.0
_MARGIN, _STEPS = 8, 100  # px of the scene around the picture, and iterations, of the registration by all pixels
_FEWEST = 12  # matches that agree on one homography
_LEAST = 0.6  # correlation of picture and scene: poor panoramas have 0.7


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredPicture:
    """A panorama in photons per pixel per frame, and where it lies in the true scene."""

    flux: FluxImage  # (H, W) or (H, W, 3), as bright as the scene
    weight: FluxImage  # the same shape, 1 where the picture shows something
    canvas: Canvas  # whose plane is that of the picture
    alignment: Homography  # pixels of the picture to pixels of the scene
    mirrored: bool
    correlation: float  # with the scene: of those of photonpano, 0.96 or more


def register_picture(path: Path, truth: Truth) -> RegisteredPicture:
    """Find where a panorama lies in the true scene, by features and then by all pixels, and scale it to its brightness.

    Values of 8 or 16 bits are taken to be sRGB, and floating-point values to be linear. Pixels that are 0, transparent or not
    finite show nothing.

    Raises:
        InputError: the file is no picture, the scene surrounds the camera, or the two have too little in common.
    """
    import cv2

    if truth.scene is None or truth.around:
        raise InputError(f"{path}: a panorama of a scene all around the camera is not registered; give the motion as well")
    found = np.atleast_3d(read_picture(path, "is not a picture; save it as PNG or TIFF", cv2.IMREAD_UNCHANGED))
    shown = np.isfinite(found).all(axis=-1) & (found[..., :3] > 0).any(axis=-1)
    if found.shape[2] == 4:
        shown &= found[..., 3] > 0
    values = np.where(shown[..., None], found[..., :3], 0).astype(np.float32)
    if found.dtype.kind == "u":
        values = srgb_to_linear(values / np.iinfo(found.dtype).max)
    in_colour = truth.scene.ndim == 3
    flux = np.ascontiguousarray(values[..., ::-1] if values.shape[2] == 3 else np.repeat(values, 3, axis=2))
    if not in_colour:
        flux = flux.mean(axis=-1)
    if not shown.any():
        raise InputError(f"{path}: the picture is black")
    for mirrored in (False, True):
        image = flux[:, ::-1] if mirrored else flux
        seen = shown[:, ::-1] if mirrored else shown
        if (found_at := alignment_of(image, seen, truth.scene)) is not None:
            break
    else:
        raise InputError(
            f"{path}: no homography maps the picture, as it is or mirrored, to the true scene so that they are alike; give the "
            "motion, or a panorama on a plane whose pixels are as large as those of frames"
        )
    alignment, correlation = found_at
    canvas = Canvas(image.shape[0], image.shape[1], np.eye(3))
    true_image = true_panorama(truth.scene, canvas, alignment)
    both = seen & np.isfinite(true_image.reshape(*seen.shape, -1)).all(axis=-1)
    # One gain for all colours: least squares, of what is not beyond white.
    capped = np.minimum(true_image, white_flux(truth.scene))[both]
    gain = float((image[both] * capped).sum() / np.square(image[both], dtype=np.float64).sum())
    weight = np.broadcast_to(seen.astype(np.float32).reshape(*seen.shape, *(1,) * (image.ndim - 2)), image.shape)
    return RegisteredPicture(np.asarray(gain * image, np.float32), np.array(weight), canvas, alignment, mirrored, correlation)


def _grey(flux: FluxImage, white: float) -> NDArray[np.uint8]:
    mean = flux if flux.ndim == 2 else flux.mean(axis=-1)
    return np.asarray(np.rint(255 * linear_to_srgb(np.nan_to_num(mean) / np.float32(white))), np.uint8)


def alignment_of(flux: FluxImage, seen: BoolArray, true: FluxImage) -> tuple[Homography, float] | None:
    """Return the map from pixels of a picture to those of the true scene, of grey levels or colours, and their correlation.

    None if too few features agree, or the images do not. The picture shows something where it is `seen`, (H, W).
    """
    import cv2 as opencv

    cv2: Any = opencv  # whose types ask for more than it does
    picture, scene = _grey(flux, float(np.quantile(flux[seen], 0.99))), _grey(true, white_flux(true))
    sift = cv2.SIFT.create()
    mask = seen.astype(np.uint8)
    (points, words), (scene_points, scene_words) = sift.detectAndCompute(picture, mask), sift.detectAndCompute(scene, None)
    if words is None or scene_words is None or min(len(words), len(scene_words)) < _FEWEST:
        return None
    pairs = cv2.BFMatcher().knnMatch(words, scene_words, k=2)
    matches = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    if len(matches) < _FEWEST:
        return None
    here = np.array([points[each.queryIdx].pt for each in matches], np.float32)
    there = np.array([scene_points[each.trainIdx].pt for each in matches], np.float32)
    alignment, inliers = cv2.findHomography(here, there, cv2.RANSAC, _INLIER_PX)
    if alignment is None or inliers.sum() < _FEWEST:
        return None
    # To a fraction of a pixel, by all pixels of the part of the scene that the picture shows.
    outline = transform_points(alignment, corners((picture.shape[0], picture.shape[1])))
    left, top = np.clip(np.floor(outline.min(axis=0)) - _MARGIN, 0, None).astype(int)
    right, bottom = np.ceil(outline.max(axis=0)).astype(int) + _MARGIN
    part, to_part = scene[top:bottom, left:right], translation(-left, -top)
    try:
        ending = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _STEPS, 1e-7)
        start = np.linalg.inv(to_part @ alignment).astype(np.float32)
        correlation, refined = cv2.findTransformECC(part, picture, start, cv2.MOTION_HOMOGRAPHY, ending, mask, 5)
    except cv2.error:  # it does not converge
        return None
    found = np.linalg.inv(to_part) @ np.linalg.inv(np.asarray(refined, np.float64))
    return (found, float(correlation)) if correlation > _LEAST else None
