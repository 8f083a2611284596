"""The bound on the motion of a whole capture."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))
from joint_bound import MODELS, Model, corner_errors_px, information, joint_bound, spacing_of

from photonpano.evaluation import pair_bound_px
from photonpano.geometry import Camera, rotation_matrices, step_motions, translation
from photonpano.photometry import BinaryResponse

SHAPE = (48, 64)


def scene(flux: float = 0.1) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(96, 160))
    return flux * np.exp(3 * cv2.GaussianBlur(noise, (0, 0), 2.5))


def moving(n_frames: int = 1200) -> np.ndarray:
    """Homographies that shift a frame over the scene, and roll it."""
    time = np.linspace(0, 1, n_frames)
    steps = np.stack([90 * time, 40 * time**2, 0.02 * np.sin(3 * time), 0 * time], axis=-1)
    return translation(2, 3) @ step_motions(steps, SHAPE)


def bound(name: str = "euclidean", flux: float = 0.1, step: int = 1, **camera: object) -> float:
    return joint_bound(scene(flux), moving(), Model.of(name, SHAPE, **camera), step).mean_px


@pytest.mark.parametrize("name", MODELS)
def test_two_views_at_one_place_are_bounded_as_a_pair(name):
    model, views = Model.of(name, SHAPE), np.broadcast_to(np.eye(3), (2, 3, 3))
    flux = scene()[: SHAPE[0], : SHAPE[1]]
    of_pair = information(flux, views, [100, 300], model)
    k = len(of_pair) // 2
    np.testing.assert_allclose(of_pair, np.kron([[1, -1], [-1, 1]], of_pair[:k, :k]), atol=1e-9 * of_pair.max())
    np.testing.assert_allclose(of_pair, information(flux, views, [150, 150], model))  # their harmonic mean
    if name == "homography":
        # The two share the distance between them.
        expected = pair_bound_px(flux.astype(np.float32), BinaryResponse(), 100, 300) / 2
        assert corner_errors_px(of_pair, views, model)[1] == pytest.approx(expected, rel=0.03)


def test_bound_falls_with_the_root_of_the_light():
    assert bound(flux=0.001) / bound(flux=0.004) == pytest.approx(2, rel=0.01)


def test_fewer_numbers_have_a_smaller_bound():
    bounds = [bound(name) for name in MODELS]
    assert bounds == sorted(bounds)
    assert bounds[-1] > 2 * bounds[0]


def test_some_pixels_stand_for_all():
    assert bound(step=2) == pytest.approx(bound(), rel=0.1)


def test_camera_far_away_shifts_and_rolls():
    distant = Camera.of(1e6, SHAPE)
    assert bound("rotation", camera=distant) == pytest.approx(bound(), rel=0.01)


def test_unknown_lens_costs_accuracy():
    near, time = Camera.of(60, SHAPE, (-0.1, 0.03, 0, 0)), np.linspace(-1, 1, 1200)
    turns = near.homographies(rotation_matrices(np.stack([0.1 * time**2, 0.3 * time, 0.05 * np.sin(3 * time)], axis=-1)))
    models = [Model.of("rotation", SHAPE, near, n_shared) for n_shared in (0, 1, 3)]
    known, focal, lens = (joint_bound(scene(), translation(48, 24) @ turns, model, 1).mean_px for model in models)
    assert known < focal < lens < 3 * known
    assert lens < 0.3  # also where the perspective changes, no change of the plane counts as an error


def test_spacing_follows_the_motion():
    time = np.arange(4000)
    steps = np.zeros((4000, 4))
    steps[:, 0] = 0.1 * time
    assert spacing_of(step_motions(steps, SHAPE), SHAPE) == 500
    steps[:, 1] = 2 * np.sin(time / 100)
    assert spacing_of(step_motions(steps, SHAPE), SHAPE) < 250
