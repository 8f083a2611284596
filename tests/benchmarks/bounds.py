"""Cramer-Rao bounds on the error of image registration from photons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry import corners, jacobian
from photonpano.values import FluxImage, Homography, Response

_NOISELESS = 1e9  # number of frames for which photon noise is negligible


def pair_bound_px(flux: FluxImage, response: Response, first_frames: ArrayLike, second_frames: ArrayLike) -> float:
    """Return the Cramer-Rao bound of registration of two exposures of an unknown scene.

    On the scale on which noise is uniform, the difference of the exposures is Gaussian noise of known variance in each pixel.
    So the information on the eight parameters of a homography is the sum over pixels of

        (gradient . motion)^T (gradient . motion) / (variance of the first + variance of the second)

    Args:
        flux: (H, W) true flux in one of the exposures, photons per pixel per frame.
        response: the camera's response.
        first_frames: number of frames in which the first exposure saw a pixel: one for all, or (H, W).
        second_frames: the same for the second exposure, on the grid of the first.

    Returns:
        Root mean square error of a corner of the frame, in px: no unbiased estimate has a smaller one.
    """
    return _corner_std_px(flux, response, _variance(first_frames, response) + _variance(second_frames, response))


def exposure_bound_px(flux: FluxImage, response: Response, frames: ArrayLike) -> float:
    """Return the Cramer-Rao bound of registration of one exposure with a known scene, in px: see `pair_bound_px`."""
    return _corner_std_px(flux, response, _variance(frames, response))


def _variance(frames: ArrayLike, response: Response) -> np.ndarray:
    frames = np.asarray(frames, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(response.stabilised_std(frames), dtype=np.float64) ** 2


def _corner_std_px(flux: FluxImage, response: Response, variance: np.ndarray) -> float:
    gradient_y, gradient_x = np.gradient(np.asarray(response.stabilised(flux, _NOISELESS), dtype=np.float64))
    height, width = flux.shape
    y, x = np.mgrid[:height, :width]
    identity: Homography = np.eye(3)
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    # Parametrised by the corners, so that all eight unknowns are in px.
    of_corners = jacobian(identity, pixels) @ np.linalg.inv(jacobian(identity, corners(flux.shape)).reshape(8, 8))
    derivatives = gradient_x.ravel()[:, None] * of_corners[:, 0] + gradient_y.ravel()[:, None] * of_corners[:, 1]
    information = (derivatives / np.broadcast_to(variance, flux.shape).reshape(-1, 1)).T @ derivatives
    return float(np.sqrt(np.trace(np.linalg.inv(information)) / 4))
