"""The bound on the motion of a whole capture."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))
from bounds import pair_bound_px
from joint_bound import MODELS, Model, corner_errors_px, information, joint_bound

from photonpano.geometry import Camera, rotation_matrices, step_motions, translation
from photonpano.photometry import BinaryResponse

SHAPE, TIME = (48, 64), np.linspace(-1, 1, 1200)
SCENE = 0.1 * np.exp(3 * cv2.GaussianBlur(np.random.default_rng(0).normal(size=(96, 160)), (0, 0), 2.5))
MOTION = translation(47, 23) @ step_motions(np.stack([45 * TIME, 20 * TIME**2, 0.02 * np.sin(3 * TIME), 0 * TIME], 1), SHAPE)


def bound(name="euclidean", light=1.0, step=1, limited=False, **camera):
    return joint_bound(light * SCENE, MOTION, Model.of(name, SHAPE, **camera), step, limited).mean_px


def test_two_views_at_one_place_are_bounded_as_a_pair():
    model, views, flux = Model.of("homography", SHAPE), np.tile(np.eye(3), (2, 1, 1)), SCENE[: SHAPE[0], : SHAPE[1]]
    of_pair = information(flux, views, np.array([100, 300]), model, 1, False)
    np.testing.assert_allclose(of_pair, np.kron([[1, -1], [-1, 1]], of_pair[:8, :8]), atol=1e-9 * of_pair.max())
    harmonic = information(flux, views, np.array([150, 150]), model, 1, False)
    np.testing.assert_allclose(of_pair, harmonic, atol=1e-9 * of_pair.max())
    expected = pair_bound_px(flux.astype(np.float32), BinaryResponse(), 100, 300) / 2  # the two share their distance
    assert corner_errors_px(of_pair, views, model, np.eye(16))[1] == pytest.approx(expected, rel=0.03)


def test_bound_falls_with_the_root_of_the_light_where_detail_exceeds_noise():
    assert bound(light=0.01) / bound(light=0.04) == pytest.approx(2, rel=0.01)
    prices = [bound(light=light, limited=True) / bound(light=light) for light in (0.1, 1.0, 10.0)]
    assert prices[0] > prices[1] > prices[2] > 1


def test_fewer_numbers_have_a_smaller_bound():
    bounds = [bound(name) for name in MODELS]
    assert bounds == sorted(bounds)
    assert bounds[-1] > 2 * bounds[0]


def test_some_pixels_stand_for_all():
    assert bound(step=2) == pytest.approx(bound(), rel=0.1)


def test_unknown_camera_costs_accuracy():
    assert bound("rotation", camera=Camera.of(1e6, SHAPE)) == pytest.approx(bound(), rel=1e-4)
    near = Camera.of(60, SHAPE, (-0.1, 0.03, 0, 0))
    turns = near.homographies(rotation_matrices(np.stack([0.1 * TIME**2, 0.3 * TIME, 0.05 * np.sin(3 * TIME)], axis=1)))
    models = [Model.of("rotation", SHAPE, near, n_shared) for n_shared in (0, 1, 3)]
    known, focal, lens = (joint_bound(SCENE, translation(48, 24) @ turns, model, 1).mean_px for model in models)
    assert known < focal < lens < 0.3  # no change of the plane counts as an error, also where the perspective changes
