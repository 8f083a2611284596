"""A camera that turns before a scene all around, and a lens with OpenCV's distortion."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError, SourceContext
from photonpano.geometry import Camera, rotation_vectors
from photonpano_simulator import scenes
from photonpano_simulator.config import CameraSimulatorConfig, SimulatorConfig
from photonpano_simulator.scenes import street
from photonpano_simulator.source import SimulatorSource

SHAPE = (64, 96)
FOCAL = 80.0
SCENE: dict[str, Any] = {"kind": "street", "width": 512, "height": 256}
DISTORTION = {"k1": -0.1, "k2": 0.03, "p1": 0.002, "p2": -0.003}


drawn_once = cache(street)


@pytest.fixture(autouse=True)
def quick_street(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw each street once for all tests."""
    monkeypatch.setattr(scenes, "street", drawn_once)


def settings(path: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {
        "scene": SCENE,
        "path": {"kind": "turn"} | path,
        "frame_shape": SHAPE,
        "focal_length_px": FOCAL,
        "n_frames": 9,
        "flux": 0.5,
    } | changes


def spad(path: dict[str, Any], **changes: Any) -> SimulatorSource:
    return SimulatorSource(SimulatorConfig.model_validate(settings(path, **changes)), SourceContext(seed=0))


def bright(path: dict[str, Any], **changes: Any) -> SimulatorSource:
    """A conventional camera in so much light that noise is 0.1 % of the mean."""
    sensor = {"bits": 16, "full_well": 1e7, "read_noise": 0}
    config = settings(path, flux=1e6, sensor=sensor, **changes)
    return SimulatorSource(CameraSimulatorConfig.model_validate(config), SourceContext(seed=0))


def seen(truth: dict[str, Any], frame: int) -> np.ndarray:
    """Return the flux of a frame by the rotations of the truth: (H, W)."""
    camera = Camera(truth["camera_matrix"], truth.get("distortion", np.zeros(4)))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across, down, ahead = np.moveaxis(camera.directions(np.stack([x, y], axis=-1)) @ truth["rotations"][frame].T, -1, 0)
    scene = truth["scene"]
    height, width = scene.shape
    columns = (np.arctan2(across, ahead) / (2 * np.pi) + 0.5) * width - 0.5
    rows = np.arcsin(np.clip(down, -1, 1)) / (2 * np.pi) * width + (height - 1) / 2
    around = np.concatenate([scene[:, -1:], scene, scene[:, :1]], axis=1)
    return cv2.remap(around, (columns + 1).astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)


@pytest.mark.parametrize("distortion", [{}, DISTORTION])
def test_frames_of_a_turn_show_what_the_rotations_say(distortion: dict[str, float]) -> None:
    """Eight steps of 50 degrees pass the seam at 180 degrees."""
    source = bright({"degrees": 400, "pitch_wobble_deg": 8, "roll_wobble_deg": 5, "wobbles": 1.3}, distortion=distortion)
    truth = source.truth()
    frames = source.response.flux(source.frames(FrameSpan(0, 9)).astype(np.float64), np.ones(SHAPE))
    for frame in range(9):
        expected = seen(truth, frame)
        assert np.median(np.abs(frames[frame] - expected)) < 0.002 * expected.mean()


def test_turn_closes_after_360_degrees() -> None:
    source = bright({"degrees": 360})
    truth = source.truth()
    np.testing.assert_allclose(truth["rotations"][-1], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(seen(truth, 8), seen(truth, 0), rtol=1e-3)


def test_rotations_of_a_turn_have_its_angle_and_its_wobble() -> None:
    truth = spad({"degrees": -90, "pitch_wobble_deg": 4, "roll_wobble_deg": 3, "wobbles": 1}, n_frames=5).truth()
    ahead = truth["rotations"][:, :, 2]
    np.testing.assert_allclose(np.rad2deg(np.arctan2(ahead[:, 0], ahead[:, 2])), [0, -22.5, -45, -67.5, -90], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(np.arcsin(ahead[:, 1])), [0, 4, 0, -4, 0], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(rotation_vectors(truth["rotations"][0])), [0, 0, 3], atol=1e-9)


def test_frames_of_a_plane_are_distorted_as_opencv_does() -> None:
    source = bright({"kind": "pan", "length_px": 10}, distortion=DISTORTION, focal_length_px=200, n_frames=1)
    truth = source.truth()
    assert truth["distortion"].tolist() == list(DISTORTION.values())
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, truth["camera_matrix"], truth["distortion"], P=truth["camera_matrix"])
    places = cv2.perspectiveTransform(ideal, truth["homographies"][0]).astype(np.float32).reshape(*SHAPE, 2)
    expected = cv2.remap(truth["scene"], places, None, cv2.INTER_LINEAR)
    frame = source.response.flux(source.frames(FrameSpan(0, 1))[0].astype(np.float64), np.ones(SHAPE))
    assert np.median(np.abs(frame - expected)) < 0.002 * expected.mean()


def test_pixels_have_an_area_before_a_finer_scene_all_around() -> None:
    """Averages of two pixels of the scene keep its mean, also across the seam, and lose contrast."""
    sharp = bright({"degrees": 360}, scene=SCENE | {"width": 1024, "height": 512})
    wide = bright({"degrees": 360}, scene=SCENE | {"width": 1024, "height": 512}, scene_scale=2)
    for frame in (0, 4):
        fine, coarse = (source.frames(FrameSpan(frame, frame + 1))[0].astype(float) for source in (sharp, wide))
        assert coarse.mean() == pytest.approx(fine.mean(), rel=0.02)
        assert coarse.std() < 0.95 * fine.std()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"scene": SCENE | {"height": 200}, "focal_length_px": 60},
            "the frames reach 72.7 degrees above or below the horizon, but the scene of 200x512 px, which is 360 degrees wide, "
            "only 70.3; take a higher scene, or a smaller wobble",
        ),
        (
            {"focal_length_px": 400},
            "a scene of 512 px all around is too coarse for a focal length of 400 px, which sees 2,513 px; take a wider scene, "
            "or lower focal_length_px",
        ),
        (
            {"distortion": {"k1": -1.5}},
            "distortion folds the image of 64x96 px at the focal length of 80 px, so that nothing is imaged at its border; "
            "take smaller coefficients",
        ),
    ],
)
def test_turn_that_cannot_be_simulated_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        spad({"pitch_wobble_deg": 45}, **changes)
    assert str(caught.value) == message


def test_truth_of_a_turn_is_no_file_of_homographies(tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    np.savez(path, **spad({}).truth())
    with pytest.raises(InputError) as caught:
        spad({"kind": "file", "file": path})
    message = "is the truth of a turn, and its homographies lie on no plane; take a path of the kind turn"
    assert str(caught.value) == f"{path} {message}"
