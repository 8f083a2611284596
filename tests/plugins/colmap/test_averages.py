"""Poses from averages of frames, on a small scene of four textured planes."""

from __future__ import annotations

import resource
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photonpano import FrameSpan, LocationError, OutputError, StageContext, StreamInfo, discover
from photonpano.execution.context import Quiet
from photonpano.geometry import camera_matrix
from photonpano.testing import MemorySource
from photonpano_poses import CameraGuess, pose_errors
from photonpano_poses.testing import FOCAL_PX, N_POSES, POSES_SHAPE, capture, true_poses

pytest.importorskip("pycolmap")

from photonpano_colmap.averages import AveragesEstimator
from photonpano_colmap.hooks import ColmapAveragesConfig
from photonpano_colmap.reconstruction import FreeFocal, Halves, Piece, Readings, Reconstruction, pose_noise, reconstruct

SIZE = 20
MATRIX = camera_matrix(FOCAL_PX, (79.5, 63.5))


def estimated(source: MemorySource, camera: CameraGuess | None = None, **keys: Any) -> Any:
    decided: list[Any] = []
    context = StageContext(source.info, source.response, 0, 2, decide=lambda *each: decided.append(each))
    config = ColmapAveragesConfig(group_size=SIZE, **keys)
    estimate = AveragesEstimator(config, context).estimate(source, camera or CameraGuess(FOCAL_PX), Quiet())
    return estimate, decided


def test_points_and_views_fit_together() -> None:
    estimate, decided = estimated(capture())
    assert len(estimate.views) == N_POSES // SIZE
    assert len(estimate.points.positions) > 100
    view = estimate.views[3]
    ideal = (estimate.points.positions[view.points] @ view.camera_from_world[:, :3].T + view.camera_from_world[:, 3]) @ MATRIX.T
    assert np.median(np.linalg.norm(ideal[:, :2] / ideal[:, 2:] - view.xy, axis=1)) < 1
    assert 0.1 < np.nanmedian(estimate.points.flux) < 3
    assert (decided, estimate.doubts, estimate.std_focal_px, estimate.lost) == ([], (), 0, ())


def test_camera_that_only_turns_is_offered_rotations(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Reconstruction((), np.full(16, 300), np.full(16, 100))
    monkeypatch.setattr("photonpano_colmap.averages.reconstruct", lambda *_: found)
    with pytest.raises(LocationError) as caught:
        estimated(MemorySource(np.zeros((N_POSES, *POSES_SHAPE))))
    assert "of 300 keypoints in an average (the median) 100 match another average" in str(caught.value)
    assert "motion: {model: rotation}" in str(caught.value)


def test_wrong_focal_length_is_doubted_and_the_right_one_is_not() -> None:
    # A camera with an eighth of the focal length bends the scene until it fits nearly as well.
    estimate, _ = estimated(capture(), CameraGuess(FOCAL_PX / 8))
    doubt = estimate.doubts[0]
    assert doubt.what == "the averages contradict the focal length"
    assert "px fits, 18.75 px is given" in doubt.where
    level = estimate.levels[0]
    free = FreeFocal(level["free_focal_px"], level["std_free_focal_px"], np.arange(0), np.zeros((0, 3, 4)))
    assert free.doubt_of(FOCAL_PX, "averages") is None
    assert abs(free.focal_px / FOCAL_PX - 1) < 0.06


def test_focal_length_without_poses_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Reconstruction((), np.full(16, 300), np.full(16, 100), FreeFocal(150.0, 6.0, np.arange(16), true_poses()[:16]))
    monkeypatch.setattr("photonpano_colmap.averages.reconstruct", lambda *_: found)
    with pytest.raises(LocationError, match=r"camera.focal_px = 5000, and does with 150 ± 6 px: correct it, or leave it out"):
        estimated(MemorySource(np.zeros((N_POSES, *POSES_SHAPE))), CameraGuess(5000.0))


def test_poses_are_expected_to_be_off_by_what_a_given_focal_length_moves_them() -> None:
    # Poses with the free focal length lie in another world, and every second one is 0.02 off.
    given, images, off = true_poses()[::SIZE], np.arange(16), np.zeros((16, 3))
    off[::2, 1] = 0.02
    free = given.copy()
    free[:, :, 3] = 2 * (given[:, :, 3] - np.einsum("nij,nj->ni", given[:, :, :3], off))
    shifts, angles = FreeFocal(150.0, 3.0, images, free).missed(images, given, 155.0)
    np.testing.assert_allclose(shifts, 0.01 * 0.8, rtol=0.2)  # beyond 3 of the 5 px
    assert angles.max() < 0.01
    for within in (148.0, 150.0):
        np.testing.assert_array_equal(FreeFocal(150.0, 3.0, images, free).missed(images, given, within), 0)
    half = FreeFocal(150.0, 3.0, images[:9], free[:9]).missed(images, given, 155.0)
    assert half[0].shape == (16,)


def test_full_disk_ends_the_run_before_colmap_reads_half_of_a_picture() -> None:
    picture = np.random.default_rng(0).integers(0, 255, POSES_SHAPE, np.uint8)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))  # the system cuts files short, as a full disk does
    try:
        with pytest.raises(OutputError, match=r"cannot write .* for COLMAP; free some space there, or set TMPDIR"):
            reconstruct([(picture, picture)], CameraGuess(FOCAL_PX), ColmapAveragesConfig(), 0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_scene_without_texture_is_refused() -> None:
    frames = np.random.default_rng(0).integers(0, 2, (5 * SIZE, *POSES_SHAPE))
    with pytest.raises(LocationError, match=r"too little texture, or too much noise: of \d+ keypoints in an average"):
        estimated(MemorySource(frames))


@pytest.fixture
def pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let COLMAP find the poses of the averages 0 to 7 and 9 to 14 apart from each other, and none of 8 and 15."""
    poses, points = true_poses()[::SIZE], np.random.default_rng(0).uniform([-2, -1, 3], [2, 1, 6], (80, 3))

    readings = Readings(found_px=0.3, reversed_px=0.9)

    def piece(images: range) -> Piece:
        observed = []
        for pose in poses[list(images)]:
            seen = (points @ pose[:, :3].T + pose[:, 3]) @ MATRIX.T
            observed.append((np.arange(len(points)), seen[:, :2] / seen[:, 2:]))
        return Piece(
            images=np.array(images),
            poses=poses[list(images)],
            points=points,
            observed=tuple(observed),
            focal_px=FOCAL_PX,
            readings=readings,
            halves=Halves(0, 0),
        )

    found = Reconstruction((piece(range(8)), piece(range(9, 15))), np.full(16, 300), np.full(16, 40))
    monkeypatch.setattr("photonpano_colmap.averages.reconstruct", lambda *_: found)


@pytest.mark.usefixtures("pieces")
def test_pieces_are_named_or_the_largest_is_kept() -> None:
    source = MemorySource(np.zeros((N_POSES, *POSES_SHAPE)))
    with pytest.raises(LocationError) as caught:
        estimated(source)
    assert str(caught.value) == (
        "the poses fall into 2 pieces that are not connected: frames 0 to 159 (8 averages); frames 180 to 299 (6 averages). "
        "Choose a smaller pose.with.step, so that neighbours overlap more, or keep the largest with pose.with.disconnected: "
        "largest"
    )
    estimate, _ = estimated(source, disconnected="largest")
    np.testing.assert_array_equal(estimate.located, np.arange(N_POSES) < 160)
    [lost] = estimate.lost
    assert (lost.span, lost.reason) == (
        FrameSpan(160, 320),
        "their averages belong to piece 2, which is not connected to the largest",
    )


@pytest.mark.usefixtures("pieces")
@pytest.mark.parametrize("is_unsure", [True, False])
def test_reversed_depth_is_recorded_and_an_undecided_one_is_doubted(is_unsure: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from photonpano_colmap import averages

    found = averages.reconstruct(None)
    readings = Readings(0.8, 0.78 if is_unsure else 0.5, is_reversed=True)
    pieces = tuple(replace(piece, readings=readings) for piece in found.pieces)
    monkeypatch.setattr(averages, "reconstruct", lambda *_: replace(found, pieces=pieces))
    estimate, [decision] = estimated(MemorySource(np.zeros((N_POSES, *POSES_SHAPE))), disconnected="largest")
    assert decision[:2] == ("depth_reversed", True)
    assert [round(doubt.figure, 3) for doubt in estimate.doubts] == ([0.975] if is_unsure else [])
    assert Readings(0.8, 0.8, differ=False).doubt is None


@pytest.mark.usefixtures("pieces")
def test_errors_are_no_smaller_than_those_of_half_of_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    from photonpano_colmap import averages

    found = averages.reconstruct(None)
    source, halves = MemorySource(np.zeros((N_POSES, *POSES_SHAPE))), Halves(0.02, 0.03)
    before, _ = estimated(source, disconnected="largest")
    pieces = tuple(replace(piece, halves=halves) for piece in found.pieces)
    monkeypatch.setattr(averages, "reconstruct", lambda *_: replace(found, pieces=pieces))
    after, _ = estimated(source, disconnected="largest")
    for name, least in (("std_position", 0.02), ("std_rotation_deg", np.rad2deg(0.03))):
        own, larger = (np.sqrt(np.nanmean(getattr(each, name) ** 2)) for each in (before, after))
        assert own < 0.5 * least
        assert 0.9 * least < larger


def test_few_averages_are_refused() -> None:
    contribution = discover().find("pose-estimator", "colmap-averages").contribution
    config = ColmapAveragesConfig(group_size=40)
    [problem] = contribution.check(config, StreamInfo(160, *POSES_SHAPE, None))
    words = "160 frames are 4 averages of 40; at least 5 are needed: choose a smaller pose.with.group_size, or record longer"
    assert problem == words
    with pytest.raises(LocationError, match=words):
        AveragesEstimator(config, SimpleNamespace()).estimate(MemorySource(np.zeros((160, 8, 8))), CameraGuess(), Quiet())


def seen(x: np.ndarray, n_poses: int) -> np.ndarray:
    """Return where poses (rotation vectors, then translations) see points: (n_poses, M, 2)."""
    vectors, shifts, points = np.split(x.reshape(-1, 3), [n_poses, 2 * n_poses])
    rotations = Rotation.from_rotvec(vectors).as_matrix()
    ideal = ((rotations[:, None] @ points[None, :, :, None])[..., 0] + shifts[:, None]) @ MATRIX.T
    return ideal[..., :2] / ideal[..., 2:]


def test_expected_errors_of_bundle_adjustment_are_honest() -> None:
    """Least squares moves poses and points by the pseudo-inverse of the derivatives, here by differences."""
    poses, rng, noise_px = true_poses()[::40], np.random.default_rng(0), 0.05
    n_poses, points = len(poses), rng.uniform([-2, -1.2, 3], [2, 1.2, 6], (40, 3))
    true = np.concatenate([Rotation.from_matrix(poses[:, :, :3]).as_rotvec(), poses[:, :, 3], points]).ravel()
    steps = 1e-6 * np.eye(len(true))
    slopes = np.stack([(seen(true + step, n_poses) - seen(true - step, n_poses)).ravel() / 2e-6 for step in steps], axis=1)
    solve = np.linalg.pinv(slopes, rcond=1e-6)
    ratios = []
    for _ in range(8):
        xy = seen(true, n_poses) + noise_px * rng.normal(size=(n_poses, 40, 2))
        found = true + solve @ (xy - seen(true, n_poses)).ravel()
        vectors, shifts, positions = np.split(found.reshape(-1, 3), [n_poses, 2 * n_poses])
        fitted = np.concatenate([Rotation.from_rotvec(vectors).as_matrix(), shifts[..., None]], axis=-1)
        noise = pose_noise(fitted, positions, [(np.arange(40), each) for each in xy], MATRIX, False)
        score = pose_errors(fitted, poses, np.ones(n_poses, bool), 1, noise.std_position)
        ratios.append([score.std_ratio, np.deg2rad(score.rotation_deg) / np.sqrt(np.mean(noise.std_rotation**2))])
        assert noise.residual_px == pytest.approx(noise_px, rel=0.25)
    assert np.sqrt(np.mean(np.square(ratios), axis=0)) == pytest.approx([1, 1], abs=0.25)
