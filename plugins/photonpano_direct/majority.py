"""Restrict an alignment to the part of an image that follows the motion of the camera, not that of an object."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano import BoolArray, Homography
from photonpano.geometry import translation
from photonpano.locating import Follows, follows
from photonpano_direct.alignment import buffers_of
from photonpano_direct.moments import Image, Layer, residuals_and_moments
from photonpano_direct.pyramid import Pyramid

JUDGED = 1  # layer on which parts are compared: coarse, so that noise and small errors of the motion do not matter
_DIFFERENT = 0.5  # cap on the residual of a pixel in a search for shifts, relative to its usual one
# Side of the squares compared in a search for shifts, and spacing of the shifts that are tried.
_SEARCH_PX, _NEAR_PX = 5, 2
_LEAST_SEEN = 0.3  # minimum overlap under a shift, as a fraction of the template
_TRIED = 3  # number of shifts that a search returns


def part_following(moving: Layer, fixed: Layer, homography: Homography) -> Follows:
    """Find the part of a template that follows a motion, (3, 3), to pixels of another image of the same shape."""
    buffers = buffers_of(moving)
    residuals_and_moments(moving, fixed, homography, buffers, np.empty((3, 3)), np.empty((3, 3)))
    noise_left = 1 / (4 * np.pi * moving.blur_px**2)
    unknown = np.full_like(buffers.weight, np.inf)
    noise = np.divide(np.float32(noise_left), buffers.weight, out=unknown, where=buffers.weight > 0)
    return follows(moving.image, moving.image + buffers.residual, noise, noise_left)


def shifts_between(moving: Layer, fixed: Layer) -> list[Homography]:
    """Return the shifts under which most of a template fits an image, the best first: what moves otherwise counts half at most.

    All shifts by whole pixels, up to a third of the image, are compared.
    """
    height, width = moving.image.shape
    reach_y, reach_x = height // 3, width // 3
    seen, margins = (moving.weight > 0).astype(np.float32), ((reach_y, reach_y), (reach_x, reach_x))
    image, known = np.pad(fixed.image, margins), np.pad((fixed.weight > 0).astype(np.float32), margins)
    shifts = [(y, x) for y in range(-reach_y, reach_y + 1) for x in range(-reach_x, reach_x + 1)]
    squares = np.empty((len(shifts), height, width), np.float32)
    for index, (y, x) in enumerate(shifts):
        part = slice(reach_y + y, reach_y + y + height), slice(reach_x + x, reach_x + x + width)
        both = known[part] * seen
        near = _blur(both, _SEARCH_PX)
        difference = _blur(((image[part] - moving.image) * both) ** 2, _SEARCH_PX)
        squares[index] = np.where(near > 0.5, difference / np.maximum(near, np.float32(1e-6)), np.float32(np.nan))
    n_seen = np.isfinite(squares).sum(axis=(1, 2))
    # Each pixel counts relative to its usual difference, so that a part with strong contrast counts no more than others.
    ordered = np.sort(squares, axis=0)  # NaN comes last
    middle = np.isfinite(squares).sum(axis=0, keepdims=True) // 2
    usual = np.maximum(np.nan_to_num(np.take_along_axis(ordered, middle, axis=0)), np.float32(1e-12))
    relative = np.minimum(squares / usual, _DIFFERENT)
    cost = np.nansum(relative, axis=(1, 2)) / np.maximum(np.isfinite(relative).sum(axis=(1, 2)), 1)
    cost[n_seen < _LEAST_SEEN * height * width] = np.inf
    found: list[tuple[int, int]] = []
    for index in np.argsort(cost):
        y, x = shifts[index]
        if all(max(abs(y - other_y), abs(x - other_x)) >= _NEAR_PX for other_y, other_x in found):
            found.append((y, x))
        if len(found) == _TRIED:
            break
    return [translation(x, y) for y, x in found]


def masked(pyramid: Pyramid, part: BoolArray) -> Pyramid:
    """Return a pyramid of which only a part is used, given on any of its layers."""

    def limited(weight: Image) -> Image:
        size = weight.shape[1], weight.shape[0]
        return weight * cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    layers = tuple(layer._replace(weight=limited(layer.weight)) for layer in pyramid.layers)
    return pyramid._replace(layers=layers, details=pyramid.details._replace(weight=limited(pyramid.details.weight)))


def _blur(image: Image, side: int) -> Image:
    return np.asarray(cv2.blur(image, (side, side)), np.float32)
