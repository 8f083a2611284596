"""Structure from motion by COLMAP: poses and points of some images, in one or several pieces.

Convention:
    Positions in images are (x, y) with integers as pixel centres; COLMAP's are 0.5 larger and are converted here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from photonpano import CameraGuess, FloatArray, OutputError
from photonpano_colmap.configs import FIRST_CENTRE, SEEDS, ColmapAveragesConfig
from photonpano_colmap.reversal import Halves, Readings, compared_halves, likelier_reading

_USUAL_FOCAL = 1.2  # initial focal length where none is given, in longer sides of a frame
_START_ANGLE_DEG = 4.0  # parallax of COLMAP's initial pair; its own 16 degrees are too much for short captures


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Images whose poses are connected."""

    images: NDArray[np.intp]  # (N,) their indices, increasing
    poses: FloatArray  # (N, 3, 4), world to camera
    points: FloatArray  # (M, 3) positions in the world
    # for each image the indices of K points, and where it shows them, (K, 2)
    observed: tuple[tuple[NDArray[np.intp], FloatArray], ...]
    focal_px: float
    readings: Readings  # how well this reading of the depth, and the other one, explain the images
    halves: Halves  # what half of the points tell


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """The result of COLMAP."""

    # the largest first, each with an image that no larger one has; empty if no pair of images was enough to begin with
    pieces: tuple[Piece, ...]
    n_keypoints: NDArray[np.intp]  # (N,) keypoints of each image
    # (N,) keypoints of each image that match those of another one, in agreement with a motion: the most of any
    n_matches: NDArray[np.intp]


def reconstruct(
    images: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    camera: CameraGuess,
    config: ColmapAveragesConfig,
    seed: int,
) -> Reconstruction:
    """Find the poses of pictures, (H, W) of 8 bits with masks, 0 where no keypoints may lie, in a temporary folder.

    COLMAP has one thread: with more, it numbers the images in another order each time, and finds other poses. Raises an
    `OutputError` if the disk is full.
    """
    # What it would print as an error, such as that it found no poses, becomes a message of ours.
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    seed %= SEEDS
    pycolmap.set_random_seed(seed)
    with tempfile.TemporaryDirectory(prefix="photonpano-colmap-") as name:
        folder = Path(name)
        database, pictures = folder / "database.db", folder / "images"
        for part in ("images", "masks", "sparse"):
            (folder / part).mkdir()
        for index, (picture, mask) in enumerate(images):
            for path, pixels in ((pictures / _name(index), picture), (folder / "masks" / f"{_name(index)}.png", mask)):
                if not cv2.imwrite(str(path), pixels):
                    raise OutputError(f"cannot write {path} for COLMAP; free some space there, or set TMPDIR to another folder")
        _extract(database, folder, camera, images[0][0].shape, config)
        _match(database, config, seed)
        keypoints, matches = _counts(database, len(images))
        pieces = [_piece(each, camera.focal_px is None) for each in _apart(_map(database, folder, camera, config, seed))]
    # a camera that only turns may leave images without a point
    return Reconstruction(tuple(piece for piece in pieces if len(piece.points)), keypoints, matches)


def _extract(database: Path, folder: Path, camera: CameraGuess, shape: tuple[int, ...], config: ColmapAveragesConfig) -> None:
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = config.max_keypoints
    height, width = shape[:2]
    x, y = camera.centre_px or ((width - 1) / 2, (height - 1) / 2)
    focal = camera.focal_px or _USUAL_FOCAL * max(height, width)
    reader = pycolmap.ImageReaderOptions(mask_path=str(folder / "masks"))
    numbers: tuple[float, ...] = (focal, x + FIRST_CENTRE, y + FIRST_CENTRE)
    if any(camera.distortion):
        reader.camera_model, numbers = "OPENCV", (focal, *numbers, *camera.distortion)
    else:
        reader.camera_model = "SIMPLE_PINHOLE"
    reader.camera_params = ",".join(map(repr, map(float, numbers)))
    pycolmap.extract_features(
        database,
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _match(database: Path, config: ColmapAveragesConfig, seed: int) -> None:
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options: dict[str, Any] = {"matching_options": matching, "verification_options": verification}
    if config.matcher == "exhaustive":
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu, **options)
    else:
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu, **options)


def _counts(database: Path, n_images: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the number of keypoints of each image, and of those that match another image: the most of any."""
    keypoints, matches = np.zeros(n_images, np.intp), np.zeros(n_images, np.intp)
    with pycolmap.Database.open(database) as opened:
        index_of = {image.image_id: _index(image.name) for image in opened.read_all_images()}
        for image_id, index in index_of.items():
            keypoints[index] = opened.num_keypoints_for_image(image_id)
        pairs, geometries = opened.read_two_view_geometries()
        for pair, geometry in zip(pairs, geometries, strict=True):
            for image_id in pycolmap.pair_id_to_image_pair(pair):
                index = index_of[image_id]
                matches[index] = max(matches[index], len(geometry.inlier_matches))
    return keypoints, matches


def _map(
    database: Path, folder: Path, camera: CameraGuess, config: ColmapAveragesConfig, seed: int
) -> list[pycolmap.Reconstruction]:
    finds_focal = camera.focal_px is None
    place = folder / "images", folder / "sparse"
    if config.mapper == "global":
        every = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed)
        every.mapper.bundle_adjustment.refine_focal_length = finds_focal
        every.mapper.bundle_adjustment.refine_principal_point = False
        every.mapper.bundle_adjustment.refine_extra_params = False
        return list(pycolmap.global_mapping(database, *place, options=every).values())
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, extract_colors=False)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = finds_focal
    options.ba_refine_principal_point = options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_tri_angle = _START_ANGLE_DEG
    return list(pycolmap.incremental_mapping(database, *place, options=options).values())


def _apart(found: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Return models, the largest first, without those whose images all belong to larger ones."""
    kept: list[pycolmap.Reconstruction] = []
    seen: set[int] = set()
    for each in sorted(found, key=lambda model: -model.num_reg_images()):
        images = set(each.reg_image_ids())
        if not images <= seen:
            kept.append(each)
            seen |= images
    return kept


def _piece(found: pycolmap.Reconstruction, finds_focal: bool) -> Piece:
    """Return poses and points of the likelier reading of a reconstruction in numpy."""
    found, readings = likelier_reading(found, finds_focal)
    images = sorted((image for image in found.images.values() if image.has_pose), key=lambda image: image.name)
    numbers = {identifier: number for number, identifier in enumerate(sorted(found.points3D))}
    observed = []
    for image in images:
        seen = [point for point in image.points2D if point.has_point3D()]
        indices = np.array([numbers[point.point3D_id] for point in seen], np.intp)
        xy = np.array([point.xy for point in seen], dtype=np.float64).reshape(-1, 2) - FIRST_CENTRE
        observed.append((indices, xy))
    [camera] = found.cameras.values()
    return Piece(
        np.array([_index(image.name) for image in images], np.intp),
        np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4),
        np.array([found.points3D[identifier].xyz for identifier in sorted(found.points3D)]).reshape(-1, 3),
        tuple(observed),
        float(camera.params[0]),
        readings,
        compared_halves(found, finds_focal),
    )


def _name(index: int) -> str:
    return f"{index:06}.png"


def _index(name: str) -> int:
    return int(name.partition(".")[0])
