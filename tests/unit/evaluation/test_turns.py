"""Scores of a camera that turns all the way round, against a scene all around it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from photonpano import InputError
from photonpano.evaluation import evaluate, true_panorama
from photonpano.geometry import Camera, Canvas, rotation_matrices, translation

SHAPE = (60, 90)
FOCAL = 80.0
N_FRAMES = 73
REFERENCE = 50


def flux_in(rays: np.ndarray) -> np.ndarray:
    """Return a smooth flux in (..., 3) directions."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return (0.5 + 0.2 * np.sin(9 * x) * np.cos(7 * y) + 0.2 * np.sin(8 * z + 3 * y)).astype(np.float32)


def equirectangular(height: int, width: int) -> np.ndarray:
    """Return the directions of the pixels of a panorama, 360 degrees wide: (height, width, 3)."""
    across = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    down = ((np.arange(height)[:, None] + 0.5) - height / 2) * 2 * np.pi / width
    flat = np.cos(down)
    return np.stack([np.sin(across) * flat, np.sin(down) + 0 * across, np.cos(across) * flat], axis=-1)


@pytest.fixture
def turn(tmp_path: Path) -> SimpleNamespace:
    """Write a perfect run of a turn by 400 degrees on a sphere, and the truth of its capture."""
    share = np.linspace(0, 1, N_FRAMES)
    angles = np.stack([0.1 * np.sin(9 * share), np.deg2rad(400) * share, 0.05 * np.cos(7 * share)], axis=1)
    true, camera = rotation_matrices(angles), Camera.of(FOCAL, SHAPE)
    rotations = true[REFERENCE].T @ true
    per_radian = 400 / (2 * np.pi)
    transform = translation(199.5, 79.5) @ np.diag([per_radian, per_radian, 1])
    canvas = Canvas(160, 400, transform, "spherical", camera.matrix)
    flux = flux_in(equirectangular(160, 400) @ true[REFERENCE].T)
    capture = SimpleNamespace(
        folder=tmp_path / "run",
        truth=tmp_path / "truth.npz",
        canvas=canvas,
        flux=flux,
        camera=camera,
        rotations=rotations,
        trajectory={
            "canvas": transform,
            "projection": np.array("spherical"),
            "model": np.array("rotation"),
            "frame_shape": np.array(SHAPE),
            "reference": np.array(REFERENCE),
            "located": np.ones(N_FRAMES, dtype=bool),
            "std_px": np.full(N_FRAMES, 0.5),
            "camera_matrix": camera.matrix,
            "distortion": np.zeros(4),
        },
        true={
            "homographies": camera.homographies(true),
            "rotations": true,
            "camera_matrix": camera.matrix,
            "frame_shape": np.array(SHAPE),
            "scene": flux_in(equirectangular(300, 600)),
            "scene_projection": np.array("spherical"),
        },
    )
    capture.folder.mkdir()
    capture.write = lambda: write(capture)
    capture.write()
    return capture


def write(turn: SimpleNamespace) -> None:
    motion = {"rotations": turn.rotations, "homographies": turn.camera.homographies(turn.rotations)}
    np.savez(turn.folder / "trajectory.npz", **turn.trajectory, **motion)
    tifffile.imwrite(turn.folder / "panorama.tiff", turn.flux)
    tifffile.imwrite(turn.folder / "coverage.tiff", np.full(turn.flux.shape, 50, np.float32))
    np.savez(turn.truth, **turn.true)


def test_evaluate_scores_perfect_turn_past_90_degrees(turn):
    score = evaluate(turn.folder, turn.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.rotation.max_deg < 1e-6
    assert score.rotation.focal_error == pytest.approx(0, abs=1e-12)
    assert score.panorama.psnr_db > 45  # what linear interpolation of the scene leaves
    assert score.panorama.compared_share == 1


def test_evaluate_measures_rotation_and_focal_errors_over_located_frames(turn):
    """Every other frame turns by 0.2 degrees too far; what all frames have in common is no error."""
    own = np.zeros((N_FRAMES, 3))
    own[::2, 0] = np.deg2rad(0.2)
    own[:9] = 1
    turn.rotations = rotation_matrices([0.3, 0.2, 0.1]) @ turn.rotations @ rotation_matrices(own)
    turn.trajectory["located"][:9] = False
    turn.camera = Camera.of(FOCAL * 1.01, SHAPE)
    turn.trajectory["camera_matrix"] = turn.camera.matrix
    turn.write()
    score = evaluate(turn.folder, turn.truth)
    assert score.rotation.mean_deg == pytest.approx(0.1, rel=0.1)
    assert 0.1 < score.rotation.max_deg < 0.21
    assert score.rotation.focal_error == pytest.approx(0.01)
    # 0.1 degrees are 0.14 px; 1 % of the focal length shifts corners, which lie 54 px from the middle, by up to 0.5 px.
    assert 0.1 < score.trajectory.mean_px < 0.7


def test_evaluate_scores_homographies_of_part_of_a_turn(turn):
    """A run that knows no rotations is scored in the plane of one of its frames, wherever the truth looks."""
    for name in ("camera_matrix", "distortion", "model", "projection"):
        del turn.trajectory[name]
    del turn.true["scene"]
    turn.trajectory["located"] = np.abs(np.arange(N_FRAMES) - REFERENCE) < 8
    turn.write()
    score = evaluate(turn.folder, turn.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.rotation is None


def test_evaluate_renders_oracle_of_a_turn_along_true_rotations(turn):
    calls = []

    def render(trajectory, canvas):
        calls.append((trajectory, canvas))
        return SimpleNamespace(flux=turn.flux, weight=np.ones(canvas.shape, np.float32))

    score = evaluate(turn.folder, turn.truth, render)
    [(trajectory, canvas)] = calls
    found = turn.camera.rotations(trajectory.at(np.arange(N_FRAMES)))
    np.testing.assert_allclose(found, turn.rotations, atol=1e-7)
    assert canvas.same_as(turn.canvas)
    assert score.below_oracle_db == 0


def test_true_panorama_shows_a_plane_on_a_cylinder(turn):
    """The scene before the camera is a plane; nothing of it lies behind."""
    scene = np.add.outer(np.zeros(60), np.arange(90)).astype(np.float32)
    transform = translation(199.5, 29.5) @ np.diag([FOCAL, FOCAL, 1])
    canvas = Canvas(60, 400, transform, "cylindrical", turn.camera.matrix)
    image = true_panorama(scene, canvas, np.eye(3))
    a = (np.arange(400) - 199.5) / FOCAL
    seen = np.abs(a) < np.arctan2(44.5, FOCAL)
    np.testing.assert_allclose(image[30, seen], 44.5 + FOCAL * np.tan(a[seen]), atol=1e-3)
    assert np.isnan(image[30, ~seen]).all()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rotations", np.zeros((3, 3)), "rotations must be finite and of the shape of homographies, got (3, 3)"),
        ("camera_matrix", np.zeros((3, 3)), "camera_matrix must be finite and invertible, of the shape (3, 3)"),
    ],
)
def test_truth_with_wrong_rotations_is_refused(turn, name, value, message):
    turn.true[name] = value
    turn.write()
    with pytest.raises(InputError) as caught:
        evaluate(turn.folder, turn.truth)
    assert str(caught.value) == f"{turn.truth}: {message}"
