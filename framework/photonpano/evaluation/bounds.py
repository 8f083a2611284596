"""Cramer-Rao bounds: how well photons allow to locate an image at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry import corners, jacobian
from photonpano.values import FluxImage, Homography, Response

_NOISELESS = 1e9
"""Frames after which photons are as good as the scene itself."""


def pair_bound_px(flux: FluxImage, response: Response, first_frames: ArrayLike, second_frames: ArrayLike) -> float:
    """Return the least expected error of any unbiased registration of two exposures of one scene that nobody knows.

    On the scale on which noise is uniform the two differ by Gaussian noise of known variance, pixel by pixel, so that the
    information on the eight parameters of a homography is the sum over pixels of

        (gradient . motion)^T (gradient . motion) / (variance of the first + variance of the second)

    Args:
        flux: (H, W) the true flux as one of them sees it, in photons per pixel per frame.
        response: the camera's response.
        first_frames: in how many frames the first exposure saw each pixel: a number, or (H, W); 0 where it did not.
        second_frames: the same for the second exposure, seen from the first.

    Returns:
        The root mean square distance of a corner of the frame from where it should be, in px.
    """
    return _corner_std_px(flux, response, _variance(first_frames, response) + _variance(second_frames, response))


def exposure_bound_px(flux: FluxImage, response: Response, frames: ArrayLike) -> float:
    """Return the same for one exposure of a scene that is known without noise: what no locator can exceed.

    Args:
        flux: (H, W) the true flux as the exposure sees it, in photons per pixel per frame.
        response: the camera's response.
        frames: in how many frames the exposure saw each pixel: a number, or (H, W); 0 where it did not.
    """
    return _corner_std_px(flux, response, _variance(frames, response))


def _variance(frames: ArrayLike, response: Response) -> np.ndarray:
    frames = np.asarray(frames, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(response.stabilised_std(frames), dtype=np.float64) ** 2


def _corner_std_px(flux: FluxImage, response: Response, variance: np.ndarray) -> float:
    along_y, along_x = np.gradient(np.asarray(response.stabilised(flux, _NOISELESS), dtype=np.float64))
    height, width = flux.shape
    y, x = np.mgrid[:height, :width]
    still: Homography = np.eye(3)
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    # In terms of the corners, so that all eight unknowns are pixels.
    of_corners = jacobian(still, pixels) @ np.linalg.inv(jacobian(still, corners(flux.shape)).reshape(8, 8))
    slopes = along_x.ravel()[:, None] * of_corners[:, 0] + along_y.ravel()[:, None] * of_corners[:, 1]
    information = (slopes / np.broadcast_to(variance, flux.shape).reshape(-1, 1)).T @ slopes
    return float(np.sqrt(np.trace(np.linalg.inv(information)) / 4))
