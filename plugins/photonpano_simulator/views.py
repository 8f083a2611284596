"""Views of a plane before the camera or an equirectangular panorama around it, through its lens, and objects in front of them.

Convention:
    Points are (x, y), x right, y down; integers are pixel centres; sizes are (height, width). A direction is (x, y, z), x
    right, y down, z ahead. In the distortion and the vignetting of a lens, r is the distance from the middle of the frame, in
    half-diagonals: 1 at the corner pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import FloatArray, InputError
from photonpano.compiling import compiled
from photonpano.geometry import Camera, corners, transform_points, translation
from photonpano_simulator.config import FrameObject, Lens, SimulationConfig, TurnPath
from photonpano_simulator.sensor import Draw, generator

_POINTS_OF_A_SIDE = 16


def undistorted(config: SimulationConfig, points: ArrayLike) -> FloatArray:
    """Return where a lens without distortion images what this lens images at (..., 2) points: see `Lens` and `Distortion`."""
    points = np.asarray(points, dtype=np.float64)
    if not any(config.distortion.coefficients):
        middle = middle_of(config.frame_shape)
        offsets = points - middle
        squared = _squared_distance(offsets, middle)[..., None]
        return np.asarray(middle + offsets / (1 + squared * (config.lens.k1 + squared * config.lens.k2)))
    ideal = camera(config).ideal(points)
    if np.isnan(ideal).any():
        raise InputError(
            f"distortion folds the image of {config.frame_shape[0]}x{config.frame_shape[1]} px at the focal length of "
            f"{config.focal_length_px:g} px, so that nothing is imaged at its border; take smaller coefficients"
        )
    return ideal


def camera(config: SimulationConfig) -> Camera:
    """Return the camera with OpenCV's distortion, which looks through the middle of its frames."""
    return Camera.of(config.focal_length_px, config.frame_shape, config.distortion.coefficients)


def distorts(config: SimulationConfig) -> bool:
    """Return whether straight lines become curves."""
    return bool(config.lens.k1 or config.lens.k2 or any(config.distortion.coefficients))


def outline(config: SimulationConfig) -> FloatArray:
    """Return points around the frame, (N, 2), as a lens without distortion images them."""
    around = corners(config.frame_shape)
    if not distorts(config):
        return around
    shares = np.arange(_POINTS_OF_A_SIDE)[:, None, None] / _POINTS_OF_A_SIDE
    return undistorted(config, ((1 - shares) * around + shares * np.roll(around, -1, axis=0)).reshape(-1, 2))


def pixel_grid(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centres of all pixels: (H, W, 2)."""
    height, width = frame_shape
    return np.stack(np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height)), axis=-1)


def transmission(lens: Lens, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the share of the light in the middle that reaches each pixel: (H, W)."""
    middle = middle_of(frame_shape)
    squared = _squared_distance(pixel_grid(frame_shape) - middle, middle)
    return (1 - lens.vignette * squared).astype(np.float32)


def middle_of(shape: tuple[float, float]) -> FloatArray:
    """Return the middle of an image of (height, width): (x, y)."""
    height, width = shape
    return np.array([(width - 1) / 2, (height - 1) / 2])


def _squared_distance(offsets: FloatArray, middle: FloatArray) -> FloatArray:
    """Return r^2 of (..., 2) offsets from the middle."""
    return np.asarray((offsets**2).sum(axis=-1) / (middle**2).sum())


_DETAIL_PX = (1.5, 5.0, 15.0)  # standard deviations of the Gaussian kernels that make a texture of white noise


class Views:
    """Renders frames of a scene.

    The flux between the pixels of the scene is interpolated linearly. Pixels of the camera have an area if the scene is finer
    than they are: its flux is averaged over squares of whole pixels of the scene, and the averages are interpolated.
    """

    def __init__(self, config: SimulationConfig) -> None:
        self._shape = config.frame_shape
        self._is_round = isinstance(config.path, TurnPath)
        self._points = None
        if distorts(config) or self._is_round:
            # (2, H, W), x and y of the pixels of a lens without distortion.
            points = undistorted(config, pixel_grid(config.frame_shape))
            self._points = np.ascontiguousarray(np.moveaxis(points, -1, 0))
        self._to_rays = np.linalg.inv(camera(config).matrix)
        # The side of the area of a pixel, in px of the scene. Averages over it are sampled where their middles lie.
        self._side = max(1, round(config.scene_scale * config.fill_factor**0.5))
        self._offset = (self._side - 1) / 2

    def averaged(self, scene: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the averages of squares of pixels of a scene, each where its first pixel lies."""
        if self._side == 1:
            return scene
        if self._is_round:
            scene = np.concatenate([scene, scene[:, : self._side]], axis=1)
        averages = cv2.boxFilter(scene, -1, (self._side, self._side), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
        return np.asarray(averages[:, : -self._side] if self._is_round else averages, np.float32)

    def view(self, averages: NDArray[np.float32], homography: FloatArray) -> NDArray[np.float32]:
        """Return the flux of a scene in a frame, (H, W) or (H, W, 3), from `averaged`.

        The homography is (3, 3), pixels of the frame to pixels of the scene; before a panorama, K R K^-1, scaled by a positive
        number, where R turns directions of the frame to those of the panorama.
        """
        if self._points is not None and self._is_round:
            columns, rows = np.empty(self._shape, np.float32), np.empty(self._shape, np.float32)
            size = averages.shape[1], averages.shape[0]
            _look_around(self._points, self._to_rays @ homography, *size, self._offset, columns, rows)
            return np.asarray(cv2.remap(averages, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
        height, width = self._shape
        homography = translation(-self._offset, -self._offset) @ homography
        # The path lies inside the scene, up to rounding errors.
        border = cv2.BORDER_REPLICATE
        if self._points is None:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            return np.asarray(cv2.warpPerspective(averages, homography, (width, height), flags=flags, borderMode=border))
        x, y = transform_points(homography, self._points.reshape(2, -1).T).T.reshape(2, height, width).astype(np.float32)
        return np.asarray(cv2.remap(averages, x, y, cv2.INTER_LINEAR, borderMode=border))


@compiled
def _look_around(
    points: FloatArray,
    rays: FloatArray,
    width: int,
    height: int,
    offset: float,
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
) -> None:
    """Write where `points` (2, H, W), pixels that `rays` (3, 3) maps to directions, lie in a panorama of 360 degrees.

    `columns` and `rows` (H, W) are the outputs, less `offset`: columns from 0 to below `width`; the middle row is the horizon.
    """
    per_radian = width / (2 * np.pi)
    for i in range(columns.shape[0]):
        xs, ys, column_of, row_of = points[0, i], points[1, i], columns[i], rows[i]
        for j in range(len(xs)):
            x, y = xs[j], ys[j]
            right = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
            down = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
            ahead = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
            azimuth, pitch = _angle(right, ahead), _angle(down, np.sqrt(right * right + ahead * ahead))
            column = per_radian * azimuth + (width - 1) / 2 - offset
            column_of[j] = column if column >= 0 else column + width
            row_of[j] = min(max(per_radian * pitch + (height - 1) / 2 - offset, 0.0), height - 1.0)


@compiled
def _angle(y: float, x: float) -> float:
    """Return the arc tangent of y / x, from -pi to pi, within 2e-9: a Chebyshev fit, which is vectorised."""
    up, along = abs(y), abs(x)
    ratio = min(up, along) / max(up, along, 1e-300)
    s = ratio * ratio
    angle = 0.05746355779882009 + s * (-0.030717508855215514 + s * (0.010680719419709784 - s * 0.0017437011378649602))
    angle = -0.14261573680082928 + s * (0.1094019896411271 + s * (-0.08372063945103504 + s * angle))
    angle = ratio * (0.9999999975460201 + s * (-0.33333282295510946 + s * (0.19998230640355844 + s * angle)))
    angle = np.pi / 2 - angle if up > along else angle
    angle = np.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


class DrawnObject:
    """A rectangle or a disc with texture, drawn over frames.

    `flux`, in photons per pixel per frame, is that of the texture where `config.flux` is 1; `scene_motion` (T, 2) is how far
    the scene has moved through the frame since the first frame, in px.
    """

    def __init__(self, config: FrameObject, frame_shape: tuple[int, int], flux: float, scene_motion: FloatArray) -> None:
        height, width = frame_shape
        self._size = np.array(config.size) * (width, height)
        self._is_disc = config.shape == "disc"
        last = len(scene_motion) if config.frames is None else config.first + config.frames
        self._frames = range(config.first, last)
        begin = min(config.first, len(scene_motion) - 1)
        elapsed = np.arange(len(scene_motion))[:, None] - config.first
        middle = np.array(config.at) * (width, height) - 0.5
        centres = middle + elapsed * config.moves_px + config.follows * (scene_motion - scene_motion[begin])
        self._corners = centres - self._size / 2
        self._texture = texture_of(self._size, config.seed) * np.float32(flux * config.flux)

    def draw(self, view: NDArray[np.float32], frame: int) -> None:
        """Replace the flux of the pixels, or of the parts of pixels, that it covers in a frame; `view` is (H, W)."""
        if frame not in self._frames:
            return
        left, top = self._corners[frame]
        height, width = view.shape
        there = np.array([[1, 0, left + 0.5], [0, 1, top + 0.5]])
        seen = cv2.warpAffine(self._texture, there, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        view += self.covered(view.shape, frame).astype(np.float32) * (seen - view)

    def covered(self, shape: tuple[int, ...], frame: int) -> FloatArray:
        """Return the share of each pixel that it covers in a frame: (H, W)."""
        if frame not in self._frames:
            return np.zeros(shape)
        left, top = self._corners[frame]
        if self._is_disc:  # its edge is a ramp of one pixel
            y, x = np.ogrid[: shape[0], : shape[1]]
            from_middle = np.hypot(x - (left + self._size[0] / 2), y - (top + self._size[1] / 2))
            return np.asarray(np.clip(self._size.min() / 2 - from_middle + 0.5, 0, 1))
        return np.outer(_covered(top, self._size[1], shape[0]), _covered(left, self._size[0], shape[1]))


def _covered(start: float, length: float, n_pixels: int) -> FloatArray:
    """Return the share of each pixel along an axis that lies between `start` and `start + length`."""
    pixels = np.arange(n_pixels)
    return np.asarray(np.clip(np.minimum(pixels + 0.5, start + length) - np.maximum(pixels - 0.5, start), 0, 1))


def texture_of(size: FloatArray, seed: int) -> NDArray[np.float32]:
    """Return an image of mean 1 with detail from fine to coarse; `size` is (width, height) in px."""
    width, height = np.maximum(1, np.ceil(size)).astype(int)
    noise = generator(seed, Draw.TEXTURE).standard_normal((height, width), np.float32)
    layers = [sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in _DETAIL_PX]
    texture = np.exp(np.sum(layers, axis=0))
    return np.asarray(texture / texture.mean(), dtype=np.float32)
