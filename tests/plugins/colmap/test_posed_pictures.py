"""Pictures of a camera that travels, with poses and points that COLMAP reads."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import Config, FrameSpan, discover, run
from photonpano.geometry import Camera, camera_matrix, transform_points
from photonpano.specs import parse_spec
from photonpano.testing.captures import Scene
from photonpano_poses import PosedView, PoseEstimate, PoseEstimatorContribution, ScenePoints, export
from photonpano_poses.testing import FOCAL_PX, N_POSES, POSES_SHAPE, true_poses

pycolmap = pytest.importorskip("pycolmap")

LENS = (-0.05, 0.0, 0.0, 0.0)
CAMERA = Camera(camera_matrix(FOCAL_PX, (79.5, 63.5)), np.array(LENS))
GROUP = 20
SCENE = Scene(3)


class Keys(Config):
    """No keys."""


def truth(source: Any, camera: Any, progress: Any) -> PoseEstimate:
    """Return the true poses of exposures without noise of a plane at a depth of 4 m, and points of it."""
    poses, points, views = true_poses(), np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 4], (40, 3)), []
    pixels = CAMERA.ideal(np.stack(np.meshgrid(np.arange(POSES_SHAPE[1]), np.arange(POSES_SHAPE[0])), axis=-1))
    for span in FrameSpan(0, N_POSES).blocks(GROUP):
        pose = poses[span.start]
        seen = (points @ pose[:, :3].T + pose[:, 3]) @ CAMERA.matrix.T
        xy = CAMERA.distorted(seen[:, :2] / seen[:, 2:])
        to_plane = np.linalg.inv(CAMERA.matrix @ (pose @ np.array([[1, 0, 0], [0, 1, 0], [0, 0, 4], [0, 0, 1]])))
        flux = SCENE.flux(FOCAL_PX / 4 * transform_points(to_plane, pixels)).astype(np.float32)
        views.append(PosedView(span, span.start, pose, np.arange(len(points)), xy, lambda flux=flux: flux))
    ones, grey = np.ones(N_POSES), np.linspace(0.1, 1, len(points)).astype(np.float32)
    return PoseEstimate(
        *(CAMERA.matrix, CAMERA.distortion, 0.0, poses, ones > 0, 1e-4 * ones, ones, ScenePoints(points, grey)), tuple(views)
    )


def posed(folder: Path, exposures: bool = True) -> Path:
    bits = np.random.default_rng(0).integers(0, 256, (N_POSES, POSES_SHAPE[0], POSES_SHAPE[1] // 8), np.uint8)
    np.save(folder / "cube.npy", bits)
    estimator = SimpleNamespace(estimate=truth)
    toy = PoseEstimatorContribution(name="toy", summary="Toy", config=Keys, build=lambda *_: estimator)
    source = {"use": "packed-npy", "with": {"path": str(folder / "cube.npy")}}
    spec = {"version": 1, "source": source, "pose": "toy", "output": {"exposures": exposures}}
    return run(parse_spec(spec, output=folder / "run", catalog=discover().including(toy))).directory


@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("undistorted", [False, True])
def test_features_of_pictures_are_triangulated_with_the_poses(tmp_path: Path, undistorted: bool) -> None:
    scene = tmp_path / "scene"
    found = export(posed(tmp_path), "colmap", scene, images=True, undistorted=undistorted)
    assert (found.n_frames, found.pictures) == (N_POSES // GROUP, scene / "images")
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.compute_mean_reprojection_error() < 1e-3
    camera, database = model.cameras[1], tmp_path / "features.db"
    numbers = ",".join(map(repr, camera.params.tolist()))
    options = pycolmap.ImageReaderOptions(camera_model=camera.model.name, camera_params=numbers)
    one_by_one = pycolmap.FeatureExtractionOptions(num_threads=1)  # so that images are numbered as in the model
    single, cpu = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
    pycolmap.extract_features(
        database, scene / "images", camera_mode=single, reader_options=options, extraction_options=one_by_one, device=cpu
    )
    pycolmap.match_exhaustive(database, device=cpu)
    (tmp_path / "found").mkdir()
    points = pycolmap.triangulate_points(model, database, scene / "images", tmp_path / "found", clear_points=True).points3D
    assert len(points) > 50
    assert np.mean([point.error for point in points.values()]) < 0.3
