"""Find patches of one exposure in others, where depth and poses predict them (Lucas and Kanade 1981)."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano.geometry import Camera
from photonpano.locating import view_of
from photonpano_colmap.posing.lens import Lens, imaged, lens_of
from photonpano_colmap.posing.merging import Image, PosedExposure
from photonpano_colmap.posing.path import between

_BLUR_PX = 1.0  # standard deviation of the blur against photon noise
_HALF = 9  # patches have 19 x 19 pixels, with Gaussian weights
_BORDER = _HALF + 3
# Corners are at least 9 px apart, with at least this fraction of the strongest corner's curvature.
_APART_PX = 9
_QUALITY = 0.002
_STEPS = 15
_CONVERGED_PX = 0.01
_LARGEST_STEP_PX = 2.0
_LARGEST_SHIFT_PX = 8.0  # radius of the search around the predicted position
_LARGEST_CHI_SQUARE = 2.0  # maximum reduced chi-square of a patch
_LARGEST_STD_PX = 1.0  # maximum standard error of the position of a patch
_SLOPE_PX = 3.0  # standard deviation of the blur before slopes of the inverse depth are computed


class Stabilised(NamedTuple):
    """An exposure as an image of uniform noise."""

    image: Image  # (H, W), blurred; NaN where it is unknown
    noise: float  # variance of a pixel before the blur
    noise_left: float  # share of this variance that the blur leaves


class Patches(NamedTuple):
    """Patches of an exposure."""

    pixels: FloatArray  # (N, 2) their middles, px
    inverse_depth: FloatArray  # (N, 3) that of their middles, and its slopes along x and y per px


class Found(NamedTuple):
    """Where some patches are in another exposure."""

    patches: NDArray[np.intp]  # (M,) their numbers
    pixels: FloatArray  # (M, 2) px, ideal ones
    covariance: FloatArray  # (M, 2, 2) px^2, as photon noise has it


def stabilised(posed: PosedExposure) -> Stabilised:
    """Return an exposure as an image of uniform noise."""
    view = view_of(posed.exposure, _BLUR_PX)
    noise = float(np.median(1 / view.weight[view.seen])) if view.seen.any() else 1.0
    return Stabilised(np.where(view.seen, view.image, np.float32(np.nan)), noise, view.noise_left)


def patches_of(posed: PosedExposure, view: Stabilised, most: int) -> Patches:
    """Choose patches with structure along both axes, the strongest first (Shi and Tomasi 1994)."""
    known = np.isfinite(view.image)
    if not known.any():
        return Patches(np.zeros((0, 2)), np.zeros((0, 3)))
    filled = np.where(known, view.image, np.float32(np.median(view.image[known])))
    mask = cv2.erode(known.astype(np.uint8), np.ones((2 * _BORDER + 1, 2 * _BORDER + 1), np.uint8), borderValue=0)
    found = cv2.goodFeaturesToTrack(filled, most, _QUALITY, _APART_PX, mask=mask, blockSize=_HALF)
    if found is None:
        return Patches(np.zeros((0, 2)), np.zeros((0, 3)))
    pixels = found[:, 0].astype(np.float64)
    smooth = cv2.GaussianBlur(posed.inverse_depth, (0, 0), _SLOPE_PX)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=3, scale=1 / 8) for axes in ((1, 0), (0, 1))]
    columns, rows = np.rint(pixels.T).astype(int)
    at = np.stack([each[rows, columns] for each in (posed.inverse_depth, *slopes)], axis=1)
    return Patches(pixels, at.astype(np.float64))


def find_patches(
    patches: Patches, here: tuple[PosedExposure, Stabilised], there: tuple[PosedExposure, Stabilised], camera: Camera
) -> Found:
    """Find the patches of an exposure, `here`, in another one, `there`.

    The noise of the patch itself shifts it alike in all other exposures, and with it the point of the scene that it stands for.
    """
    (posed, view), (other, image) = here, there
    turn, shift = between(posed.pose, other.pose, camera.matrix)
    number = len(patches.pixels)
    pixels, hessian, chi_square = np.full((number, 2), np.nan), np.zeros((number, 2, 2)), np.full(number, np.inf)
    noise = view.noise + image.noise
    # Central differences of noise, which the blur has correlated.
    gradient_noise = 0.5 * (1 - np.exp(-1 / _BLUR_PX**2)) * image.noise * image.noise_left
    lens, middles, depth = lens_of(camera, posed.inverse_depth.shape), patches.pixels, patches.inverse_depth
    _find(view.image, image.image, middles, depth, lens, turn, shift, gradient_noise, pixels, hessian, chi_square)
    chi_square /= noise * view.noise_left
    determinant = np.linalg.det(hessian)
    kept = np.isfinite(pixels[:, 0]) & (chi_square < _LARGEST_CHI_SQUARE) & (determinant > 0) & (hessian[:, 0, 0] > 0)
    found = np.flatnonzero(kept)
    covariance = noise * np.linalg.inv(hessian[found])
    ideal = camera.ideal(pixels[found])
    by_pixel = np.stack([camera.ideal_shift(ideal, np.broadcast_to(axis, ideal.shape)) for axis in np.eye(2)], axis=2)
    certain = (np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]) < _LARGEST_STD_PX**2) & np.isfinite(ideal[:, 0])
    covariance = by_pixel @ covariance @ np.swapaxes(by_pixel, 1, 2)
    return Found(found[certain], ideal[certain], covariance[certain])


@compiled
def _find(
    template: Image,
    image: Image,
    middles: FloatArray,
    inverse_depth: FloatArray,
    lens: Lens,
    turn: FloatArray,
    shift: FloatArray,
    gradient_noise: float,
    pixels: FloatArray,
    hessian: FloatArray,
    chi_square: FloatArray,
) -> None:
    """Find patches of a template, (H, W), in an image by Gauss-Newton steps; those that are lost stay NaN.

    `middles` are (N, 2) px, whole numbers; `turn` and `shift` are from `path.between`; `gradient_noise` is the variance of a
    gradient by noise. Writes the middles in the image, (N, 2), the weighted sums of products of gradients of the scene,
    (N, 2, 2), and the weighted mean square of the residuals less their mean, (N,).
    """
    size = (2 * _HALF + 1) ** 2
    values, us, vs, weights = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    along_x, along_y, residuals = np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(middles)):
        x, y = middles[k, 0], middles[k, 1]
        q, q_x, q_y = inverse_depth[k, 0], inverse_depth[k, 1], inverse_depth[k, 2]
        n, weight, known = 0, 0.0, True
        for j in range(-_HALF, _HALF + 1):
            for i in range(-_HALF, _HALF + 1):
                q_there = q + q_x * i + q_y * j
                ideal = lens.ideal[int(y) + j, int(x) + i]
                depth = turn[2, 0] * ideal[0] + turn[2, 1] * ideal[1] + turn[2, 2] + q_there * shift[2]
                values[n] = _sample(template, x + i, y + j)
                known = known and depth > 0 and np.isfinite(values[n])
                u = (turn[0, 0] * ideal[0] + turn[0, 1] * ideal[1] + turn[0, 2] + q_there * shift[0]) / depth
                v = (turn[1, 0] * ideal[0] + turn[1, 1] * ideal[1] + turn[1, 2] + q_there * shift[1]) / depth
                us[n], vs[n] = imaged(lens, u, v)
                weights[n] = np.exp(-(i * i + j * j) / (2 * (0.6 * _HALF) ** 2))
                weight += weights[n]
                n += 1
        if not known:
            continue
        u, v = 0.0, 0.0
        for _ in range(_STEPS):
            mean = 0.0
            for t in range(size):
                at_u, at_v = us[t] + u, vs[t] + v
                along_x[t] = 0.5 * (_sample(image, at_u + 1, at_v) - _sample(image, at_u - 1, at_v))
                along_y[t] = 0.5 * (_sample(image, at_u, at_v + 1) - _sample(image, at_u, at_v - 1))
                residuals[t] = _sample(image, at_u, at_v) - values[t]
                mean += weights[t] * residuals[t]
            mean /= weight
            xx, xy, yy, gx, gy, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for t in range(size):
                residual = residuals[t] - mean
                xx += weights[t] * along_x[t] * along_x[t]
                xy += weights[t] * along_x[t] * along_y[t]
                yy += weights[t] * along_y[t] * along_y[t]
                gx += weights[t] * along_x[t] * residual
                gy += weights[t] * along_y[t] * residual
                squares += weights[t] * residual * residual
            determinant = xx * yy - xy * xy
            if not determinant > 0:
                break
            step_u, step_v = (xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant
            length = np.sqrt(step_u * step_u + step_v * step_v)
            shorter = min(1.0, _LARGEST_STEP_PX / max(length, 1e-12))
            u += shorter * step_u
            v += shorter * step_v
            if not u * u + v * v < _LARGEST_SHIFT_PX**2:
                break
            if length < _CONVERGED_PX:
                middle = size // 2
                pixels[k, 0], pixels[k, 1] = us[middle] + u, vs[middle] + v
                hessian[k, 0, 0], hessian[k, 1, 1] = xx - weight * gradient_noise, yy - weight * gradient_noise
                hessian[k, 0, 1] = hessian[k, 1, 0] = xy
                chi_square[k] = squares / weight
                break


@compiled
def _sample(image: Image, x: float, y: float) -> float:
    """Return an image at a place, interpolated bilinearly; NaN outside."""
    height, width = image.shape
    if not (0 <= x < width - 1 and 0 <= y < height - 1):
        return np.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    upper = (1 - a) * image[j, i] + a * image[j, i + 1]
    return float((1 - b) * upper + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]))
