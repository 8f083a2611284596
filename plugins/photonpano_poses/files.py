"""The poses of a camera: their gauge, which is free and chosen here, and the files in which other programs read them.

Convention:
    Rotations map directions of a camera to those of the world, x right, y down, z ahead; positions are those of the camera in
    the world. For a camera that only turns, the world is the reference camera, and all positions are zero. Integers are pixel
    centres here; COLMAP and nerfstudio add 0.5.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, FluxImage, InputError, LocationError
from photonpano.geometry import Camera, Canvas, positions_of
from photonpano.photometry import srgb_to_linear, tone_mapped
from photonpano_poses.contract import PoseEstimate, ScenePoints

if TYPE_CHECKING:  # it compiles loops over pixels
    from photonpano_poses.depth import Surface

GRAPHICS = np.diag([1.0, -1.0, -1.0])  # axes of a camera in OpenGL, x right, y up, z back, to ours
_WHITE_QUANTILE = 0.995  # quantile of the flux of points, or of an exposure, that is white
_MIDDLE_GREY = 128
# Directions of the reference camera to a world whose z is up, in which that camera looks along y.
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Poses:
    """Where a camera was, and where it looked."""

    camera: Camera  # of all images
    frame_shape: tuple[int, int]  # (height, width) of an image
    names: tuple[str, ...]  # file names of N images
    rotations: FloatArray  # (N, 3, 3), directions of each camera to those of the world
    seconds: FloatArray  # (N,) times of the images
    positions: FloatArray | None = None  # (N, 3) of the cameras in the world; None if the camera only turned
    # for each image the indices of K points and where it shows them, (K, 2); empty if they are not known
    observed: tuple[tuple[NDArray[np.intp], FloatArray], ...] = ()
    points: ScenePoints | None = None  # of the scene; None if they are not known
    have_depth: bool = False  # whether there is a depth map for each image
    canvas: Canvas | None = None  # of the panorama of a camera that only turned; None if it is not needed

    @property
    def places(self) -> FloatArray:
        """(N, 3) positions of the cameras, zeros if the camera only turned."""
        return np.zeros((len(self.names), 3)) if self.positions is None else self.positions


def depth_name(name: str, suffix: str = "") -> str:
    """Return the file of the depth map of an image, in a run folder."""
    return f"depth/{Path(name).stem}{suffix}.tif"


def colmap(poses: Poses) -> dict[str, str]:
    """Return the text files of a COLMAP model by name: one camera, the images, and the points that are known.

    The camera is OPENCV, or PINHOLE without distortion, which is all that many readers know.
    """
    camera, (height, width) = poses.camera, poses.frame_shape
    model, distortion = ("OPENCV", camera.distortion) if camera.distorts else ("PINHOLE", ())
    centre = (each + 0.5 for each in camera.centre_px)
    numbers = (camera.matrix[0, 0], camera.matrix[1, 1], *centre, *distortion)
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points"]
    from_world = np.swapaxes(poses.rotations, -1, -2)
    moved = -(from_world @ poses.places[..., None])[..., 0] + 0.0  # without negative zeros
    observed = poses.observed or ((np.zeros(0, np.intp), np.zeros((0, 2))),) * len(poses.names)
    tracks: dict[int, list[str]] = {}
    rows = zip(poses.names, _quaternions(from_world), moved, observed, strict=True)
    for place, (name, (x, y, z, w), shift, (points, xy)) in enumerate(rows, start=1):
        seen = [f"{_line(*position)} {point + 1}" for point, position in zip(points.tolist(), xy + 0.5, strict=True)]
        images += [f"{place} {_line(w, x, y, z, *shift)} 1 {name}", " ".join(seen)]
        for index, point in enumerate(points.tolist()):
            tracks.setdefault(point, []).append(f"{place} {index}")
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY; of OPENCV also K1, K2, P1, P2"]
    cameras.append(f"1 {model} {width} {height} {_line(*numbers)}")
    cloud = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK"]
    if poses.points is not None:
        greys, errors = greys_of(poses.points.flux), point_errors(poses)
        for point, track in sorted(tracks.items()):
            position, grey = _line(*poses.points.positions[point]), greys[point]
            cloud.append(f"{point + 1} {position} {grey} {grey} {grey} {_line(errors[point])} {' '.join(track)}")
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": cloud}
    return {name: "\n".join(lines) + "\n" for name, lines in files.items()}


def nerfstudio(poses: Poses) -> dict[str, str]:
    """Return the `transforms.json` of nerfstudio: cameras have the axes of OpenGL.

    For a camera that only turned, z of the world is up. Otherwise the world is that of `points.ply`, which the file names if
    points are known; nerfstudio turns it upright itself.
    """
    camera, (height, width) = poses.camera, poses.frame_shape
    poses_4x4 = np.tile(np.eye(4), (len(poses.names), 1, 1))
    poses_4x4[:, :3, :3] = (_UPRIGHT if poses.positions is None else np.eye(3)) @ poses.rotations @ GRAPHICS
    poses_4x4[:, :3, 3] = poses.places
    content = {
        "camera_model": "OPENCV",
        "fl_x": camera.matrix[0, 0],
        "fl_y": camera.matrix[1, 1],
        "cx": camera.centre_px[0] + 0.5,
        "cy": camera.centre_px[1] + 0.5,
        "w": width,
        "h": height,
        **dict(zip(("k1", "k2", "p1", "p2"), camera.distortion.tolist(), strict=True)),
        **({} if poses.points is None else {"ply_file_path": "points.ply"}),
        "frames": [
            {
                "file_path": f"images/{name}",
                "transform_matrix": pose.tolist(),
                **({"depth_file_path": depth_name(name)} if poses.have_depth else {}),
            }
            for name, pose in zip(poses.names, poses_4x4, strict=True)
        ],
    }
    return {"transforms.json": json.dumps(content, indent=1) + "\n"}


def tum(poses: Poses) -> dict[str, str]:
    """Return the trajectory as the TUM benchmark has it: seconds, position, quaternion of the camera in the world."""
    rows = zip(poses.seconds, poses.places, _quaternions(poses.rotations), strict=True)
    lines = ["# seconds tx ty tz qx qy qz qw", *(f"{_line(second, *place, *q)}" for second, place, q in rows)]
    return {"trajectory.txt": "\n".join(lines) + "\n"}


def openmvg(poses: Poses) -> dict[str, str]:
    """Return the `sfm_data.json` of OpenMVG: views, one camera, poses, and the points that are known.

    Integers are pixel centres in OpenMVG, too. Ids with bit 31 set are those of the objects that cereal, its library, reads.
    """
    camera, (height, width) = poses.camera, poses.frame_shape
    new = 2**31 + 1

    def pointer(number: int, data: dict[str, Any]) -> dict[str, Any]:
        return {"ptr_wrapper": {"id": new + number, "data": data}}

    size, (k1, k2, p1, p2) = {"width": width, "height": height}, camera.distortion.tolist()
    pinhole = {**size, "focal_length": camera.focal_px, "principal_point": list(camera.centre_px)}
    intrinsic = pointer(len(poses.names), {"value0": pinhole, "disto_t2": [k1, k2, 0.0, p1, p2]})
    views, seen = [], dict[int, list[dict[str, Any]]]()
    for place, name in enumerate(poses.names):
        data = {"local_path": "", "filename": name, **size, "id_view": place, "id_intrinsic": 0, "id_pose": place}
        views.append({"polymorphic_id": 2**30, **pointer(place, data)})
    for place, (points, xy) in enumerate(poses.observed):
        for number, (point, at) in enumerate(zip(points.tolist(), xy.tolist(), strict=True)):
            seen.setdefault(point, []).append({"key": place, "value": {"id_feat": number, "x": at}})
    from_world = np.swapaxes(poses.rotations, -1, -2).tolist()
    known = [] if poses.points is None else sorted(seen)
    content = {
        "sfm_data_version": "0.3",
        "root_path": "images",
        "views": _keyed(views),
        "intrinsics": _keyed([{"polymorphic_id": new, "polymorphic_name": "pinhole_brown_t2", **intrinsic}]),
        "extrinsics": _keyed([{"rotation": r, "center": c} for r, c in zip(from_world, poses.places.tolist(), strict=True)]),
        "structure": [
            {"key": point, "value": {"X": poses.points.positions[point].tolist(), "observations": seen[point]}}
            for point in known
            if poses.points is not None
        ],
        "control_points": [],
    }
    return {"sfm_data.json": json.dumps(content, indent=1) + "\n"}


def _keyed(values: Sequence[Any]) -> list[dict[str, Any]]:
    """Return values as cereal writes a map from their places."""
    return [{"key": key, "value": value} for key, value in enumerate(values)]


def read_colmap(folder: Path, camera: Camera, frame_shape: tuple[int, int]) -> Poses:
    """Read what `colmap` has written of images of a camera, with their points; times are not known, and 0.

    Raises:
        InputError: a file is missing or damaged.
    """
    from scipy.spatial.transform import Rotation

    try:
        images, cloud = ((folder / name).read_text("utf-8").splitlines()[1:] for name in ("images.txt", "points3D.txt"))
        heads = [line.split() for line in images[::2]]
        seen = [np.array(line.split(), float).reshape(-1, 3) for line in images[1::2]]
        numbers = np.array([head[1:8] for head in heads], float).reshape(-1, 7)
        rows = np.array([line.split()[:5] for line in cloud], float).reshape(-1, 5)
        from_world = Rotation.from_quat(np.roll(numbers[:, :4], -1, axis=1)).as_matrix()
        places = positions_of(np.concatenate([from_world, numbers[:, 4:, None]], axis=-1))
        names = tuple(head[9] for head in heads)
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{folder} is no COLMAP model of a run: {error}") from error
    positions, flux = np.zeros((int(rows[:, 0].max(initial=0)), 3)), np.full(int(rows[:, 0].max(initial=0)), np.nan, np.float32)
    at = rows[:, 0].astype(int) - 1
    positions[at], flux[at] = rows[:, 1:4], srgb_to_linear(rows[:, 4] / 255)
    observed = tuple((each[:, 2].astype(np.intp) - 1, each[:, :2] - 0.5) for each in seen)
    seconds, to_world = np.zeros(len(names)), np.swapaxes(from_world, -1, -2)
    return Poses(
        camera=camera,
        frame_shape=frame_shape,
        names=names,
        rotations=to_world,
        seconds=seconds,
        positions=places,
        observed=observed,
        points=ScenePoints(positions, flux),
    )


def ply(points: ScenePoints) -> bytes:
    """Return points as a binary PLY file: x, y, z, and their grey level as red, green and blue."""
    return ply_of({**_along("", points.positions), **_greys(points.flux)})


def surface_ply(surface: Surface) -> bytes:
    """Return surface elements as a binary PLY file: position, normal, grey level, and expected error along the ray."""
    return ply_of(
        {
            **_along("", surface.positions),
            **_along("n", surface.normals),
            **_greys(surface.flux),
            "std": surface.std.astype("<f4"),
        }
    )


_OPACITY = 4.0  # logit of the opacity of a splat
_THIN = 0.1  # extent of a splat along its normal, relative to that across
_HARMONIC = 0.28209479177387814  # the spherical harmonic of degree 0


def splats_ply(surface: Surface) -> bytes:
    """Return surface elements as flat 3D Gaussians, in the PLY file that viewers of these open (Kerbl et al. 2023)."""
    from scipy.spatial.transform import Rotation

    grey = (_greys(surface.flux)["red"] / 255 - 0.5) / _HARMONIC
    # Any rotation that takes z to the normal.
    axes = np.cross(surface.normals, np.eye(3)[np.argmin(np.abs(surface.normals), axis=1)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = np.stack([axes, np.cross(surface.normals, axes), surface.normals], axis=2)
    x, y, z, w = Rotation.from_matrix(rotations).as_quat().T
    size = np.log(surface.sizes / 2)
    scales = size, size, size + np.log(_THIN)
    columns: dict[str, NDArray[Any]] = {**_along("", surface.positions), **_along("n", surface.normals)}
    columns |= {f"f_dc_{k}": grey for k in range(3)} | {"opacity": np.full(len(grey), _OPACITY)}
    columns |= {f"scale_{k}": each for k, each in enumerate(scales)} | {f"rot_{k}": each for k, each in enumerate((w, x, y, z))}
    return ply_of({name: each.astype("<f4") for name, each in columns.items()})


def _along(prefix: str, vectors: FloatArray) -> dict[str, NDArray[Any]]:
    return {prefix + axis: each.astype("<f4") for axis, each in zip("xyz", vectors.T, strict=True)}


def _greys(flux: NDArray[np.floating]) -> dict[str, NDArray[Any]]:
    return dict.fromkeys(("red", "green", "blue"), greys_of(flux))


def ply_of(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return vertices as a binary PLY file: properties by name, (N,) each, float32 or uint8."""
    number = len(next(iter(columns.values())))
    table = np.zeros(number, [(name, each.dtype) for name, each in columns.items()])
    for name, values in columns.items():
        table[name] = values
    words = {"f": "float", "u": "uchar"}
    properties = "".join(f"property {words[each.dtype.kind]} {name}\n" for name, each in columns.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {number}\n{properties}end_header\n"
    return header.encode("ascii") + table.tobytes()


def picture_of(flux: FluxImage) -> NDArray[np.uint8]:
    """Return an exposure, (H, W), as a picture of 8 bits in sRGB."""
    known = np.isfinite(flux)
    white = float(np.quantile(flux[known], _WHITE_QUANTILE)) if known.any() else 1.0
    return np.asarray(tone_mapped(flux, max(white, 1e-12)), np.uint8)


def greys_of(flux: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the grey levels of points in sRGB; those whose flux is not known are of middle grey."""
    known = np.isfinite(flux)
    if not known.any():
        return np.full(len(flux), _MIDDLE_GREY, np.uint8)
    white = float(np.quantile(flux[known], _WHITE_QUANTILE))
    return np.where(known, tone_mapped(flux.astype(np.float32), max(white, 1e-12)), _MIDDLE_GREY).astype(np.uint8)


def point_errors(poses: Poses) -> FloatArray:
    """Return the mean distance in px between where images show each point and where its position would be: (N,)."""
    assert poses.points is not None
    total, times = np.zeros(len(poses.points.positions)), np.zeros(len(poses.points.positions))
    matrix = poses.camera.matrix
    for rotation, place, (points, xy) in zip(poses.rotations, poses.places, poses.observed, strict=True):
        seen = (poses.points.positions[points] - place) @ rotation @ matrix.T
        away = poses.camera.distorted(seen[:, :2] / seen[:, 2:]) - xy
        np.add.at(total, points, np.linalg.norm(away, axis=1))
        np.add.at(times, points, 1)
    return np.asarray(total / np.maximum(times, 1))


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return x, y, z, w of rotations, (N, 4), with w not below 0."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_quat(canonical=True))


def _line(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def in_standard_world(estimate: PoseEstimate) -> PoseEstimate:
    """Move the world so that the first located camera is its origin and looks along z, and the path has the length 1.

    Raises:
        LocationError: the camera does not travel, so that there is no scale.
    """
    known = estimate.camera_from_world[np.isfinite(estimate.camera_from_world).all(axis=(1, 2))]
    length = float(np.linalg.norm(np.diff(positions_of(known), axis=0), axis=1).sum())
    if not length > 0:
        raise LocationError(
            "the camera does not travel: all located frames have one position; if it turns, leave out `pose` and set "
            "motion: {model: rotation}"
        )
    first = estimate.camera_from_world[int(np.argmax(estimate.located))]

    def moved(camera_from_world: FloatArray) -> FloatArray:
        rotation = camera_from_world[..., :3] @ first[:, :3].T
        shift = (camera_from_world[..., 3] - rotation @ first[:, 3]) / length
        return np.concatenate([rotation, shift[..., None]], axis=-1)

    positions = (estimate.points.positions @ first[:, :3].T + first[:, 3]) / length
    return replace(
        estimate,
        camera_from_world=moved(estimate.camera_from_world),
        std_position=estimate.std_position / length,
        points=ScenePoints(positions, estimate.points.flux),
        depth=tuple(
            replace(each, inverse_depth=each.inverse_depth * np.float32(length), std=each.std * np.float32(length))
            for each in estimate.depth
        ),
        views=tuple(replace(view, camera_from_world=moved(view.camera_from_world)) for view in estimate.views),
    )
