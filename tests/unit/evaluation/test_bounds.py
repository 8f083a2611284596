from __future__ import annotations

import numpy as np
import pytest

from photonpano.evaluation import exposure_bound_px, pair_bound_px
from photonpano.geometry import apply, corners, from_parameters
from photonpano.photometry import BinaryResponse

RESPONSE = BinaryResponse()
SHAPE = (40, 60)


def waves(points: np.ndarray) -> np.ndarray:
    """A smooth scene, defined everywhere."""
    x, y = points[..., 0], points[..., 1]
    return 0.3 + 0.1 * np.sin(x / 3 + 0.2) * np.cos(y / 4) + 0.05 * np.sin((x + y) / 5)


FLUX = waves(np.stack(np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0])), axis=-1)).astype(np.float32)


def test_exposure_bound_falls_with_number_of_frames() -> None:
    assert exposure_bound_px(FLUX, RESPONSE, 400) == pytest.approx(exposure_bound_px(FLUX, RESPONSE, 100) / 2, rel=1e-6)


def test_pair_bound_adds_noise_of_second_exposure() -> None:
    alone = exposure_bound_px(FLUX, RESPONSE, 100)
    assert pair_bound_px(FLUX, RESPONSE, 100, 100) == pytest.approx(np.sqrt(2) * alone, rel=1e-6)
    assert pair_bound_px(FLUX, RESPONSE, 100, 1e9) == pytest.approx(alone, rel=1e-4)


def test_pair_bound_ignores_pixels_that_one_exposure_did_not_see() -> None:
    left = np.where(np.arange(SHAPE[1]) < 30, 100.0, 0.0)
    half = exposure_bound_px(FLUX, RESPONSE, np.broadcast_to(left, SHAPE))
    assert pair_bound_px(FLUX, RESPONSE, np.broadcast_to(left, SHAPE), 1e9) == pytest.approx(half, rel=1e-4)
    assert half > 2 * exposure_bound_px(FLUX, RESPONSE, 100)


def test_maximum_likelihood_reaches_exposure_bound() -> None:
    """Linearised at the truth; the standard deviation of 400 draws has an error of a few per cent."""
    frames, rng, steps = 2000, np.random.default_rng(0), 1e-4
    p = -np.expm1(-FLUX.astype(float))
    points = np.stack(np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0])), axis=-1).reshape(-1, 2)
    units = np.array([1 / 30, 1 / 30, 1 / 30, 1 / 30, 1, 1, 1 / 900, 1 / 900])
    derivatives = np.stack(
        [(-np.expm1(-waves(apply(from_parameters(steps * unit), points))) - p.ravel()) / steps for unit in np.diag(units)],
        axis=-1,
    )
    weights = frames / (p * (1 - p)).ravel()
    counts = rng.binomial(frames, p, (400, *SHAPE)).reshape(400, -1) / frames
    scores = ((counts - p.ravel()) * weights) @ derivatives
    found = np.linalg.solve((derivatives.T * weights) @ derivatives, scores.T).T * units
    errors = apply(from_parameters(found), corners(SHAPE)) - corners(SHAPE)
    scatter = np.sqrt((errors**2).sum(axis=-1).mean())
    assert exposure_bound_px(FLUX, RESPONSE, frames) == pytest.approx(scatter, rel=0.1)
