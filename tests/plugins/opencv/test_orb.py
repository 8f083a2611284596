from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from photonpano import Located
from photonpano.geometry import corner_displacements, translation
from photonpano_opencv.configs import OpencvOrbConfig
from photonpano_opencv.keypoints import Keypoints, OrbLocator

SHAPE = (160, 240)


def described(exposure: object, **config: object) -> Keypoints:
    return OrbLocator(OpencvOrbConfig.model_validate(config), seed=0).describe(exposure)


def test_keypoints_of_coarse_levels_are_not_off_by_half_a_pixel(seen_from: Callable) -> None:
    """The keypoints of an exposure turned by 180 degrees are those of the exposure, turned."""
    exposure = seen_from(np.eye(3))
    here = described(exposure)
    turned = described(replace(exposure, flux=exposure.flux[::-1, ::-1].copy(), weight=exposure.weight[::-1, ::-1].copy()))
    back = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) - turned.points
    offsets = []
    for point, size in zip(here.points, here.sizes, strict=True):
        distances = np.linalg.norm(back - point, axis=1)
        distances[turned.sizes != size] = np.inf
        if size > 31 * 1.2**2.5 and distances.min() < 2:
            offsets.append(back[distances.argmin()] - point)
    assert len(offsets) > 50
    # Where OpenCV says that they are, it is half a pixel.
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.1


def test_information_accounts_for_common_rounding_of_keypoints(seen_from: Callable) -> None:
    """A shift of a third of a pixel, which rounding to whole pixels hides."""
    locator, true = OrbLocator(OpencvOrbConfig(), seed=0), translation(0.3, -0.2)
    motion = locator.register(locator.describe(seen_from(true, 1)), locator.describe(seen_from(np.eye(3), 2)), None)
    assert isinstance(motion, Located)
    assert 0.1 < corner_displacements(motion.homography, true, SHAPE).mean() < 0.6
    assert np.diag(np.linalg.inv(motion.information)[4:6, 4:6]).min() > 1 / 12
