"""Poses of a run, read back from the files of other programs."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photonpano import InputError, OutputError
from photonpano.geometry import Camera, rotation_matrices
from photonpano_poses import export

SHAPE = (60, 90)
N_FRAMES = 20
LOCATED = np.arange(N_FRAMES) >= 3
CAMERA = Camera.of(80.0, SHAPE, (-0.1, 0.02, 0.001, -0.002))
ROTATIONS = rotation_matrices(np.linspace([-0.2, -3.0, 0.1], [0.3, 2.9, -0.1], N_FRAMES))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run folder of a turn by 340 degrees, whose first three frames are not located."""
    folder = tmp_path / "run"
    folder.mkdir()
    write(folder)
    (folder / "run.json").write_text(json.dumps({"spec": {}, "source": {"frame_rate_hz": 1000.0}}))
    return folder


def write(folder: Path, *, turns: bool = True, located: np.ndarray = LOCATED) -> None:
    camera = {"rotations": ROTATIONS, "camera_matrix": CAMERA.matrix, "distortion": CAMERA.distortion} if turns else {}
    homographies = CAMERA.homographies(ROTATIONS) if turns else np.tile(np.eye(3), (N_FRAMES, 1, 1))
    arrays = {"homographies": homographies, "canvas": np.eye(3), "frame_shape": np.array(SHAPE), "located": located}
    np.savez(folder / "trajectory.npz", std_px=np.full(N_FRAMES, 0.1), **arrays, **camera)


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def test_colmap_model_has_the_camera_and_rotations_to_each_camera(folder: Path, tmp_path: Path) -> None:
    export(folder, "colmap", tmp_path / "poses")
    [(number, model, *camera)] = rows(tmp_path / "poses" / "cameras.txt")
    assert (number, model, camera[:2]) == ("1", "OPENCV", ["90", "60"])
    np.testing.assert_allclose(np.array(camera[2:], float), [80, 80, 45, 30, -0.1, 0.02, 0.001, -0.002])
    images = rows(tmp_path / "poses" / "images.txt")
    assert [image[-1] for image in images[:2]] == ["frame_03.png", "frame_04.png"]
    numbers = np.array([image[1:8] for image in images], float)
    to_world = Rotation.from_quat(np.roll(numbers[:, :4], -1, axis=1)).inv().as_matrix()
    np.testing.assert_allclose(to_world, ROTATIONS[3:], atol=1e-12)
    np.testing.assert_array_equal(numbers[:, 4:], 0)
    assert rows(tmp_path / "poses" / "points3D.txt") == []


def test_pycolmap_reads_the_model_and_projects_as_the_camera_does(folder: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    export(folder, "colmap", tmp_path / "poses", every=5)
    model = pycolmap.Reconstruction(str(tmp_path / "poses"))
    assert sorted(image.name for image in model.images.values()) == [f"frame_{frame:02}.png" for frame in (3, 8, 13, 18)]
    ray = np.array([0.1, -0.2, 1.0])
    for image in model.images.values():
        frame = int(image.name[6:8])
        [pixel] = CAMERA.distorted(CAMERA.matrix[:2, :2] @ ray[:2] + CAMERA.matrix[:2, 2][None])
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), ROTATIONS[frame].T, atol=1e-9)
        np.testing.assert_allclose(image.camera.img_from_cam(ray), pixel + 0.5, atol=1e-9)


def test_nerfstudio_cameras_look_along_minus_z_in_a_world_whose_z_is_up(folder: Path, tmp_path: Path) -> None:
    export(folder, "nerfstudio", tmp_path / "poses")
    content = json.loads((tmp_path / "poses" / "transforms.json").read_text())
    assert {name: content[name] for name in ("camera_model", "fl_x", "cx", "cy", "w", "h", "k1", "p2")} == {
        **{"camera_model": "OPENCV", "fl_x": 80, "cx": 45, "cy": 30, "w": 90, "h": 60, "k1": -0.1, "p2": -0.002}
    }
    assert content["frames"][0]["file_path"] == "images/frame_03.png"
    for frame, each in zip(range(3, N_FRAMES), content["frames"], strict=True):
        pose = np.array(each["transform_matrix"])
        right, down, ahead = ROTATIONS[frame].T
        to_world = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        np.testing.assert_allclose(pose[:3, :3].T, [to_world @ right, to_world @ -down, to_world @ -ahead], atol=1e-12)
        np.testing.assert_array_equal(pose[:3, 3], 0)
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


def test_tum_trajectory_has_seconds_and_rotations_to_the_world(folder: Path, tmp_path: Path) -> None:
    exported = export(folder, "tum", tmp_path / "poses", every=2)
    numbers = np.array(rows(tmp_path / "poses" / "trajectory.txt"), float)
    assert exported.n_frames == len(numbers) == 9
    np.testing.assert_allclose(numbers[:, 0], np.arange(3, N_FRAMES, 2) / 1000)
    np.testing.assert_array_equal(numbers[:, 1:4], 0)
    np.testing.assert_allclose(Rotation.from_quat(numbers[:, 4:]).as_matrix(), ROTATIONS[3::2], atol=1e-12)


def without_rate(folder: Path) -> None:
    (folder / "run.json").write_text(json.dumps({"spec": {}, "source": {"frame_rate_hz": None}}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda folder: write(folder, turns=False),
            "{folder} knows homographies, and no rotations of a camera; run its spec again with --set motion.model=rotation",
        ),
        (lambda folder: write(folder, located=np.zeros(N_FRAMES, bool)), "the run located no frame, so that it has no poses"),
        (
            without_rate,
            "{folder} knows no frame rate, which the times of the format tum need; give it with --frame-rate",
        ),
    ],
    ids=["homographies", "nothing located", "no frame rate"],
)
def test_run_without_poses_or_times_is_refused(
    folder: Path, tmp_path: Path, change: Callable[[Path], object], message: str
) -> None:
    change(folder)
    with pytest.raises(InputError) as caught:
        export(folder, "tum", tmp_path / "poses")
    assert str(caught.value).endswith(message.format(folder=folder))
    assert not (tmp_path / "poses").exists()
    if change is without_rate:
        export(folder, "colmap", tmp_path / "poses")


def test_export_replaces_its_files_only_with_overwrite(folder: Path, tmp_path: Path) -> None:
    poses = tmp_path / "poses"
    export(folder, "colmap", poses, every=5)
    before = (poses / "images.txt").read_text()
    (poses / "mine.txt").write_text("mine")
    with pytest.raises(OutputError) as caught:
        export(folder, "colmap", poses)
    assert str(caught.value) == f"{poses} is there already; choose another name, or replace it with --overwrite"
    assert (poses / "images.txt").read_text() == before
    export(folder, "colmap", poses, overwrite=True)
    assert len((poses / "images.txt").read_text()) > len(before)
    assert (poses / "mine.txt").read_text() == "mine"
    with pytest.raises(OutputError, match="which is read, lies in it; choose another folder"):
        export(folder, "colmap", folder, overwrite=True)
