from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("kornia")

from photonpano_kornia.configs import KorniaFeaturesConfig
from photonpano_kornia.matched import FeatureLocator

SHAPE = (120, 176)
STILL = np.eye(3)


def locator(**config: object) -> FeatureLocator:
    return FeatureLocator(KorniaFeaturesConfig.model_validate(config), seed=0)


@pytest.mark.parametrize("sigma_px", [2.5, 7.0])
def test_keypoints_lie_at_centres_of_blobs(photograph: Callable, sigma_px: float) -> None:
    """To less than half a pixel, also in octaves of kornia's pyramid that are finer and coarser than the image."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    middle = np.array([83.25, 61.75])
    blob = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * sigma_px**2))
    found = locator(max_keypoints=16).describe(photograph(0.2 + 2 * blob, 0))
    strongest = found.points[np.argmin(np.linalg.norm(found.points - middle, axis=1))]
    np.testing.assert_allclose(strongest, middle, atol=0.15)


def test_describe_keeps_at_most_max_keypoints_and_no_padding(shot: Callable, photograph: Callable) -> None:
    every, best = locator().describe(shot(STILL)), locator(max_keypoints=50).describe(shot(STILL))
    assert 200 < len(every.points) < 2000
    assert len(best.points) == len(best.sizes) == len(best.descriptors) == 50
    assert best.sizes.min() > 1
    assert best.shape == SHAPE
