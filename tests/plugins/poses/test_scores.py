"""Scores of poses, and of a camera that turns all the way round against a scene all around it."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from photonpano import InputError, evaluation
from photonpano.api.cli.app import app
from photonpano.geometry import Camera, Canvas, rotation_matrices, translation
from photonpano_poses import evaluate_poses, pose_errors

N_FRAMES, RATE = 200, 1000.0
MATRIX = np.array([[90.0, 0, 44.5], [0, 90, 29.5], [0, 0, 1]])


def poses_of(places: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    rotations = Rotation.from_rotvec(vectors).as_matrix()
    return np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)


def path(noise_m: float = 0.0, noise_rad: float = 0.0) -> np.ndarray:
    """Return poses on a bent path, with noise that is independent in each frame."""
    times, rng = np.linspace(0, 1, N_FRAMES), np.random.default_rng(1)
    places = np.stack([2 * times, np.sin(5 * times), 2 * times**2], axis=1)
    vectors = np.outer(times, [0.1, 0.4, -0.2])
    return poses_of(places + noise_m * rng.normal(size=(N_FRAMES, 3)), vectors + noise_rad * rng.normal(size=(N_FRAMES, 3)))


def in_other_world(poses: np.ndarray, scale: float = 0.2) -> np.ndarray:
    """Return the same poses where the world is turned, moved and scaled."""
    turn, shift = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.array([3.0, -4, 1])
    rotations = poses[:, :, :3] @ turn.T
    return np.concatenate([rotations, (scale * poses[:, :, 3] - rotations @ shift)[..., None]], axis=-1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run folder with poses that err by 1 mm and 1 mrad along each axis, and its truth beside it."""
    folder = tmp_path / "run"
    folder.mkdir()
    located = np.arange(N_FRAMES) < 180
    poses = in_other_world(path(0.001, 0.001))
    poses[~located] = np.nan
    write(folder, poses, located)
    np.savez(tmp_path / "truth.npz", camera_from_world=path(), camera_matrix=MATRIX * [[0.9], [0.9], [1]])
    return folder


def write(folder: Path, poses: np.ndarray, located: np.ndarray, **changes: Any) -> None:
    arrays = {
        "camera_from_world": poses,
        "located": located,
        "camera_matrix": MATRIX,
        "distortion": np.zeros(4),
        "std_position": np.where(located, 0.2 * 0.001 * np.sqrt(3), np.nan),
        "std_rotation_deg": np.where(located, 0.1, np.nan),
        "frame_shape": np.array([60, 90]),
        "frame_rate_hz": np.array(RATE),
    }
    np.savez(folder / "poses.npz", **(arrays | changes))


def test_errors_are_those_of_the_noise_whatever_the_world(folder: Path, tmp_path: Path) -> None:
    score = evaluate_poses(folder, tmp_path / "truth.npz", rpe_frames=5)
    assert score.located_share == 0.9
    assert score.ate_m == pytest.approx(0.001 * np.sqrt(3), rel=0.1)
    length = np.linalg.norm(np.diff(-np.einsum("nji,nj->ni", path()[:180, :, :3], path()[:180, :, 3]), axis=0), axis=1).sum()
    assert score.ate_share == pytest.approx(score.ate_m / length)
    assert score.rotation_deg == pytest.approx(np.rad2deg(0.001 * np.sqrt(3)), rel=0.2)
    assert score.rpe_frames == 5
    assert score.rpe_m == pytest.approx(0.001 * np.sqrt(6), rel=0.15)
    assert score.rpe_deg == pytest.approx(np.rad2deg(0.001 * np.sqrt(6)), rel=0.2)
    assert score.honest_shares == pytest.approx((0.61, 0.995, 1), abs=0.12)
    assert score.std_ratio == pytest.approx(1, abs=0.1)
    assert score.focal_error == pytest.approx(1 / 0.9 - 1)
    assert np.isnan(score.errors_m[180:]).all()


def test_depth_is_compared_with_that_of_the_nearest_frame_of_the_truth(folder: Path, tmp_path: Path) -> None:
    """Maps of a wall at z = 6 m, in a world of another scale, err by 1 % and say so; one pixel in ten is unknown."""

    def wall(pose: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        pixels = np.concatenate([np.indices((60, 90))[::-1].reshape(2, -1), np.ones((1, 5400))])
        rays = pose[:, :3].T @ np.linalg.solve(matrix, pixels)
        return ((6 + pose[:, :3].T @ pose[:, 3])[2] / rays[2]).reshape(60, 90).astype(np.float32)

    true, other, rng = path(), in_other_world(path()), np.random.default_rng(0)
    frames = np.linspace(0, N_FRAMES - 1, 16).round().astype(int)
    depths = np.array([wall(true[frame], MATRIX) for frame in frames])
    arrays = {"camera_from_world": true, "camera_matrix": MATRIX, "depth_frames": frames, "depths": depths}
    np.savez(tmp_path / "truth.npz", **arrays)
    write(
        folder, other, np.ones(N_FRAMES, dtype=bool), std_position=np.full(N_FRAMES, 1e-3), std_rotation_deg=np.ones(N_FRAMES)
    )
    (folder / "depth").mkdir()
    views = []
    for frame in (0, 50, 130):
        found = 0.2 * wall(true[frame], MATRIX) * (1 + 0.01 * rng.normal(size=(60, 90)).astype(np.float32))
        unknown = rng.random((60, 90)) < 0.1
        for suffix, values in (("", found), ("_std", 0.01 * found)):
            tifffile.imwrite(folder / f"depth/exposure_{frame:04d}{suffix}.tif", np.where(unknown, np.float32(0), values))
        pose = np.linalg.inv(np.concatenate([other[frame], [[0, 0, 0, 1]]])) @ np.diag([1.0, -1, -1, 1])
        views.append({"file_path": f"images/exposure_{frame:04d}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"frames": views}))
    score = evaluate_poses(folder, tmp_path / "truth.npz").depth
    assert score is not None
    assert score.error == pytest.approx(0.00674, rel=0.1)
    assert score.known_share == pytest.approx(0.9, abs=0.01)
    assert score.within_std_shares == pytest.approx((0.683, 0.954, 0.997), abs=0.02)
    assert ("error of depth, median", f"{100 * score.error:.2f} %, of 90 % of the pixels") in score.rows()
    np.savez(tmp_path / "truth.npz", **arrays | {"depths": depths[:, :30]})
    with pytest.raises(InputError, match="depths of frames of another size"):
        evaluate_poses(folder, tmp_path / "truth.npz")


def test_perfect_poses_have_no_error() -> None:
    score = pose_errors(in_other_world(path()), path(), np.ones(N_FRAMES, bool), rpe_frames=10)
    assert max(score.ate_m, score.rotation_deg, score.turns_deg, score.rpe_m, score.rpe_deg) < 1e-5
    assert score.honest_shares is None


def test_mirrored_poses_are_not_right() -> None:
    mirrored = path() * np.array([-1.0, 1, 1])[:, None]
    mirrored[:, :, 0] *= -1
    assert pose_errors(mirrored, path(), np.ones(N_FRAMES, bool), 10).ate_m > 0.01


def test_command_prints_ate_and_rpe(folder: Path, tmp_path: Path) -> None:
    arguments = ["evaluate", str(folder), "--truth", str(tmp_path / "truth.npz")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "position error (ATE), rms" in done.stdout
    assert "RPE over 2 frames, rms" in done.stdout
    assert '"std_ratio": ' in CliRunner().invoke(app, [*arguments, "--json"]).stdout
    assert "of this capture?" not in done.stderr


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        (
            {"homographies": np.eye(3)[None]},
            "has homographies and no poses (camera_from_world): it is the truth of a flat",
        ),
        ({"camera_from_world": path()[:9]}, "is the truth of 9 frames, but the run in"),
        ({"camera_from_world": np.zeros((N_FRAMES, 3, 4))}, "camera_from_world must be finite rotations and translations"),
        ({"camera_from_world": np.zeros((N_FRAMES, 4, 4))}, "of the shape (frames, 3, 4), got (200, 4, 4)"),
        ({"other": np.zeros(3)}, "lacks camera_from_world; it contains other"),
    ],
)
def test_truth_of_something_else_is_refused(folder: Path, tmp_path: Path, truth: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "other.npz", **truth)
    with pytest.raises(InputError) as caught:
        evaluate_poses(folder, tmp_path / "other.npz")
    assert message in str(caught.value)


SHAPE = (60, 90)
FOCAL = 80.0
N_TURNED = 73
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
    share = np.linspace(0, 1, N_TURNED)
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
            "located": np.ones(N_TURNED, dtype=bool),
            "std_px": np.full(N_TURNED, 0.5),
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
    capture.write = lambda: write_turn(capture)
    capture.write()
    return capture


def write_turn(turn: SimpleNamespace) -> None:
    motion = {"rotations": turn.rotations, "homographies": turn.camera.homographies(turn.rotations)}
    np.savez(turn.folder / "trajectory.npz", **turn.trajectory, **motion)
    tifffile.imwrite(turn.folder / "panorama.tiff", turn.flux)
    tifffile.imwrite(turn.folder / "coverage.tiff", np.full(turn.flux.shape, 50, np.float32))
    np.savez(turn.truth, **turn.true)


def test_evaluate_scores_perfect_turn_past_90_degrees(turn):
    score = evaluation.evaluate(turn.folder, turn.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.rotation.max_deg < 1e-6
    assert score.rotation.focal_error == pytest.approx(0, abs=1e-12)
    assert score.panorama.psnr_db > 45  # what linear interpolation of the scene leaves
    assert score.panorama.compared_share == 1


def test_evaluate_measures_rotation_and_focal_errors_over_located_frames(turn):
    """Every other frame turns by 0.2 degrees too far; what all frames have in common is no error."""
    own = np.zeros((N_TURNED, 3))
    own[::2, 0] = np.deg2rad(0.2)
    own[:9] = 1
    turn.rotations = rotation_matrices([0.3, 0.2, 0.1]) @ turn.rotations @ rotation_matrices(own)
    turn.trajectory["located"][:9] = False
    turn.camera = Camera.of(FOCAL * 1.01, SHAPE)
    turn.trajectory["camera_matrix"] = turn.camera.matrix
    turn.write()
    score = evaluation.evaluate(turn.folder, turn.truth)
    assert score.rotation.mean_deg == pytest.approx(0.1, rel=0.1)
    assert 0.1 < score.rotation.max_deg < 0.21
    assert score.rotation.focal_error == pytest.approx(0.01)
    # 0.1 degrees are 0.14 px; 1 % of the focal length shifts corners, which lie 54 px from the middle, by up to 0.5 px.
    assert 0.1 < score.trajectory.mean_px < 0.7


def test_evaluate_renders_oracle_of_a_turn_along_true_rotations(turn):
    calls = []

    def render(trajectory, canvas):
        calls.append((trajectory, canvas))
        return SimpleNamespace(flux=turn.flux, weight=np.ones(canvas.shape, np.float32))

    score = evaluation.evaluate(turn.folder, turn.truth, render)
    [(trajectory, canvas)] = calls
    found = turn.camera.rotations(trajectory.at(np.arange(N_TURNED)))
    np.testing.assert_allclose(found, turn.rotations, atol=1e-7)
    assert (canvas.shape, canvas.projection) == (turn.canvas.shape, turn.canvas.projection)
    np.testing.assert_array_equal(canvas.transform, turn.canvas.transform)
    assert score.below_oracle_db == 0


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
        evaluation.evaluate(turn.folder, turn.truth)
    assert str(caught.value) == f"{turn.truth}: {message}"
