"""Scenes as pictures: the flux of a photograph, or of the built-in street by day or at night, and lamps that flicker."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.photometry import srgb_to_linear
from photonpano.reading import read_picture
from photonpano_simulator.config import Lamp, NightScene, PhotoScene, StreetScene
from photonpano_simulator.drawing import Drawing, pictures_of, read_scene

_LUMINANCE = (0.0722, 0.7152, 0.2126)  # of blue, green and red, in the order of OpenCV (IEC 61966-2-1)
_OVERLAP = 40  # the ends of a drawing all around fade into each other over this part of its width
_LARGEST = 16384  # px; warps of OpenCV refuse a side of 32768 px
_NIGHT_BLUR_PX = 1.0  # nothing at night is sharper than a pixel
_PATCHES = 160  # patches of colour in a square of the street's height
_COLOUR_STD, _STRONGEST_COLOUR = 2.0, 1.5  # of the logarithms of red and blue, relative to green


def scene_flux(
    scene: StreetScene | NightScene | PhotoScene, flux: float, in_colour: bool = False, is_round: bool = False
) -> NDArray[np.float32]:
    """Return the flux of a scene, (Hs, Ws) or (Hs, Ws, 3) in colour, in photons per pixel per frame.

    `flux` is the mean, in colour that of the sum of red, green and blue. The ends of a drawing that `is_round` meet; those of a
    photograph are taken as they are. Raises an `InputError` if the photograph cannot be used.
    """
    if isinstance(scene, PhotoScene):
        linear = photograph(scene.file, scene.width, in_colour)
    else:
        overlap = max(2, scene.width // _OVERLAP) if is_round else 0
        shape = scene.height, scene.width + overlap
        linear = srgb_to_linear(street(shape, scene.seed))
        if isinstance(scene, NightScene):
            linear = _at_night(linear, scene.seed, scene.range_db)
        if in_colour:
            linear = linear[..., None] * _paint(shape, scene.seed)
        if is_round:
            linear = _joined(linear, overlap)
    mean = float(linear.mean(dtype=np.float64)) * (3 if in_colour else 1)
    if mean == 0 and isinstance(scene, PhotoScene):
        raise InputError(f"{scene.file} is black: no flux can be made of it; take another photograph")
    linear *= np.float32(flux / mean)
    return linear


def street(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Draw a street of shops: (height, width) tones in [0, 1], encoded as sRGB; a wider street has more houses."""
    drawing = Drawing(shape, read_scene("street")["height"], pictures_of("street"), np.random.default_rng(seed))
    return drawing.finished("street", {})


def _at_night(paint: NDArray[np.float32], seed: int, range_db: float) -> NDArray[np.float32]:
    """Light a street, (H, W) of linear reflectance, by lamps and windows; return intensities of at most 1."""
    light_of = read_scene("street")["night"]
    lamps, windows = light_of["lamps"], light_of["windows"]
    rng = np.random.default_rng((seed, 1))
    height, width = paint.shape
    unit = height / read_scene("street")["height"]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    light, glow = np.full(paint.shape, light_of["sky"], np.float32), np.zeros(paint.shape, np.float32)
    n_lamps = max(2, round(width / unit / lamps["every"]))
    for place in range(n_lamps):
        lamp_x = (place + rng.uniform(0.25, 0.75)) * width / n_lamps
        lamp_y, strength = rng.uniform(*lamps["between"]) * unit, 10 ** rng.uniform(-0.7, 0)
        distance2 = ((x - lamp_x) ** 2 + (y - lamp_y) ** 2) / (lamps["pool"] * unit) ** 2
        light += np.float32(strength) / (1 + distance2) ** 1.5
        glow += np.float32(strength * lamps["light"]) * np.exp(-distance2 * np.float32((lamps["pool"] / lamps["bulb"]) ** 2))
    wide, tall = (side * unit for side in windows["size"])
    for _ in range(round(windows["for_each_lamp"] * n_lamps)):
        left, top = rng.uniform(0, width), rng.uniform(*windows["between"]) / 100 * height
        box = np.s_[int(top) : int(top + tall) + 1, int(left) : int(left + wide) + 1]
        light[box] += np.float32(windows["light"] * 10 ** rng.uniform(-1, 0))
    scene = cv2.GaussianBlur(np.maximum(paint, np.float32(0.02)) * light + glow, (0, 0), _NIGHT_BLUR_PX)
    stops = np.log(scene / scene.max())
    return np.asarray(np.exp(stops * (range_db / 20 * np.log(10) / -stops.min())), np.float32)


def _paint(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Return shares of red, green and blue whose sum is 1, (H, W, 3): patches of strong and pale colours, with sharp edges."""
    from scipy.spatial import KDTree

    height, width = shape
    rng = np.random.default_rng((seed, 1))
    n_patches = max(8, round(_PATCHES * width / height))
    places = rng.uniform((0, 0), (height, width), (n_patches, 2))
    logs = np.clip(_COLOUR_STD * rng.standard_normal((n_patches, 2)), -_STRONGEST_COLOUR, _STRONGEST_COLOUR)
    shares = np.exp(np.stack([logs[:, 0], np.zeros(n_patches), logs[:, 1]], axis=-1))
    shares /= shares.sum(axis=-1, keepdims=True)
    nearest = KDTree(places).query(np.indices(shape).reshape(2, -1).T)[1].reshape(shape)
    return np.asarray(shares[nearest], np.float32)


def _joined(linear: NDArray[np.float32], overlap: int) -> NDArray[np.float32]:
    """Fade the last columns of a drawing into the first ones, so that its ends meet; it loses `overlap` columns."""
    share = ((np.arange(overlap, dtype=np.float32) + 0.5) / overlap).reshape(-1, *[1] * (linear.ndim - 2))
    joined = linear[:, :-overlap].copy()
    joined[:, :overlap] = share * linear[:, :overlap] + (1 - share) * linear[:, -overlap:]
    return joined


def photograph(path: Path, width: int | None = None, in_colour: bool = False) -> NDArray[np.float32]:
    """Return the linear luminance of a photograph, from 0 to 1, or its linear red, green and blue, (H, W, 3), at a width in px.

    Raises an `InputError` if the file is no image of 8 or 16 bits, or it is too large.
    """
    otherwise = "is not an image that OpenCV reads; save it as PNG or JPEG"
    image = read_picture(path, otherwise, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} holds {image.dtype} values; a photograph has 8 or 16 bits: save it as PNG")
    # Convert a table of all grey levels, and not every pixel.
    linear_of = srgb_to_linear(np.linspace(0, 1, 256**image.dtype.itemsize, dtype=np.float32))
    linear: NDArray[np.float32]
    if in_colour:
        linear = linear_of[image[..., ::-1]]
    else:
        linear = np.zeros(image.shape[:2], np.float32)
        for channel, share in enumerate(_LUMINANCE):
            linear += (np.float32(share) * linear_of)[image[..., channel]]
    if width is not None:
        height = max(1, round(linear.shape[0] * width / linear.shape[1]))
        shrinks = width < linear.shape[1]
        linear = cv2.resize(linear, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR).astype(
            np.float32
        )
    if max(linear.shape[:2]) > _LARGEST:
        raise InputError(
            f"{path} is {linear.shape[0]}x{linear.shape[1]} px; set scene.width so that no side exceeds {_LARGEST} px"
        )
    return linear


def brightness(lamp: Lamp, n_frames: int, frame_rate_hz: float) -> NDArray[np.float64]:
    """Return the light of a lamp in each frame: (n_frames,), 1 on average."""
    turns = np.arange(n_frames) / frame_rate_hz * lamp.frequency_hz
    return np.asarray(1 + lamp.depth * np.cos(2 * np.pi * turns + np.deg2rad(lamp.phase_deg)))


def shares(lamps: tuple[Lamp, ...], scene_shape: tuple[int, int], is_round: bool = False) -> NDArray[np.float32]:
    """Return the share of each lamp in the light of each place of the scene, (N, Hs, Ws), whose ends meet if it `is_round`.

    Where the lamps together would give more than all of the light, each gives less.
    """
    height, width = scene_shape
    found = np.ones((len(lamps), height, width), np.float32)
    for lamp, share in zip(lamps, found, strict=True):
        if lamp.at is not None:
            x, y = lamp.at[0] * width - 0.5, lamp.at[1] * height - 0.5
            std_px = lamp.radius * height
            beside = np.arange(width) - x
            if is_round:
                beside = np.mod(beside + width / 2, width) - width / 2
            across = np.exp(-(beside**2) / (2 * std_px**2))
            down = np.exp(-((np.arange(height) - y) ** 2) / (2 * std_px**2))
            share[:] = np.outer(down, across)
    return np.asarray(found / np.maximum(found.sum(axis=0), 1), np.float32)
