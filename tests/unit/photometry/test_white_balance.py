"""Factors of red, green and blue in pictures."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.photometry import balanced


def test_grey_world_makes_the_mean_grey_and_keeps_green() -> None:
    flux = np.random.default_rng(0).uniform(0, [0.2, 1.0, 0.5], (20, 30, 3)).astype(np.float32)
    flux[3] = np.nan
    means = np.nanmean(balanced(flux, "grey-world"), axis=(0, 1))
    assert means == pytest.approx(np.full(3, np.nanmean(flux[..., 1])), rel=1e-5)


def test_factors_multiply_colours_and_leave_grey_images_alone() -> None:
    flux = np.ones((2, 3, 3), np.float32)
    assert balanced(flux, (2, 1, 0.5))[0, 0].tolist() == [2, 1, 0.5]
    assert balanced(flux, "none") is flux
    grey = flux[..., 0]
    assert balanced(grey, (2, 1, 0.5)) is grey
