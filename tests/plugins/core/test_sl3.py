from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from photonpano_core.interpolators import exponential, logarithm, unimodular

# Typical sizes of the entries of a matrix that maps pixels of an image of 300 px.
PIXELS = np.array([[1, 1, 300], [1, 1, 300], [1 / 300, 1 / 300, 1]])


def matrices(size: float) -> np.ndarray:
    """Random matrices of trace 0, in units of an image's size."""
    drawn = np.random.default_rng(0).normal(size=(100, 3, 3)) * size
    return drawn - np.trace(drawn, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3


@pytest.mark.parametrize("size", [0, 1e-9, 1e-3, 0.1, 1, 5])
def test_exponential_equals_scipy_expm(size):
    small = matrices(size)
    found, expected = exponential(small * PIXELS) / PIXELS, expm(small)
    error = np.abs(found - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    assert error.max() < 1e-11


@pytest.mark.parametrize("size", [0, 1e-9, 1e-3, 0.1, 0.5])
def test_logarithm_inverts_exponential(size):
    small = matrices(size)
    inside = np.abs(np.linalg.eigvals(small)).max(axis=1) < 3
    found = logarithm(unimodular(7 * exponential(small[inside] * PIXELS))) / PIXELS
    assert inside.mean() > 0.9
    np.testing.assert_allclose(found, small[inside], rtol=0, atol=1e-12)


@pytest.mark.parametrize("diagonal", [(-1, -1, 1), (-1, 1, 1), (-2, -0.5, 1), (1e-4, 1, 1)])
def test_logarithm_is_nan_only_where_none_is_real_or_small(diagonal):
    stack = unimodular(np.stack([np.diag(np.array(diagonal, dtype=float)), np.eye(3)]))
    found = logarithm(stack)
    assert np.isnan(found[0]).all()
    np.testing.assert_array_equal(found[1], 0)
