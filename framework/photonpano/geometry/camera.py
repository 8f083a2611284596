"""A camera: the map between the pixels of its frames and the directions in which they look; and rotations of it.

Convention:
    A rotation is (3, 3) with determinant 1 and maps column vectors; its rotation vector points along the axis, and its length
    is the angle in radians. Functions of rotations take stacks as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry.homographies import BLOCK_FRAMES, corners, rescaling, transform_points
from photonpano.values import FloatArray, Homography

_ITERATIONS = 30
_EXACT = 1e-13  # the inverse of the distortion has converged when its last step was below this, in focal lengths


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera with square pixels, and a lens that distorts.

    Convention:
        Points are (x, y), integers are pixel centres. Ideal pixels are those that the camera would have without distortion:
        `matrix` maps directions (x right, y down, z ahead) to them, and `distorted` maps them to the pixels of a frame.
    """

    matrix: FloatArray  # (3, 3), [[focal, 0, x], [0, focal, y], [0, 0, 1]], in px
    # (4,) k1, k2, p1, p2 as OpenCV defines them: radial of second and fourth order, and tangential
    distortion: FloatArray = field(default_factory=lambda: np.zeros(4))

    @classmethod
    def of(cls, focal_px: float, frame_shape: tuple[int, int], distortion: ArrayLike = (0, 0, 0, 0)) -> Camera:
        """Return a camera that looks through the middle of its frames, of (height, width)."""
        middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
        return cls(camera_matrix(focal_px, middle), np.asarray(distortion, dtype=np.float64))

    @property
    def focal_px(self) -> float:
        """Focal length in px."""
        return float(self.matrix[0, 0])

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point (x, y)."""
        return float(self.matrix[0, 2]), float(self.matrix[1, 2])

    @property
    def numbers(self) -> FloatArray:
        """Focal length in px, k1, k2, p1 and p2: (5,)."""
        return np.array([self.focal_px, *self.distortion])

    @property
    def distorts(self) -> bool:
        """Whether the lens distorts."""
        return bool(self.distortion.any())

    def distorted(self, points: ArrayLike) -> FloatArray:
        """Map (..., 2) ideal pixels to pixels of a frame."""
        return self._in_px(self._distorted(self._in_focal_lengths(points)))

    def ideal(self, points: ArrayLike) -> FloatArray:
        """Map (..., 2) pixels of a frame to ideal pixels; NaN where no ideal pixel is imaged."""
        seen = self._in_focal_lengths(points)
        if not self.distorts:
            return self._in_px(seen)
        found = seen
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                step = self._ideal_shift(found, seen - self._distorted(found))
                found = found + step
                if not (np.abs(step) >= _EXACT).any():
                    break
            away = np.abs(self._distorted(found) - seen).max(axis=-1)
            (a, b), (_, d) = self._slopes(found)
            # Beyond the radius at which the image folds over, the iteration ends anywhere, and further out the same pixel is
            # seen again: mirrored, or from the other side.
            imaged = (away <= 1e-6) & (a * d > b * b) & ((found * seen).sum(axis=-1) >= 0)
        return self._in_px(np.where(imaged[..., None], found, np.nan))

    def ideal_at_corners(self, frame_shape: tuple[int, int]) -> Homography:
        """Return the homography from pixels of a frame to ideal pixels that is exact at its corners: (3, 3), h33 = 1."""
        if not self.distorts:
            return np.eye(3)
        import cv2

        seen = corners(frame_shape)
        return np.asarray(cv2.getPerspectiveTransform(seen.astype(np.float32), self.ideal(seen).astype(np.float32)))

    def ideal_shift(self, points: ArrayLike, shift: FloatArray) -> FloatArray:
        """Return how (..., 2) ideal pixels move if their images in a frame move by a small (..., 2) shift, to first order."""
        if not self.distorts:
            return shift
        return self._ideal_shift(self._in_focal_lengths(points), shift)

    def directions(self, points: ArrayLike) -> FloatArray:
        """Return the unit vectors in which (..., 2) pixels of a frame look: (..., 3)."""
        ideal = self._in_focal_lengths(self.ideal(points))
        rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def scaled(self, scale: float) -> Camera:
        """Return the camera of frames that are rescaled."""
        return Camera(rescaling(scale) @ self.matrix, self.distortion)

    def homographies(self, rotations: FloatArray) -> Homography:
        """Return K R K^-1, of determinant 1, for (..., 3, 3) rotations R; h33 may be zero or negative."""
        return np.asarray(self.matrix @ rotations @ np.linalg.inv(self.matrix))

    def rotations(self, homographies: Homography) -> FloatArray:
        """Return K^-1 H K, scaled to determinant 1, for (..., 3, 3) homographies H: rotations where this camera only turned."""
        matrices = np.linalg.inv(self.matrix) @ homographies @ self.matrix
        return np.asarray(matrices / np.cbrt(np.linalg.det(matrices))[..., None, None])

    def _in_focal_lengths(self, points: ArrayLike) -> FloatArray:
        return (np.asarray(points, dtype=np.float64) - self.matrix[:2, 2]) / np.diag(self.matrix)[:2]

    def _in_px(self, points: FloatArray) -> FloatArray:
        return np.asarray(points * np.diag(self.matrix)[:2] + self.matrix[:2, 2])

    def _distorted(self, points: FloatArray) -> FloatArray:
        k1, k2, p1, p2 = self.distortion
        x, y = np.moveaxis(points, -1, 0)
        square = x**2 + y**2
        radial = 1 + square * (k1 + k2 * square)
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2), y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y],
            axis=-1,
        )

    def _ideal_shift(self, points: FloatArray, shift: FloatArray) -> FloatArray:
        (a, b), (_, d) = self._slopes(points)
        x, y = np.moveaxis(shift, -1, 0)
        return np.stack([d * x - b * y, a * y - b * x], axis=-1) / (a * d - b * b)[..., None]

    def _slopes(self, points: FloatArray) -> list[list[FloatArray]]:
        """Return the derivatives of the distorted points by (..., 2) ideal ones: two rows of two arrays (...)."""
        k1, k2, p1, p2 = self.distortion
        x, y = np.moveaxis(points, -1, 0)
        square = x**2 + y**2
        radial, growth = 1 + square * (k1 + k2 * square), 2 * (k1 + 2 * k2 * square)
        mixed = x * y * growth + 2 * p1 * x + 2 * p2 * y
        return [
            [radial + x**2 * growth + 2 * p1 * y + 6 * p2 * x, mixed],
            [mixed, radial + y**2 * growth + 6 * p1 * y + 2 * p2 * x],
        ]


def camera_matrix(focal_px: float, centre_px: tuple[float, float]) -> FloatArray:
    """Return the (3, 3) matrix of a camera with square pixels."""
    return np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1]], dtype=np.float64)


# Derivatives of a small rotation by its rotation vector: (3, 3, 3).
ROTATION_AXES = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)
ROTATION_AXES.flags.writeable = False


def rotation_matrices(vectors: ArrayLike) -> FloatArray:
    """Return the rotations of rotation vectors: (..., 3) to (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(vectors, dtype=np.float64)
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()).reshape(*vectors.shape, 3)


def rotation_vectors(rotations: ArrayLike) -> FloatArray:
    """Return the rotation vectors of rotations, of angles up to pi: (..., 3, 3) to (..., 3)."""
    from scipy.spatial.transform import Rotation

    rotations = np.asarray(rotations, dtype=np.float64)
    return np.asarray(Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()).reshape(rotations.shape[:-1])


def lenses_apart_px(first: Camera, second: Camera, frame_shape: tuple[int, int]) -> float:
    """Return the largest difference of where two cameras undistort a pixel of a frame to; NaN if one images no place there."""
    frame = corners(frame_shape)
    # From the middle to the corners: k1 and k2 may cancel each other somewhere.
    places = frame.mean(axis=0) + np.linspace(0.25, 1, 4)[:, None, None] * (frame - frame.mean(axis=0))
    return float(np.linalg.norm(first.ideal(places) - second.ideal(places), axis=-1).max())


def nearest_rotations(matrices: ArrayLike) -> FloatArray:
    """Return the rotations nearest to (..., 3, 3) matrices of positive determinant, whatever their scale (Kabsch 1976)."""
    given = np.asarray(matrices, dtype=np.float64)
    flat, found = given.reshape(-1, 3, 3), np.empty(given.shape)
    for start in range(0, len(flat), BLOCK_FRAMES):
        left, _, right = np.linalg.svd(flat[start : start + BLOCK_FRAMES])
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        found.reshape(-1, 3, 3)[start : start + BLOCK_FRAMES] = left @ right
    return found


def likely_rotations(camera: Camera, homographies: Homography, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the rotations that move the corners of a frame most like (N, 3, 3) homographies: (N, 3, 3).

    `nearest_rotations` of the matrices of a shift would move the corners by half of it.
    """
    here = corners(frame_shape)
    if not np.all(homographies[:, 2] @ np.concatenate([here, np.ones((4, 1))], axis=1).T > 0):
        return nearest_rotations(camera.rotations(homographies))  # some look backwards
    return rotations_between(camera, here, transform_points(homographies, here))


def rotations_between(camera: Camera, here: FloatArray, there: FloatArray) -> FloatArray:
    """Return the rotations that bring (4, 2) ideal pixels to (N, 4, 2) others: (N, 3, 3), by least squares (Kabsch 1976)."""
    seen = [Camera(camera.matrix).directions(points) for points in (np.broadcast_to(here, there.shape), there)]
    return nearest_rotations(np.swapaxes(seen[1], -1, -2) @ seen[0])


def positions_of(camera_from_world: FloatArray) -> FloatArray:
    """Return the positions of cameras in the world, -R^T t: (..., 3, 4) to (..., 3)."""
    return np.asarray(-np.einsum("...ji,...j->...i", camera_from_world[..., :3], camera_from_world[..., 3]))


def right_handed_axes() -> dict[str, FloatArray]:
    """Return the 24 ways to choose axes along others, such as "x, -y, -z": rotations (3, 3) whose rows are the axes."""
    from scipy.spatial.transform import Rotation

    every = np.rint(Rotation.create_group("O").as_matrix())
    return {", ".join("-" * int(row.sum() < 0) + "xyz"[np.abs(row).argmax()] for row in each): each for each in every}
