from __future__ import annotations

import pickle

import numpy as np
import pytest

from photonpano import InputError
from photonpano.evaluation import evaluate, load_truth
from photonpano.geometry import apply, corners, normalised

NO_ARCHIVE = "truth.npz is not a truth as `photonpano simulate` writes it: it is no .npy or .npz file of plain numbers"


def failure(capture) -> str:
    with pytest.raises(InputError) as caught:
        evaluate(capture.folder, capture.truth)
    return str(caught.value).replace(str(capture.truth), "truth.npz").replace(str(capture.folder), "RUN")


def test_evaluate_refuses_missing_folder(capture):
    capture.folder = capture.folder / "nowhere"
    assert failure(capture) == "RUN is not a folder; give the run folder that `photonpano run` wrote"


def test_evaluate_refuses_folder_without_trajectory(capture):
    (capture.folder / "trajectory.npz").unlink()
    assert failure(capture) == "RUN has no trajectory.npz, so no run has finished in it; give the folder of a finished run"


def test_evaluate_refuses_missing_truth(capture):
    capture.truth.unlink()
    assert failure(capture) == "there is no file truth.npz; check the path"


def test_evaluate_refuses_truth_with_other_number_of_frames(capture):
    capture.true["homographies"] = capture.true["homographies"][:100]
    capture.write()
    assert failure(capture) == (
        "truth.npz is the truth of 100 frames, but the run in RUN has 120; they belong to different captures"
    )


def test_evaluate_refuses_truth_with_other_frame_shape(capture):
    capture.true["frame_shape"] = np.array([90, 60])
    capture.write()
    assert failure(capture) == (
        "truth.npz is the truth of frames of 90x60, but the run in RUN has frames of 60x90; they belong to different captures"
    )


def test_load_truth_names_missing_arrays(capture):
    del capture.true["homographies"]
    capture.write()
    assert failure(capture) == (
        "truth.npz lacks homographies; a truth as `photonpano simulate` writes it contains homographies, frame_shape, scene, "
        "undistorted_corners, rotations, camera_matrix, distortion; this file contains frame_shape, scene"
    )


def test_evaluate_refuses_truth_of_a_scene_with_depth(capture):
    capture.true["camera_from_world"] = np.zeros((120, 3, 4))
    del capture.true["homographies"]
    capture.write()
    assert failure(capture) == (
        "truth.npz is the truth of a camera that travels, which has poses and no homographies; score a run with `pose` by it"
    )


def test_load_truth_refuses_pickled_objects(capture):
    capture.true["homographies"] = np.array([{"a": 1}], dtype=object)
    capture.write()
    assert failure(capture) == "truth.npz is damaged: homographies cannot be read as an array of plain numbers; write it again"


def test_load_truth_refuses_pickle(capture):
    capture.truth.write_bytes(pickle.dumps({"homographies": 1}))
    assert failure(capture) == NO_ARCHIVE


def test_load_truth_refuses_truncated_archive(capture):
    capture.truth.write_bytes(capture.truth.read_bytes()[:-200])
    assert failure(capture) == NO_ARCHIVE


def test_load_truth_refuses_archive_with_wrong_byte(capture):
    content = bytearray(capture.truth.read_bytes())
    content[1000] ^= 0xFF
    capture.truth.write_bytes(content)
    assert failure(capture) == "truth.npz is damaged: homographies cannot be read as an array of plain numbers; write it again"


def test_load_truth_refuses_single_array(capture):
    with capture.truth.open("wb") as file:
        np.save(file, capture.true["homographies"])
    assert failure(capture) == (
        "truth.npz lacks homographies and frame_shape; a truth as `photonpano simulate` writes it contains homographies, "
        "frame_shape, scene, undistorted_corners, rotations, camera_matrix, distortion; this file contains an array without a "
        "name"
    )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("homographies", np.eye(3), "homographies must have the shape (frames, 3, 3), got (3, 3)"),
        ("homographies", np.zeros((120, 3, 3)), "homographies must be finite and invertible"),
        ("homographies", np.full((120, 3, 3), np.nan), "homographies must be finite and invertible"),
        ("frame_shape", np.array([60, 90, 1]), "frame_shape must be two positive integers (height, width), got [60, 90, 1]"),
        ("frame_shape", np.array([60, 0]), "frame_shape must be two positive integers (height, width), got [60, 0]"),
        ("scene", np.zeros((4, 4, 2)), "scene must be an image (height, width) or (height, width, 3), got the shape (4, 4, 2)"),
        ("scene", np.array(["a"]), "scene must contain numbers"),
        (
            "undistorted_corners",
            np.zeros((3, 2)),
            "undistorted_corners must be four finite points (x, y), got [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]",
        ),
        ("scene", np.zeros((4, 4)), "the scene is dark, so that the panorama cannot be compared with it"),
    ],
)
def test_load_truth_refuses_arrays_of_wrong_shape_or_value(capture, name, value, message):
    capture.true[name] = value
    capture.write()
    assert failure(capture) == f"truth.npz: {message}"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("canvas", np.eye(2), "canvas must have the shape (3, 3), got (2, 2)"),
        ("located", np.ones(7, bool), "located must have a flag for each of 120 frames, got (7,)"),
    ],
)
def test_load_run_trajectory_refuses_arrays_of_wrong_shape(capture, name, value, message):
    capture.trajectory[name] = value
    capture.write()
    assert failure(capture) == f"RUN/trajectory.npz: {message}"


def test_evaluate_refuses_run_without_located_frame(capture):
    capture.trajectory["located"] = np.zeros(120, bool)
    capture.write()
    assert failure(capture) == "RUN: the run located no frame, so that it has no score"


def test_load_panorama_refuses_missing_file(capture):
    (capture.folder / "coverage.tiff").unlink()
    assert failure(capture) == "RUN/coverage.tiff is missing, so the run folder is incomplete; run the spec again"


def test_load_panorama_refuses_file_that_is_no_tiff(capture):
    (capture.folder / "panorama.tiff").write_bytes(b"not an image")
    assert failure(capture).startswith("RUN/panorama.tiff cannot be read as a TIFF image: ")


def test_load_panorama_refuses_coverage_of_other_size(capture):
    capture.weight = capture.weight[:-1]
    capture.write()
    height, width = capture.flux.shape
    assert failure(capture) == (
        "RUN: panorama.tiff and coverage.tiff must be images of one size, "
        f"got the shapes {(height, width)} and {(height - 1, width)}"
    )


def test_evaluate_refuses_panorama_without_seen_pixel(capture):
    capture.weight[:] = 0
    capture.write()
    assert failure(capture) == "RUN: the panorama and the true scene have no pixel in common"


def test_load_truth_returns_written_arrays(capture):
    truth = load_truth(capture.truth)
    np.testing.assert_array_equal(truth.homographies, capture.true["homographies"])
    np.testing.assert_array_equal(truth.scene, capture.true["scene"])
    assert truth.frame_shape == (60, 90)


def test_run_on_distorted_frames_is_right_where_it_moves_the_corners_as_they_appear(capture):
    """A corner of a barrel of 3 % shows what an ideal lens images 1 / 0.97 times as far from the middle."""
    middle, corner = np.array([44.5, 29.5]), np.array([89.0, 59.0])
    capture.true["undistorted_corners"] = middle + (corners((60, 90)) - middle) / 0.97
    capture.write()
    assert evaluate(capture.folder, capture.truth).trajectory.mean_px > 0.1
    truth = load_truth(capture.truth)
    expected = apply(capture.true["homographies"], [middle, middle + (corner - middle) / 0.97])
    np.testing.assert_allclose(apply(truth.homographies, [middle, corner]), expected)
    capture.trajectory["homographies"] = normalised(capture.gauge @ truth.homographies)
    capture.write()
    assert evaluate(capture.folder, capture.truth).trajectory.max_px < 1e-6
