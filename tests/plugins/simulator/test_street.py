from __future__ import annotations

import cv2
import numpy as np
import pytest

from photonpano_simulator.scenes import street


@pytest.mark.parametrize("shape", [(240, 320), (333, 500), (64, 160), (300, 64)])
def test_street_is_drawn_at_any_size(shape: tuple[int, int]) -> None:
    image = street(shape, seed=0)
    assert (image.shape, image.dtype) == (shape, np.float32)
    assert image.min() >= 0
    assert image.max() <= 1
    assert image.std() > 0.1


def test_street_depends_on_the_seed() -> None:
    first = street((240, 320), seed=1)
    np.testing.assert_array_equal(first, street((240, 320), seed=1))
    assert np.abs(first - street((240, 320), seed=2)).mean() > 0.05


def test_every_frame_has_features() -> None:
    """Wherever a frame of 254x496 lies, SIFT finds more than a hundred keypoints, blurred as a first level sees them."""
    image = (street((1365, 2048), seed=0) * 255).astype(np.uint8)
    keypoints = cv2.SIFT_create().detect(cv2.GaussianBlur(image, (0, 0), 2), None)
    places = np.array([keypoint.pt for keypoint in keypoints]).astype(int)
    density = np.zeros(image.shape, np.float32)
    np.add.at(density, (places[:, 1], places[:, 0]), 1)
    sums = cv2.integral(density)
    in_frame = sums[254:, 496:] - sums[:-254, 496:] - sums[254:, :-496] + sums[:-254, :-496]
    assert in_frame.min() > 100
