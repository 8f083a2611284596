"""Scores of poses against the true ones.

Absolute and relative errors are those of benchmarks of visual odometry (Sturm et al. 2012; the tool evo): the absolute
trajectory error (ATE) after the best similarity (Umeyama 1991), and the relative pose error (RPE) over a number of frames.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, InputError
from photonpano.evaluation.scores import of_focal_length
from photonpano.geometry import Camera, nearest_rotations, positions_of, rotation_vectors, transform_points
from photonpano.notebooks import facts
from photonpano.reading import read_arrays, read_picture
from photonpano.record.contents import require_one_run
from photonpano_poses.contract import are_rigid
from photonpano_poses.files import GRAPHICS, depth_name

POSES = "poses.npz"
_ORTHONORMAL = 1e-3  # maximum deviation of R R^T from the identity in a pose


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunPoses:
    """Content of `poses.npz` in a run folder.

    Poses are (T, 3, 4), NaN where a frame is not located. The expected errors, (T,), are those in a world where the path has
    the length 1.
    """

    camera: Camera
    camera_from_world: FloatArray
    located: BoolArray
    std_position: FloatArray
    std_rotation_deg: FloatArray
    frame_shape: tuple[int, int]


def has_poses(folder: Path) -> bool:
    """Return whether a run folder is that of a run with `pose`."""
    return (folder / POSES).exists()


def load_run_poses(folder: Path) -> RunPoses:
    """Read the poses of a run folder; `InputError` if the file is missing or damaged."""
    path = folder / POSES
    if not path.exists():
        raise InputError(f"{folder} has no {POSES}; give the folder of a finished run with `pose`")
    arrays = read_arrays(path, "the poses of a run")
    per_frame = ("located", "std_position", "std_rotation_deg")
    poses = _poses(path, arrays, ("camera_matrix", "distortion", "frame_shape", *per_frame))
    for name in per_frame:
        if arrays[name].shape != (len(poses),):
            raise InputError(f"{path}: {name} must have a number for each of {len(poses)} frames, got {arrays[name].shape}")
    located = arrays["located"].astype(bool)
    _require_rigid(path, poses[located])
    matrix, distortion = (arrays[name].astype(np.float64) for name in ("camera_matrix", "distortion"))
    if matrix.shape != (3, 3) or distortion.shape != (4,) or arrays["frame_shape"].shape != (2,):
        raise InputError(f"{path}: camera_matrix must be (3, 3), distortion (4,) and frame_shape (2,); run the spec again")
    height, width = (int(side) for side in arrays["frame_shape"])
    std_position, std_rotation_deg = (arrays[name].astype(np.float64) for name in per_frame[1:])
    return RunPoses(
        camera=Camera(matrix, distortion),
        camera_from_world=poses,
        located=located,
        std_position=std_position,
        std_rotation_deg=std_rotation_deg,
        frame_shape=(height, width),
    )


def load_true_poses(path: Path) -> tuple[FloatArray, float | None]:
    """Read true poses, `camera_from_world` (T, 3, 4) in m of an `.npz` archive, and the focal length; None if it has none.

    Raises `InputError` if the file is no such archive, or has no poses.
    """
    arrays = read_arrays(path, "a truth with poses")
    if "camera_from_world" not in arrays and "homographies" in arrays:
        raise InputError(
            f"{path} has homographies and no poses (camera_from_world): it is the truth of a flat scene, or of a camera that "
            "turns, and scores runs without `pose`"
        )
    poses = _poses(path, arrays)
    _require_rigid(path, poses)
    matrix = arrays.get("camera_matrix")
    return poses, None if matrix is None or matrix.shape != (3, 3) else float(matrix[0, 0])


def _poses(path: Path, arrays: Mapping[str, NDArray[Any]], others: tuple[str, ...] = ()) -> FloatArray:
    missing = [name for name in ("camera_from_world", *others) if name not in arrays]
    if missing:
        held = ", ".join(name or "an array without a name" for name in arrays) or "nothing"
        raise InputError(f"{path} lacks {' and '.join(missing)}; it contains {held}")
    poses = arrays["camera_from_world"]
    if poses.ndim != 3 or poses.shape[1:] != (3, 4) or not len(poses) or poses.dtype.kind not in "fiu":
        raise InputError(f"{path}: camera_from_world must be numbers of the shape (frames, 3, 4), got {poses.shape}")
    return poses.astype(np.float64)


def _require_rigid(path: Path, poses: FloatArray) -> None:
    if not are_rigid(poses, _ORTHONORMAL).all():
        raise InputError(f"{path}: camera_from_world must be finite rotations and translations")


_RPE_SHARE = 0.01  # step of the relative error, as a fraction of the frames


@dataclass(frozen=True, slots=True)
class DepthScore:
    """Errors of the pixels of depth maps, after the best similarity of the positions of the cameras.

    Attributes:
        error: median of the errors of the depth, relative to the true one.
        known_share: share of the pixels of the maps whose depth is known.
        within_std_shares: shares of these whose error is within 1, 2 and 3 expected ones.
    """

    error: float
    known_share: float
    within_std_shares: tuple[float, float, float]

    def rows(self) -> list[tuple[str, str]]:
        """Return the scores with their names, for people."""
        shares = ", ".join(f"{100 * share:.1f} %" for share in self.within_std_shares)
        found = f"{100 * self.error:.2f} %, of {100 * self.known_share:.0f} % of the pixels"
        return [("error of depth, median", found), ("depths within 1, 2, 3 std", shares)]


@dataclass(frozen=True, slots=True, eq=False)
class PoseScore:
    """Errors of poses over the located frames, after the best similarity of their positions.

    Attributes:
        errors_m: (T,) distance of each camera from its true position; NaN where not located.
        errors_deg: (T,) angle between the found and the true rotation, after the same similarity; NaN where not located.
        ate_m: absolute trajectory error: root mean square of `errors_m`.
        ate_share: the same as a share of the length of the true path of the located frames.
        rotation_deg: root mean square of `errors_deg`.
        turns_deg: the same after the best common rotation instead. Positions near a line hardly tell how the world lies.
        rpe_frames: frames over which relative errors are taken.
        rpe_m: root mean square error of the motion over that many frames; None if no two located frames are that far apart.
        rpe_deg: root mean square error of the turn over that many frames.
        located_share: share of the located frames, 0 to 1.
        honest_shares: shares of the located frames whose position error is within 1, 2 and 3 expected errors; None if the run
            knows none.
        std_ratio: root mean square of the errors of positions, in units of the expected ones; None if the run knows none.
        focal_error: error of the focal length, relative to the true one; None if that is not known.
        depth: of the depth maps; None if the run has none, or the truth has no depth.
    """

    errors_m: FloatArray
    errors_deg: FloatArray
    ate_m: float
    ate_share: float
    rotation_deg: float
    turns_deg: float
    rpe_frames: int
    rpe_m: float | None
    rpe_deg: float | None
    located_share: float
    honest_shares: tuple[float, float, float] | None
    std_ratio: float | None
    focal_error: float | None = None
    depth: DepthScore | None = None

    def rows(self) -> list[tuple[str, str]]:
        """Return the scores with their names, for people."""
        rows = [
            ("position error (ATE), rms", f"{self.ate_m:.4g} m, {100 * self.ate_share:.3f} % of the path"),
            ("rotation error, rms", f"{self.rotation_deg:.4f} degrees, {self.turns_deg:.4f} after the best common rotation"),
        ]
        if self.rpe_m is not None:
            rows.append((f"RPE over {self.rpe_frames} frames, rms", f"{self.rpe_m:.4g} m, {self.rpe_deg:.4f} degrees"))
        rows.append(("frames located", f"{100 * self.located_share:.1f} %"))
        if self.honest_shares is not None:
            shares = ", ".join(f"{100 * share:.1f} %" for share in self.honest_shares)
            rows += [("within 1, 2, 3 std_position", shares), ("error over std_position, rms", f"{self.std_ratio:.2f}")]
        if self.focal_error is not None:
            rows.append(("focal length", of_focal_length(self.focal_error)))
        return rows if self.depth is None else rows + self.depth.rows()

    def data(self) -> dict[str, Any]:
        """Return the scores with their names, for programs."""
        named = {each.name: each.name for each in fields(self)} | {"honest_shares": "within_std_shares"}
        depth = None if self.depth is None else asdict(self.depth)
        found = {named[name]: getattr(self, name) for name in named if name not in ("errors_m", "errors_deg")}
        return {**found, "depth": depth}

    def figures(self) -> dict[str, Any]:
        """Return what the summary of a batch shows."""
        return {"true_position_error": self.ate_share}

    def _repr_html_(self) -> str:
        return facts(self.rows())


def evaluate_poses(run_folder: Path | str, truth: Path | str, rpe_frames: int | None = None) -> PoseScore:
    """Score the poses of a run against the truth of its capture.

    Args:
        run_folder: written by `run`, with `pose`.
        truth: the `.truth.npz` that was simulated with the capture; `camera_from_world` in m.
        rpe_frames: frames over which the relative error is taken; by default 1 % of the capture.

    Raises:
        InputError: a file is missing or damaged, has no poses, or run and truth are not of the same capture.
        ValueError: `rpe_frames` is below 1.
    """
    folder, truth = Path(run_folder), Path(truth)
    if rpe_frames is not None and rpe_frames < 1:
        raise ValueError(f"rpe_frames must be at least 1, got {rpe_frames}")
    require_one_run(folder, ["poses.npz"])
    run, (true, focal_px) = load_run_poses(folder), load_true_poses(truth)
    n_frames, true_frames = len(run.located), len(true)
    if n_frames != true_frames:
        raise InputError(
            f"{truth} is the truth of {true_frames} frames, but the run in {folder} has {n_frames}; they belong to different "
            "captures"
        )
    frames = rpe_frames or max(1, round(_RPE_SHARE * n_frames))
    try:
        score = pose_errors(run.camera_from_world, true, run.located, frames, run.std_position)
    except ValueError as error:
        raise InputError(f"{folder} and {truth} cannot be compared: {error}") from error
    score = replace(score, depth=_depth_score(folder, run, truth))
    return score if focal_px is None else replace(score, focal_error=run.camera.focal_px / focal_px - 1)


def _depth_score(folder: Path, run: RunPoses, truth: Path) -> DepthScore | None:
    """Compare depth maps with the true depth of frames near them, whose pixels show the same if a map is right.

    A map is laid where its camera truly was, so that poses count by their scale alone.
    """
    if not (folder / "depth").exists():
        return None
    arrays = read_arrays(truth, "a truth with poses")
    if not {"depths", "depth_frames", "camera_matrix"} <= arrays.keys():
        return None
    if arrays["depths"].shape[1:] != run.frame_shape:
        raise InputError(f"{truth} has depths of frames of another size than those of the run in {folder}")
    true, frames = arrays["camera_from_world"], arrays["depth_frames"]
    scale, *_ = align_positions(positions_of(run.camera_from_world[run.located]), positions_of(true[run.located]))
    camera = Camera(arrays["camera_matrix"], arrays.get("distortion", np.zeros(4)))
    rays = run.camera.directions(np.indices(run.frame_shape)[::-1].reshape(2, -1).T)
    errors, stds, known_shares = [], [], []
    for view in json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]:
        files = [folder / depth_name(Path(view["file_path"]).name, suffix) for suffix in ("", "_std")]
        if not files[0].exists():
            continue
        maps = (read_picture(file, "is no depth map; run the spec again", cv2.IMREAD_UNCHANGED) for file in files)
        depths, std = (each.ravel() for each in maps)
        known, pose = depths > 0, np.linalg.inv(np.array(view["transform_matrix"]))
        here = int(np.nanargmin(np.linalg.norm(run.camera_from_world - GRAPHICS @ pose[:3], axis=(1, 2))))
        nearest = int(np.abs(frames - here).argmin())
        (motion,) = _relative(true[here, None], true[frames[nearest], None])
        points = scale * rays[known] * (depths / rays[:, 2])[known, None] @ motion[:, :3].T + motion[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = camera.distorted(transform_points(camera.matrix, points[:, :2] / points[:, 2:])).round()
        inside = (points[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < run.frame_shape[::-1]).all(axis=1)
        x, y = pixels[inside].astype(int).T
        errors.append(np.abs(points[inside, 2] / arrays["depths"][nearest, y, x] - 1))
        stds.append((std[known] / depths[known])[inside])
        known_shares.append(known.mean())
    off, expected = np.concatenate(errors), np.concatenate(stds)
    one, two, three = (float((off <= times * expected).mean()) for times in (1, 2, 3))
    return DepthScore(float(np.median(off)), float(np.mean(known_shares)), (one, two, three))


def pose_errors(
    found: FloatArray, true: FloatArray, located: BoolArray, rpe_frames: int, std_position: FloatArray | None = None
) -> PoseScore:
    """Score poses (T, 3, 4), world to camera, of a world of any scale against the true ones in m, at the `located` frames.

    The relative error is that of every pair of located frames that are `rpe_frames` apart. `std_position` is (T,), in units of
    the found world; None or not finite if not known. Raises `ValueError` for positions that cannot be aligned.
    """
    scale, rotation, shift = align_positions(positions_of(found[located]), positions_of(true[located]))
    aligned = np.full((len(found), 3, 4), np.nan)
    aligned[:, :, :3] = found[:, :, :3] @ rotation.T
    aligned[:, :, 3] = scale * found[:, :, 3] - aligned[:, :, :3] @ shift
    places, true_places = positions_of(aligned), positions_of(true)
    errors_m = np.where(located, np.linalg.norm(places - true_places, axis=1), np.nan)
    errors_deg = np.full(len(found), np.nan)
    errors_deg[located] = _angles(aligned[located, :, :3] @ np.swapaxes(true[located, :, :3], 1, 2))
    path_m = float(np.linalg.norm(np.diff(true_places[located], axis=0), axis=1).sum())
    ate_m = _rms(errors_m[located])
    shares, ratio = None, None
    if std_position is not None and np.isfinite(std_m := scale * std_position[located]).all() and (std_m > 0).all():
        one, two, three = (float((errors_m[located] <= times * std_m).mean()) for times in (1, 2, 3))
        shares, ratio = (one, two, three), ate_m / _rms(std_m)
    first = np.flatnonzero(located[:-rpe_frames] & located[rpe_frames:])
    steps = (_relative(poses[first], poses[first + rpe_frames]) for poses in (true, aligned))
    apart = _relative(*steps) if len(first) else None
    worlds = np.swapaxes(true[located, :, :3], 1, 2) @ found[located, :, :3]
    return PoseScore(
        errors_m=errors_m,
        errors_deg=errors_deg,
        ate_m=ate_m,
        ate_share=ate_m / path_m,
        rotation_deg=_rms(errors_deg[located]),
        turns_deg=_rms(_angles(worlds @ nearest_rotations(worlds.sum(axis=0)).T)),
        rpe_frames=rpe_frames,
        rpe_m=None if apart is None else _rms(np.linalg.norm(apart[:, :, 3], axis=1)),
        rpe_deg=None if apart is None else _rms(_angles(apart[:, :, :3])),
        located_share=float(located.mean()),
        honest_shares=shares,
        std_ratio=ratio,
    )


def align_positions(found: FloatArray, true: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return scale, rotation and shift that bring (N, 3) found positions nearest to the true ones (Umeyama 1991).

    Raises `ValueError` if there are fewer than three positions, or they are all the same.
    """
    if len(found) < 3:
        raise ValueError(f"{len(found)} located frames; at least 3 are needed to align two worlds")
    middles = found.mean(axis=0), true.mean(axis=0)
    here, there = found - middles[0], true - middles[1]
    if not here.any() or not there.any():
        raise ValueError("all positions are the same, so that the worlds have no common scale")
    left, strengths, right = np.linalg.svd(there.T @ here)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * signs) @ right
    scale = float((strengths * signs).sum() / (here**2).sum())
    return scale, rotation, middles[1] - scale * rotation @ middles[0]


def _relative(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return `other` after the inverse of `one`, both (N, 3, 4)."""
    rotations = other[:, :, :3] @ np.swapaxes(one[:, :, :3], 1, 2)
    shifts = other[:, :, 3] - np.einsum("nij,nj->ni", rotations, one[:, :, 3])
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def _angles(rotations: FloatArray) -> FloatArray:
    return np.asarray(np.rad2deg(np.linalg.norm(rotation_vectors(rotations), axis=-1)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
