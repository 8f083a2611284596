from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import apply, inverse, rescaling, translation

pytest.importorskip("torch")
pytest.importorskip("kornia")

import kornia
import torch

from photonpano_kornia.configs import KorniaRegistratorConfig
from photonpano_kornia.registrator import RegistratorLocator, unit_square

STILL = np.eye(3)


def locator(**config: object) -> RegistratorLocator:
    return RegistratorLocator(KorniaRegistratorConfig.model_validate(config))


def test_unit_square_matches_pixel_centres_of_kornia_warper() -> None:
    """Warping an image of coordinates by a homography gives the mapped coordinates."""
    height, width = 20, 30
    homography = translation(2.25, 1.5) @ np.diag([0.8, 0.7, 1]) + np.array([[0, 0.02, 0], [0.01, 0, 0], [1e-4, 2e-4, 0]])
    y, x = np.mgrid[:height, :width].astype(float)
    unit = unit_square((height, width))
    warper = kornia.geometry.HomographyWarper(height, width, align_corners=False)
    coordinates = torch.tensor(np.stack([x, y])[None], dtype=torch.float64)
    to_image = torch.tensor(unit @ homography @ inverse(unit))[None]
    seen = warper(coordinates, to_image)[0].numpy().reshape(2, -1).T
    np.testing.assert_allclose(seen, apply(homography, np.stack([x.ravel(), y.ravel()], axis=1)), atol=1e-4)


def test_unit_square_keeps_edges_of_halved_image() -> None:
    """So all layers of a pyramid have the same coordinates in kornia."""
    halved = unit_square((40, 60)) @ rescaling(0.5) @ inverse(unit_square((80, 120)))
    np.testing.assert_allclose(halved, STILL, atol=1e-12)


def test_pyramid_is_finest_first_and_ends_above_smallest_side(shot: Callable) -> None:
    views = locator().describe(shot(STILL))
    assert [view.shape for view in views] == [(120, 176), (60, 88), (30, 44)]
    assert len(locator(pyramid_levels=1).describe(shot(STILL))) == 1
