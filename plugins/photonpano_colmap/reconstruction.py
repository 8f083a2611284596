"""COLMAP: the homography of two exposures, as locator `pycolmap-two-view`, and structure from motion of many.

Structure from motion gives poses, their expected errors, and points, in one or several pieces. A reconstruction is adjusted,
its depth reversal (the ambiguity of Necker's cube) resolved, and halves of its points compared. From afar, a scene and its
mirror image in depth look alike if the camera rotates the other way. A reconstruction may end in either; perspective leaves
larger residuals in the wrong one.

Convention:
    Positions in images are (x, y) with integers as pixel centres; COLMAP's are 0.5 larger and are converted here.
    X_c = R (X - c) for the position c of a camera. A pose is perturbed by a rotation vector of its camera, exp(w) R, and by a
    shift of c in the world. K maps points of the camera to ideal pixels.
"""

from __future__ import annotations

import copy
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photonpano import FloatArray, Homography, Located, NotLocated, OutputError, Reason, VirtualExposure
from photonpano.geometry import Camera, camera_matrix, normalised, positions_of
from photonpano.locating import Matches, PointLocator, blur_against_noise, motion_from_points, stabilised_8_bit, too_few_matches
from photonpano_colmap.exposures import moves, posed
from photonpano_colmap.hooks import FIRST_CENTRE, SEEDS, ColmapAveragesConfig, PycolmapTwoViewConfig
from photonpano_poses import CameraGuess, align_positions

MAX_TRIALS = 10_000  # of RANSAC, which finds a homography with 20 % inliers in half as many
_SIFT = pycolmap.FeatureExtractorType.SIFT
_USUAL_FOCAL = 1.2  # initial focal length where none is given, in longer sides of a frame
# Relative error of an estimated focal length that residuals do not show: blur shifts keypoints alike in many averages.
FOCAL_BIAS = 0.01
_FREE_BIAS = 0.04  # the same in COLMAP where another one was given: up to 6 % on simulated captures
_FOCAL_SIGMAS = 3.0  # expected errors by which a focal length that is given may differ from the one that fits
_START_ANGLE_DEG = 4.0  # parallax of COLMAP's initial pair; its own 16 degrees are too much for short captures


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one exposure, the largest first."""

    points: FloatArray  # (N, 2), pixel centres are integers
    sizes: FloatArray  # (N,), scales of the keypoints in px; position errors are proportional to them
    descriptors: NDArray[np.uint8]  # (N, 128)
    shape: tuple[int, int]  # (height, width) of the exposure

    def for_matcher(self) -> tuple[pycolmap.FeatureKeypoints, pycolmap.FeatureDescriptors]:
        """Return points and descriptors in types of the library, which cannot be pickled; matching uses positions alone."""
        keypoints = [pycolmap.FeatureKeypoint(x=x, y=y) for x, y in self.points.tolist()]
        return pycolmap.FeatureKeypoints(keypoints), pycolmap.FeatureDescriptors(_SIFT, self.descriptors)


class TwoViewLocator(PointLocator):
    """Extracts features once, matches them near the current motion or in the whole image, and fits all inliers.

    The library holds the GIL while it extracts and matches, so pairs are not processed in parallel; its own threads are off.
    """

    def __init__(self, config: PycolmapTwoViewConfig, seed: int) -> None:
        self._config: PycolmapTwoViewConfig = config
        self._seed = seed % SEEDS
        # It would log every extractor and matcher on stderr.
        pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, int(pycolmap.logging.WARNING))

    def describe(self, exposure: VirtualExposure) -> Features:
        """Detect keypoints on the variance-stabilised image, and keep the largest outside of masked areas."""
        config = self._config
        blur_px = blur_against_noise(exposure, config.blur_px)
        image, mask = stabilised_8_bit(exposure, blur_px)
        options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
        options.sift.max_num_features = config.max_keypoints
        options.sift.peak_threshold = config.peak_threshold / max(1.0, blur_px)
        # A keypoint with two orientations would be matched twice.
        options.sift.max_num_orientations = 1
        # An extractor for each call: the library does not guarantee thread safety.
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        found, descriptors = extractor.extract_from_uint8_array(image)
        positions = np.array([(each.x, each.y, each.compute_scale()) for each in found], dtype=np.float64).reshape(-1, 3)
        positions[:, :2] -= FIRST_CENTRE
        x, y = (np.clip(np.rint(positions[:, axis]).astype(np.intp), 0, image.shape[1 - axis] - 1) for axis in (0, 1))
        # The library checks the limit after each scale, so there may be more.
        largest = np.argsort(-positions[:, 2], kind="stable")
        kept = largest[mask[y, x][largest] > 0][: config.max_keypoints]
        return Features(
            points=positions[kept, :2],
            sizes=positions[kept, 2],
            descriptors=np.asarray(descriptors.data, np.uint8)[kept],
            shape=(image.shape[0], image.shape[1]),
        )

    def _homography(self, moving: Features, fixed: Features, initial: Homography | None) -> Located | NotLocated:
        # The second attempt is for level 1, or where the current motion is wrong by more than the search radius.
        for matches in self._matches(moving, fixed, initial):
            motion = self._motion(moving, fixed, matches)
            if isinstance(motion, Located):
                break
        return motion

    def _matches(self, moving: Features, fixed: Features, initial: Homography | None) -> Iterator[Matches]:
        if initial is not None:
            yield _matches_of(moving, fixed, self._matched_nearby(moving, fixed, initial), guided=True)
        pairs = self._matcher().match(*moving.for_matcher(), *fixed.for_matcher())
        yield _matches_of(moving, fixed, np.asarray(pairs, np.intp).reshape(-1, 2), guided=False)

    def _matcher(self) -> pycolmap.FeatureMatcher:
        options = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        options.sift.max_ratio = self._config.ratio
        options.sift.cross_check = True
        # The approximate matcher is no faster for a few thousand keypoints.
        options.sift.cpu_brute_force_matcher = True
        return pycolmap.FeatureMatcher.create(options, pycolmap.Device.cpu)

    def _matched_nearby(self, moving: Features, fixed: Features, initial: Homography) -> NDArray[np.intp]:
        """Return the indices of matches near the positions that a motion predicts: (K, 2)."""
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.PLANAR
        geometry.H = initial
        # The required camera has no effect on a homography.
        height, width = moving.shape
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1.0, width, height)
        first, second = ((*each.for_matcher(), camera) for each in (moving, fixed))
        self._matcher().match_guided(self._config.search_px, *first, *second, geometry)
        return np.asarray(geometry.inlier_matches, np.intp).reshape(-1, 2)

    def _motion(self, moving: Features, fixed: Features, matches: Matches) -> Located | NotLocated:
        """Find the homography that most matches agree on, and fit it to these."""
        config, here, there = self._config, matches.moving, matches.fixed
        counts = {"keypoints_moving": len(moving.points), "keypoints_fixed": len(fixed.points), "matches": len(here)}
        evidence = {name: float(count) for name, count in counts.items()}
        if len(here) < config.min_inliers:
            return too_few_matches(len(here), config, evidence)
        options = pycolmap.RANSACOptions(max_error=config.threshold_px, max_num_trials=MAX_TRIALS, random_seed=self._seed)
        consensus = pycolmap.estimate_homography_matrix(here, there, options)
        if consensus is None or not consensus["H"][2, 2]:
            return NotLocated(f"no motion agrees with any of {len(here)} matches", evidence)
        start = normalised(consensus["H"])
        return motion_from_points(here, there, start, moving.shape, config, sizes=matches.sizes, evidence=evidence)


def _matches_of(moving: Features, fixed: Features, pairs: NDArray[np.intp], guided: bool) -> Matches:
    return Matches(moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], guided, moving.sizes[pairs[:, 0]])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
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


CONTRADICTED = "the {} contradict the focal length"  # images, such as `averages`


@dataclass(frozen=True, slots=True, eq=False)
class FreeFocal:
    """The focal length that images have if it is not given."""

    focal_px: float
    std_px: float  # its expected error
    images: NDArray[np.intp]  # (N,) indices of the images with a pose, increasing
    poses: FloatArray  # (N, 3, 4) of these with this focal length

    def __str__(self) -> str:
        return f"{self.focal_px:.4g} ± {self.std_px:.2g} px"

    def missed(self, images: NDArray[np.intp], poses: FloatArray, given_px: float) -> tuple[FloatArray, FloatArray]:
        """Return how far (M, 3, 4) poses are expected to be off since the given focal length is: shifts, and angles in radians.

        Poses with the free one differ from them, after the best alignment, by the errors of both: what is beyond the share of
        the free one's counts. Poses of images that the free ones lack are interpolated: (M,) each.
        """
        common, here, there = np.intersect1d(images, self.images, return_indices=True)
        excess = max(0.0, 1 - (self.std_px / max(abs(self.focal_px - given_px), 1e-9)) ** 2)
        if not excess or len(common) < _FEWEST:
            return np.zeros(len(images)), np.zeros(len(images))
        places = positions_of(self.poses[there])
        scale, turn, shift = align_positions(places, positions_of(poses[here]))
        aligned = posed(self.poses[there, :, :3] @ turn.T, scale * places @ turn.T + shift)
        changes = np.linalg.norm(moves(poses[here], aligned).reshape(-1, 2, 3), axis=2) * math.sqrt(excess)
        angles, shifts = (np.interp(images, common, of_common) for of_common in changes.T)
        return shifts, angles

    def doubt_of(self, given_px: float, images: str) -> Reason | None:
        """Doubt a focal length that is given; None if the images, such as `averages`, do not contradict it."""
        off = abs(self.focal_px - given_px) / self.std_px
        if off <= _FOCAL_SIGMAS:
            return None
        where = f"{self} fits, {given_px:.4g} px is given; in expected errors"
        todo = "calibrate the camera, and correct camera.focal_px, or leave it out"
        return Reason(CONTRADICTED.format(images), off, _FOCAL_SIGMAS, where, todo)


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """The result of COLMAP."""

    # the largest first, each with an image that no larger one has; empty if no pair of images was enough to begin with
    pieces: tuple[Piece, ...]
    n_keypoints: NDArray[np.intp]  # (N,) keypoints of each image
    # (N,) keypoints of each image that match those of another one, in agreement with a motion: the most of any
    n_matches: NDArray[np.intp]
    free_focal: FreeFocal | None = None  # of the same matches; None if it was not given, or no poses are found without it


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
        free_focal = None if camera.focal_px is None else _free_focal(database, folder, camera, config, seed)
    # a camera that only turns may leave images without a point
    return Reconstruction(tuple(piece for piece in pieces if len(piece.points)), keypoints, matches, free_focal)


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
        if each.num_points3D() and not images <= seen:
            kept.append(each)
            seen |= images
    return kept


def _piece(found: pycolmap.Reconstruction, finds_focal: bool) -> Piece:
    """Return poses and points of the likelier reading of a reconstruction in numpy."""
    found, readings = likelier_reading(found, finds_focal)
    images, poses, points, observed = _arrays(found)
    [camera] = found.cameras.values()
    return Piece(
        images=images,
        poses=poses,
        points=points,
        observed=observed,
        focal_px=float(camera.params[0]),
        readings=readings,
        halves=compared_halves(found, finds_focal),
    )


def _free_focal(database: Path, folder: Path, guess: CameraGuess, config: ColmapAveragesConfig, seed: int) -> FreeFocal | None:
    """Find poses from the same matches once more, with a focal length that is not known."""
    with pycolmap.Database.open(database) as opened:
        [camera] = opened.read_all_cameras()
        camera.focal_length = _USUAL_FOCAL * max(camera.width, camera.height)
        camera.has_prior_focal_length = False
        opened.update_camera(camera)
    models = _apart(_map(database, folder, replace(guess, focal_px=None), config, seed))
    if not models:
        return None
    likelier, _ = likelier_reading(models[0], True)
    images, poses, points, observed = _arrays(likelier)
    if not len(points):
        return None
    [camera] = likelier.cameras.values()
    centre = camera.principal_point_x - FIRST_CENTRE, camera.principal_point_y - FIRST_CENTRE
    lens = Camera(camera_matrix(camera.params[0], centre), np.array(guess.distortion))
    noise = pose_noise(poses, points, [(indices, lens.ideal(xy)) for indices, xy in observed], lens.matrix, True)
    return FreeFocal(lens.focal_px, math.hypot(noise.std_focal_px, _FREE_BIAS * lens.focal_px), images, poses)


_Arrays = tuple[NDArray[np.intp], FloatArray, FloatArray, tuple[tuple[NDArray[np.intp], FloatArray], ...]]


def _arrays(found: pycolmap.Reconstruction) -> _Arrays:
    """Return the indices of the images, their poses, the points, and what each image shows of them, as in `Piece`."""
    images = sorted((image for image in found.images.values() if image.has_pose), key=lambda image: image.name)
    numbers = {identifier: number for number, identifier in enumerate(sorted(found.points3D))}
    observed = []
    for image in images:
        seen = [point for point in image.points2D if point.has_point3D()]
        indices = np.array([numbers[point.point3D_id] for point in seen], np.intp)
        xy = np.array([point.xy for point in seen], dtype=np.float64).reshape(-1, 2) - FIRST_CENTRE
        observed.append((indices, xy))
    return (
        np.array([_index(image.name) for image in images], np.intp),
        np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4),
        np.array([found.points3D[identifier].xyz for identifier in sorted(found.points3D)]).reshape(-1, 3),
        tuple(observed),
    )


def _name(index: int) -> str:
    return f"{index:06}.png"


def _index(name: str) -> int:
    return int(name.partition(".")[0])


_NEAREST = 0.1  # minimum distance of reversed points, in median depths
_FARTHEST_OFF_PX = 4.0  # points with a larger residual are removed, as COLMAP removes them
_SAME = 0.2  # two readings agree if their rotations differ by less than this fraction
_ALIKE = 0.9  # neither reading is likelier if the ratio of their residuals is above this
_CELLS = 0.06, 0.12  # sides of the squares of two chessboards, in focal lengths
_FEWEST = 3  # positions that determine a similarity


@dataclass(frozen=True, slots=True)
class Readings:
    """Residuals of two readings of the depth, and which is likelier."""

    found_px: float  # median distance of a point from where images show it, adjusted from the reading that COLMAP found
    reversed_px: float  # the same, adjusted from near and far exchanged
    is_reversed: bool = False  # whether the likelier one is not what COLMAP found
    differ: bool = True  # whether they are two readings: where perspective is strong, adjustment leads from either to one

    @property
    def ratio(self) -> float | None:
        """The smaller of both residuals over the larger; None if they are those of one reading."""
        return min(self.found_px, self.reversed_px) / max(self.found_px, self.reversed_px) if self.differ else None

    @property
    def doubt(self) -> Reason | None:
        """Why the depth may be reversed; None if one reading explains the images better than the other."""
        if (ratio := self.ratio) is None or ratio <= _ALIKE:
            return None
        return Reason(
            "the depth of the scene may be reversed: near and far exchanged explain the averages as well",
            ratio,
            _ALIKE,
            f"ratio of the residuals of both; {self}",
            "move farther, or nearer to the scene, so that perspective tells them apart",
        )

    def __str__(self) -> str:
        return (
            f"points are {self.found_px:.2f} px from where averages show them as COLMAP found them, and "
            f"{self.reversed_px:.2f} px with near and far exchanged"
        )


def likelier_reading(found: pycolmap.Reconstruction, finds_focal: bool) -> tuple[pycolmap.Reconstruction, Readings]:
    """Return a reconstruction adjusted to its images, with its depth reversed if that explains them better; and how well."""
    adjusted, other = copy.deepcopy(found), _reversed(found)
    found_px, reversed_px = adjust_model(adjusted, finds_focal), adjust_model(other, finds_focal)
    likelier = adjusted if found_px <= reversed_px else other
    readings = Readings(found_px, reversed_px, not _agree(found, likelier), not _agree(adjusted, other))
    for identifier, point in list(likelier.points3D.items()):
        if point.error > _FARTHEST_OFF_PX:
            likelier.delete_point3D(identifier)
    return likelier, readings


def reversed_in_depth(poses: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mirror (N, 3, 4) poses and (M, 3) points at the plane of the median depth; to first order, images stay as they are."""
    towards = Rotation.from_matrix(poses[:, :, :3]).mean().as_matrix()
    middle = positions_of(poses).mean(axis=0)
    seen = (points - middle) @ towards.T
    depth = float(np.median(seen[:, 2]))
    seen[:, 2] = np.maximum(2 * depth - seen[:, 2], _NEAREST * depth)
    rotations = poses[:, :, :3] @ towards.T
    target = np.array([0.0, 0.0, depth])
    # The camera pans and tilts the other way, and goes on to see the middle of the scene where it saw it.
    rotated = Rotation.from_rotvec(Rotation.from_matrix(rotations).as_rotvec() * (-1, -1, 1)).as_matrix()
    looked = np.einsum("nij,nj->ni", rotations, target - (positions_of(poses) - middle) @ towards.T)
    return np.concatenate([rotated, (looked - rotated @ target)[:, :, None]], axis=2), seen


def _reversed(found: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    other = copy.deepcopy(found)
    images = [image for image in other.images.values() if image.has_pose]
    identifiers = sorted(other.points3D)
    poses = np.array([image.cam_from_world().matrix() for image in images])
    points = np.array([other.points3D[identifier].xyz for identifier in identifiers])
    poses, points = reversed_in_depth(poses, points)
    for image, pose in zip(images, poses, strict=True):
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))
    for identifier, point in zip(identifiers, points, strict=True):
        other.points3D[identifier].xyz = point
    return other


def adjust_model(model: pycolmap.Reconstruction, finds_focal: bool) -> float:
    """Adjust a reconstruction to its images, and return the median distance of a point from where they show it, px."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = finds_focal
    options.refine_principal_point = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    # This is what `pycolmap.bundle_adjustment` does, which prints a heading and its time whatever the level of its log.
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()] or [np.inf]))


def _agree(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> bool:
    """Return whether the camera rotates alike in two reconstructions from the same images."""
    poses = [
        np.array([each.cam_from_world().matrix() for each in model.images.values() if each.has_pose])
        for model in (first, second)
    ]
    rotations = [Rotation.from_matrix(each[1:, :, :3] @ each[0, :, :3].T) for each in poses]
    return bool(np.median((rotations[0] * rotations[1].inv()).magnitude()) < _SAME * np.median(rotations[0].magnitude()))


@dataclass(frozen=True, slots=True)
class Halves:
    """Expected errors of poses from half of the points, root mean square.

    Keypoints of a track err alike, from blur and at the edges of things, which residuals do not show: so the poses from all
    points are hardly better than these.
    """

    std_position: float  # in units of the world
    std_rotation: float  # in radians, after the best common rotation


def compared_halves(found: pycolmap.Reconstruction, finds_focal: bool) -> Halves:
    """Adjust the images of a reconstruction to each half of its points; compare both, aligned.

    The halves are the black and the white squares of a chessboard that the image in the middle sees: neighbours err alike, so
    that they belong to one half. How far two halves are apart is chance, too, and less so as the mean of two boards.
    """
    squares = np.array([_compared(found, finds_focal, cell) for cell in _CELLS]) ** 2
    return Halves(*np.sqrt(squares.mean(axis=0)).tolist())


def _compared(found: pycolmap.Reconstruction, finds_focal: bool, cell: float) -> tuple[float, float]:
    """Return the expected errors of positions and rotations from the halves of a board; infinite where half has no poses."""
    places = sorted(found.reg_image_ids())
    middle = found.images[places[len(places) // 2]].cam_from_world()
    halves = [copy.deepcopy(found) for _ in range(2)]
    for number, half in enumerate(halves):
        for identifier, point in found.points3D.items():
            x, y, z = middle * point.xyz
            if (x / z // cell + y / z // cell) % 2 == number:
                half.delete_point3D(identifier)
        adjust_model(half, finds_focal)
        if not half.num_points3D():  # as of a camera that only turns, whose points lie anywhere
            return np.inf, np.inf
    images = sorted(set(halves[0].reg_image_ids()) & set(halves[1].reg_image_ids()))
    first, second = (np.array([half.images[each].cam_from_world().matrix() for each in images]) for half in halves)
    aligned = pycolmap.estimate_sim3d(positions_of(first), positions_of(second)) if len(images) >= _FEWEST else None
    if aligned is None:
        return np.inf, np.inf
    apart = positions_of(first) @ aligned.rotation.matrix().T * aligned.scale + aligned.translation - positions_of(second)
    worlds = Rotation.from_matrix(np.swapaxes(first[:, :, :3], 1, 2) @ second[:, :, :3])
    turned = (worlds * worlds.mean().inv()).magnitude()
    # Both halves err, by chance.
    squares = np.sum(apart**2, axis=1), turned**2
    return float(np.sqrt(np.mean(squares[0]) / 2)), float(np.sqrt(np.mean(squares[1]) / 2))


_POSE = 6  # unknowns of a pose: rotation vector and position
_SMALLEST = 1e-12  # eigenvalues of the information below this fraction of the largest are undetermined directions


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Expected errors, root mean square."""

    std_position: FloatArray  # (N,) in units of the world
    std_rotation: FloatArray  # (N,) in radians
    std_focal_px: float  # 0 if the focal length is known
    residual_px: float  # root mean square of the residuals along x and y


def pose_noise(
    poses: FloatArray,
    points: FloatArray,
    observed: Sequence[tuple[NDArray[np.intp], FloatArray]],
    matrix: FloatArray,
    finds_focal: bool,
) -> PoseNoise:
    """Return the expected errors of (N, 3, 4) poses after the best alignment of positions with the true ones.

    The points, (M, 3), are eliminated (Schur complement), and the seven directions of the gauge are projected out of the
    covariance, as a similarity that aligns the positions does. The noise in an image is that of the residuals. `observed` are
    for each pose the indices of K points, and their (K, 2) ideal pixels.
    """
    n_poses, size = len(poses), _POSE * len(poses) + finds_focal
    information = np.zeros((size, size))
    corners: list[dict[int, FloatArray]] = [{} for _ in points]
    of_points = np.zeros((len(points), 3, 3))
    squares, count = 0.0, 0
    for place, (pose, (indices, xy)) in enumerate(zip(poses, observed, strict=True)):
        residuals, by_camera, by_point = _linearised(pose, points[indices], xy, matrix, finds_focal)
        squares, count = squares + float((residuals**2).sum()), count + residuals.size
        own = np.r_[_POSE * place : _POSE * place + _POSE, *([size - 1] if finds_focal else [])]
        information[np.ix_(own, own)] += np.einsum("kia,kib->ab", by_camera, by_camera)
        np.add.at(of_points, indices, np.einsum("kia,kib->kab", by_point, by_point))
        for index, cross in zip(indices.tolist(), np.einsum("kia,kib->kab", by_camera, by_point), strict=True):
            corners[index][place] = cross
    for index, cross_of in enumerate(corners):
        if len(cross_of) < 2:
            continue
        own = np.concatenate([np.arange(_POSE * place, _POSE * place + _POSE) for place in cross_of])
        cross = np.concatenate([each[:_POSE] for each in cross_of.values()])
        if finds_focal:
            own, cross = np.append(own, size - 1), np.concatenate([cross, sum(each[_POSE:] for each in cross_of.values())])
        information[np.ix_(own, own)] -= cross @ np.linalg.pinv(of_points[index]) @ cross.T
    freedom = max(1, count - size - 3 * len(points) + 7)
    covariance = squares / freedom * without_gauge(information, poses)
    variances = np.diag(covariance)
    per_pose = variances[: _POSE * n_poses].reshape(n_poses, 2, 3).sum(axis=2)
    return PoseNoise(
        np.sqrt(per_pose[:, 1]),
        np.sqrt(per_pose[:, 0]),
        float(np.sqrt(variances[-1])) if finds_focal else 0.0,
        float(np.sqrt(squares / max(1, count))),
    )


def _linearised(
    pose: FloatArray, points: FloatArray, xy: FloatArray, matrix: FloatArray, finds_focal: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (K, 2) and their derivatives by the camera (K, 2, 6 or 7) and by the point (K, 2, 3)."""
    rotation, focal = pose[:, :3], np.diag(matrix)[:2]
    seen = points @ rotation.T + pose[:, 3]
    ahead = seen[:, 2:]
    plane = seen[:, :2] / ahead
    residuals = plane * focal + matrix[:2, 2] - xy
    by_seen = np.zeros((len(points), 2, 3))
    by_seen[:, 0, 0], by_seen[:, 1, 1] = focal[0] / ahead[:, 0], focal[1] / ahead[:, 0]
    by_seen[:, :, 2] = -focal * plane / ahead
    turned = np.cross(np.eye(3)[None], seen[:, None, :])  # row a: derivative of the point by rotation about axis a
    by_camera = np.concatenate([by_seen @ np.swapaxes(turned, 1, 2), -by_seen @ rotation], axis=2)
    if finds_focal:
        by_camera = np.concatenate([by_camera, plane[:, :, None]], axis=2)
    return residuals, by_camera, by_seen @ rotation


def without_gauge(information: FloatArray, poses: FloatArray) -> FloatArray:
    """Invert (6 N, 6 N) information, or with one more unknown, and project the covariance as aligning the positions does."""
    values, vectors = np.linalg.eigh(information)
    inverted = np.where(values > _SMALLEST * values[-1], 1 / np.where(values > 0, values, 1), 0)
    covariance = (vectors * inverted) @ vectors.T
    rotations = poses[:, :, :3]
    places = positions_of(poses)
    gauge = np.zeros((len(information), 7))
    for place, (rotation, position) in enumerate(zip(rotations, places - places.mean(axis=0), strict=True)):
        rows = slice(_POSE * place, _POSE * place + 3), slice(_POSE * place + 3, _POSE * place + _POSE)
        gauge[rows[1], :3] = np.eye(3)
        gauge[rows[1], 3:6] = np.cross(np.eye(3), position).T
        gauge[rows[0], 3:6] = -rotation
        gauge[rows[1], 6] = position
    of_positions = np.zeros(len(information), np.bool_)
    for axis in range(3, _POSE):
        of_positions[axis : _POSE * len(poses) : _POSE] = True
    aligned = np.eye(len(information))
    aligned[:, of_positions] -= gauge @ np.linalg.pinv(gauge[of_positions])
    return np.asarray(aligned @ covariance @ aligned.T)
