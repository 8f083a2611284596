"""The two readings of depth, on points before a camera that goes around them, near and far."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import camera_matrix, rotation_matrices, rotation_vectors

pytest.importorskip("pycolmap")

import pycolmap

from photonpano_colmap.reconstruction import adjust_model, compared_halves, likelier_reading, pose_noise, reversed_in_depth

SEEN = 150


def model(poses: np.ndarray, points: np.ndarray, pixels: np.ndarray, focal_px: float) -> object:
    """Return a reconstruction of COLMAP: pixels (N, M, 2) of M points in N images."""
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", focal_px, 160, 128)
    camera.params = [focal_px, 80.0, 64.0]
    found.add_camera_with_trivial_rig(camera)
    identifiers = [found.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8)) for point in points]
    for number, (pose, seen) in enumerate(zip(poses, pixels, strict=True), start=1):
        image = pycolmap.Image(f"{number:06}.png", seen + 0.5, 1, number)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for index, identifier in enumerate(identifiers):
            found.add_observation(identifier, pycolmap.TrackElement(number, index))
    return found


def orbit(distance: float) -> np.ndarray:
    """Return poses of a camera that goes around the scene by 16 degrees and nods: (16, 3, 4)."""
    times, middle = np.linspace(-1, 1, 16), np.array([0, 0, distance])
    rotations = rotation_matrices(np.stack([0.07 * np.sin(4 * times), 0.14 * times, 0.02 * times], axis=1))
    return np.concatenate([rotations, (middle - rotations @ middle)[:, :, None]], axis=2)


@pytest.mark.parametrize(("focal_px", "distance", "outcome"), [(150.0, 4.5, "reversed"), (1000.0, 30.0, "unsure")])
def test_reversed_depth_is_recognised_by_its_residuals(
    focal_px: float, distance: float, outcome: str, capfd: pytest.CaptureFixture[str]
) -> None:
    rng, poses = np.random.default_rng(5), orbit(distance)
    points = np.random.default_rng(6).uniform([-1.5, -1.5, distance - 1.5], [1.5, 1.5, distance + 1.5], (SEEN, 3))
    seen = np.einsum("nij,mj->nmi", poses[:, :, :3], points) + poses[:, None, :, 3]
    pixels = focal_px * seen[..., :2] / seen[..., 2:] + (79.5, 63.5) + rng.normal(0, 0.3, (len(poses), SEEN, 2))
    right = model(poses, points, pixels, focal_px)
    kept, readings = likelier_reading(right, finds_focal=False)
    assert (readings.doubt is not None) == (outcome == "unsure")
    assert outcome == "unsure" or not readings.is_reversed
    right.update_point_3d_errors()
    # COLMAP ends before all images and points agree best.
    assert kept.compute_mean_reprojection_error() < 0.99 * right.compute_mean_reprojection_error()
    wrong = model(*reversed_in_depth(poses, points), pixels, focal_px)
    chosen, readings = likelier_reading(wrong, finds_focal=False)
    assert (readings.doubt is not None) == (outcome == "unsure")
    if outcome == "reversed":
        assert readings.is_reversed
        first, last = (chosen.images[number].cam_from_world().matrix()[:, :3] for number in (1, len(poses)))
        away = (last @ first.T) @ (poses[-1, :, :3] @ poses[0, :, :3].T).T
        assert np.degrees(np.linalg.norm(rotation_vectors(away))) < 1
    assert capfd.readouterr().err == ""


def test_halves_of_the_points_err_by_the_square_root_of_two_more() -> None:
    rng, poses = np.random.default_rng(5), orbit(4.5)
    points = np.random.default_rng(6).uniform([-1.5, -1.5, 3], [1.5, 1.5, 6], (SEEN, 3))
    seen = np.einsum("nij,mj->nmi", poses[:, :, :3], points) + poses[:, None, :, 3]
    pixels = 150 * seen[..., :2] / seen[..., 2:] + (79.5, 63.5) + rng.normal(0, 0.1, (len(poses), SEEN, 2))
    found = model(poses, points, pixels, 150.0)
    halves = compared_halves(found, finds_focal=False)
    adjust_model(found, finds_focal=False)
    poses = np.array([found.images[number].cam_from_world().matrix() for number in range(1, len(poses) + 1)])
    points = np.array([found.points3D[identifier].xyz for identifier in sorted(found.points3D)])
    observed = [(np.arange(SEEN), each) for each in pixels]
    noise = pose_noise(poses, points, observed, camera_matrix(150.0, (79.5, 63.5)), False)
    ratio = halves.std_position / np.sqrt(np.mean(noise.std_position**2))
    assert 0.8 < ratio < 2.2, ratio


@pytest.fixture(autouse=True)
def quiet() -> None:
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
