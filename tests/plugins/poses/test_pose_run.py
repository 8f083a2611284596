"""Runs with `pose`, with a pose estimator that knows the poses."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import photonpano
import photonpano_poses
from photonpano import Config, FrameSpan, InputError, PluginError, Reason, discover, hookimpl, run
from photonpano.pipeline.run import RunResult
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import changed_files
from photonpano.specs import Plan, parse_spec
from photonpano_poses import CameraGuess, DepthMap, LostFrames, PosedView, PoseEstimate, PoseEstimatorContribution, ScenePoints

N_FRAMES, LOST = 300, FrameSpan(280, 300)
CATALOG = discover()


class Keys(Config):
    """No keys."""


def estimate_of(source: Any, camera: Any) -> PoseEstimate:
    """Return the poses of a camera that moves to the right by 1 % of a unit a frame and turns; the last frames are lost."""
    instants = np.arange(N_FRAMES)
    rotations = Rotation.from_rotvec(np.outer(instants, [0, 1e-3, 2e-4])).as_matrix()
    places = np.stack([0.01 * instants + 5, 0.1 * np.sin(instants / 50), np.zeros(N_FRAMES)], axis=1)
    poses = np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)
    located = instants < LOST.start
    nan = np.where(located, 1.0, np.nan)
    matrix = np.array([[camera.focal_px or 150.0, 0, 79.5], [0, camera.focal_px or 150.0, 63.5], [0, 0, 1]])
    points = np.random.default_rng(0).uniform([-2, -2, 4], [12, 2, 9], (60, 3))
    views = []
    for span in FrameSpan(0, 250).blocks(50):
        pose = poses[int(span.centre)]
        seen = points @ pose[:, :3].T + pose[:, 3]
        shown = np.flatnonzero(seen[:, 2] > 1)
        xy = (seen[shown] @ matrix.T)[:, :2] / seen[shown, 2:]

        def flux(span: FrameSpan = span) -> Any:
            return source.response.flux((source.counts(span) / len(span)).astype(np.float32), len(span))

        views.append(PosedView(span, int(span.centre), pose, shown, xy, flux))
    return PoseEstimate(
        matrix,
        np.array(camera.distortion, float),
        0.0,
        poses * nan[:, None, None],
        located,
        0.02 * nan,
        0.1 * nan,
        ScenePoints(points, np.linspace(0.1, 1, len(points)).astype(np.float32)),
        tuple(views),
        (LostFrames(LOST, "the exposure shows 3 points, fewer than 12"),),
        ({"exposures": 5, "median_parallax_deg": 4.25},),
    )


def plan_into(directory: Path, source: Any, change: Callable[[PoseEstimate], Any] = lambda it: it, **sections: Any) -> Plan:
    """Make the plan of a run with a pose estimator whose estimate is changed."""

    def estimate(source: Any, camera: Any, progress: Any) -> Any:
        with progress.stage("poses", 1, "capture") as advance:
            advance(1)
        return change(estimate_of(source, camera))

    toy = PoseEstimatorContribution(name="toy", summary="Toy", config=Keys, build=lambda *_: SimpleNamespace(estimate=estimate))
    spec = {"version": 1, "source": source, "pose": "toy", **sections}
    return parse_spec(spec, output=directory, catalog=CATALOG.including(toy))


@pytest.fixture
def plan_of(small_spec: dict[str, Any], tmp_path: Path) -> Callable[..., Plan]:
    return partial(plan_into, tmp_path / "run", small_spec["source"])


@pytest.fixture(scope="module")
def finished(small_spec: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run with exposures. Tests must not change its folder."""
    return run(plan_into(tmp_path_factory.mktemp("poses") / "run", small_spec["source"], output={"exposures": True}))


def test_pose_run_writes_exactly_the_promised_files(finished: RunResult) -> None:
    record, folder = finished.record, finished.directory
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    model = {f"sparse/{name}.txt" for name in ("cameras", "images", "points3D")}
    pictures = {f"images/exposure_{start:03}.png" for start in range(0, 250, 50)}
    others = {"poses.npz", "transforms.json", "points.ply", "poses.tum", "run.json", "report.html"}
    assert files == model | pictures | others
    assert set(record["files"]) == files - {"run.json"}
    assert changed_files(folder) == []
    assert photonpano.verify(folder).n_files == len(files) - 1
    assert record == json.loads((folder / "run.json").read_text())


def test_world_begins_at_the_first_camera_and_its_path_has_length_1(finished: RunResult) -> None:
    with np.load(finished.directory / "poses.npz") as archive:
        found = dict(archive)
    poses, located = found["camera_from_world"], found["located"]
    np.testing.assert_array_equal(located, np.arange(N_FRAMES) < LOST.start)
    assert np.isnan(poses[~located]).all()
    np.testing.assert_allclose(poses[0], np.eye(3, 4), atol=1e-12)
    places = -np.einsum("nji,nj->ni", poses[located, :, :3], poses[located, :, 3])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.sum() == pytest.approx(1)
    it = estimate_of(None, CameraGuess()).camera_from_world[located]
    true = -np.einsum("nji,nj->ni", it[:, :, :3], it[:, :, 3])
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    np.testing.assert_allclose(steps * length, np.linalg.norm(np.diff(true, axis=0), axis=1), rtol=1e-9)
    np.testing.assert_allclose(found["std_position"][located] * length, 0.02)
    np.testing.assert_array_equal(found["frame_shape"], [128, 160])


def test_colmap_reads_the_sparse_model_and_its_points_reproject(plan_of: Callable[..., Plan], tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    record = run(plan_of(camera={"focal_px": 140, "centre_px": [79.5, 63.5], "distortion": {"k1": 0.01}})).record
    model = pycolmap.Reconstruction(str(tmp_path / "run" / "sparse"))
    assert record["poses"]["camera"]["focal_px"] == 140
    assert model.num_reg_images() == record["poses"]["exposures"] == 5
    assert {image.name for image in model.images.values()} == {f"exposure_{start:03}.png" for start in range(0, 250, 50)}
    [camera] = model.cameras.values()
    assert camera.params.tolist() == [140, 140, 80, 64, 0.01, 0, 0, 0]
    errors = []
    for image in model.images.values():
        for seen in image.points2D:
            # the toy forgot the distortion of 1 %
            ideal = image.cam_from_world() * model.points3D[seen.point3D_id].xyz
            errors.append(np.abs(140 * ideal[:2] / ideal[2] + (80, 64) - seen.xy).max())
    assert len(errors) == sum(len(point.track.elements) for point in model.points3D.values()) > 50
    assert max(errors) < 1e-6
    assert model.points3D[1].error > 0


def test_other_files_hold_the_same_poses(finished: RunResult, tmp_path: Path) -> None:
    folder = finished.directory
    poses = np.load(folder / "poses.npz")["camera_from_world"]
    tum = np.loadtxt(folder / "poses.tum")
    assert len(tum) == LOST.start
    np.testing.assert_allclose(tum[:, 0], np.arange(LOST.start) / 96800, rtol=1e-12)
    rotation = Rotation.from_quat(tum[70, 4:]).as_matrix().T
    np.testing.assert_allclose(rotation, poses[70, :, :3], atol=1e-12)
    np.testing.assert_allclose(-rotation @ tum[70, 1:4], poses[70, :, 3], atol=1e-12)
    content = json.loads((folder / "transforms.json").read_text())
    assert content["ply_file_path"] == "points.ply"
    view = content["frames"][1]
    assert view["file_path"] == "images/exposure_050.png"
    to_world = np.array(view["transform_matrix"]) @ np.diag([1, -1, -1, 1])
    np.testing.assert_allclose(np.linalg.inv(to_world)[:3], poses[74], atol=1e-9)
    assert (folder / "points.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 60\n")
    exported = photonpano_poses.export(folder, "tum", tmp_path / "poses", every=2)
    assert exported.n_frames == LOST.start / 2
    np.testing.assert_allclose(np.loadtxt(tmp_path / "poses" / "trajectory.txt"), tum[::2])
    with pytest.raises(InputError, match="is of a camera that travels, and Hugin knows cameras that only turn; choose another"):
        photonpano_poses.export(folder, "pto", tmp_path / "project", images=True)


def with_flat_depth(estimate: PoseEstimate) -> PoseEstimate:
    """Give each view a wall at the depth of 5, of which the upper half is not known."""
    inverse_depth = np.full((128, 160), 0.2, np.float32)
    inverse_depth[:64] = np.nan
    std, flux = inverse_depth / 20, np.full((128, 160), 0.5, np.float32)
    return replace(estimate, depth=tuple(DepthMap(view, inverse_depth, std, flux, flux, flux) for view in range(5)))


def test_depth_is_written_for_other_programs(plan_of: Callable[..., Plan], tmp_path: Path) -> None:
    record, folder = run(plan_of(with_flat_depth)).record, tmp_path / "run"
    poses = estimate_of(None, CameraGuess()).camera_from_world[: LOST.start]
    length = np.linalg.norm(np.diff(-np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]), axis=0), axis=1).sum()
    depth, std = (cv2.imread(str(folder / "depth" / f"exposure_050{end}.tif"), cv2.IMREAD_ANYDEPTH) for end in ("", "_std"))
    assert depth.dtype == std.dtype == np.float32
    np.testing.assert_array_equal(depth[:64], 0)
    np.testing.assert_allclose(depth[64:], 5 / length, rtol=1e-5)
    np.testing.assert_allclose(std[64:], 0.25 / length, rtol=1e-5)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert [each["depth_file_path"] for each in frames] == [f"depth/exposure_{start:03}.tif" for start in range(0, 250, 50)]
    assert record["poses"]["depth"]["share"] == 0.5
    for name, last in (("points.ply", b"property float std\n"), ("splats.ply", b"property float rot_3\n")):
        header, body = (folder / name).read_bytes().split(b"end_header\n", 1)
        assert header.endswith(last)
        number = int(header.split(b"element vertex ")[1].split()[0])
        assert 64 * 160 < number < 5 * 64 * 160
        assert len(body) == number * sum(4 if line.startswith(b"property float") else 1 for line in header.split(b"\n")[3:-1])
    assert all(
        text in (folder / "report.html").read_text()
        for text in ("viewpoint", 'data-source="data:image/png', "pixels with depth")
    )
    with pytest.raises(PluginError, match="that of the view 9, and there are 5"):
        run(plan_of(lambda it: replace(it, depth=(replace(with_flat_depth(it).depth[0], view=9),))), overwrite=True)


def test_doubts_and_lost_frames_are_in_record_report_and_warnings(plan_of: Callable[..., Plan], tmp_path: Path) -> None:
    doubt = Reason("the points lie on a plane", 120.0, 100.0, "width over depth", "move more")
    result = run(plan_of(lambda it: replace(it, doubts=(doubt,), residual_ratio=0.4)))
    record = result.record
    assert result.verdict is not None
    assert (result.verdict.status, result.verdict.reasons[0]) == ("doubtful", doubt)
    assert record["verdict"] is not None
    assert (record["verdict"]["status"], record["verdict"]["residual_ratio"]) == ("doubtful", 0.4)
    assert record["poses"]["doubts"] == [str(reason) for reason in result.verdict.reasons]
    assert record["poses"]["lost"] == [{"frames": [280, 300], "reason": "the exposure shows 3 points, fewer than 12"}]
    assert record["warnings"] == [
        "20 of 300 frames have no pose (frames 280 to 299: the exposure shows 3 points, fewer than 12)",
    ]
    page = (tmp_path / "run" / "report.html").read_text()
    assert page.count("The points lie on a plane") == 1
    assert all(text in page for text in ("280 to 299", "median parallax (°)", "from above", "doubtful", "pose-errors-"))


def test_resume_of_finished_poses_returns_them_and_of_changed_ones_begins_anew_for_observers_too(
    plan_of: Callable[..., Plan], tmp_path: Path
) -> None:
    first = run(plan_of())
    again = run(plan_of(), resume=True)
    assert (again.was_finished, again.record) == (True, first.record)
    (tmp_path / "run" / "poses.npz").unlink()
    told: list[Any] = []
    watcher: Any = ModuleType("watcher")
    watcher.photonpano_stage_finished = hookimpl(
        lambda level, stage, seconds, summary: told.append((level, stage, seconds >= 0, dict(summary)))
    )
    anew = run(replace(plan_of(), observers=Catalog().including(watcher).observers), resume=True)
    assert anew.was_finished is False
    assert told == [(None, "pose", True, {"located": LOST.start, "exposures": 5, "points": 60})]
    for options in ({"keep_work": True}, {"from_level": 2}):
        with pytest.raises(InputError, match="a run with `pose` has no levels to keep"):
            run(plan_of(), **options)


def test_explain_and_check_describe_a_spec_with_pose(plan_of: Callable[..., Plan]) -> None:
    text = photonpano.explain(plan := plan_of(), catalog=CATALOG.including(plan_of().finder.contribution))
    assert "pose:\n  use: toy" in text
    assert "levels" not in text
    assert plan.levels == plan.refine == ()
    with pytest.raises(InputError, match="a forecast is of panoramas"):
        photonpano.explain(plan, with_forecast=True)
