"""Make an image in colour of the images of single colours: fill gaps, share detail against noise, use clear pixels."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.photometry import frame_variance
from photonpano.values import BoolArray, FloatArray, FluxImage, Panorama, Response

# The colours of a panorama, in the order of its third axis; the images of a filter array may have a fourth one, clear.
COLOURS = ("red", "green", "blue")
# A colour is thin where it was seen in less than this part of the frames that are its due; its neighbours count there, too.
_THIN = 0.1
_ENOUGH = 0.2  # a neighbourhood is large enough if each colour has this part of its share of the frames in it
_LARGEST = 8  # neighbourhoods are doubled at most this many times
_ROUNDS = 3  # times that the sum of the colours, and their ratios to it, follow from each other
_RATIO_PX = 1.5  # standard deviation of the Gaussian over which the ratio of a colour to the sum of all is averaged
_WINDOW_PX = 1.5  # standard deviation of the Gaussian over which the detail of a colour's own is measured
_DARKEST = np.float32(1e-4)  # least flux of which the noise is taken
_FEWEST_FRAMES = 1e-3


def in_colours(source: Source, render: Callable[[Source], Panorama]) -> Panorama:
    """Render a source, (H, W), by a function; that of a filter array colour by colour, (H, W, C)."""
    colours = capture_of(source).colours()
    if not colours:
        return render(source)
    parts = [render(each) for each in colours.values()]
    flux, weight = (np.stack([getattr(part, name) for part in parts], axis=-1) for name in ("flux", "weight"))
    return Panorama(flux, weight, parts[0].canvas)


def channels_of(source: Source) -> int:
    """Return the number of images that `in_colours` renders."""
    return len(capture_of(source).colours()) or 1


def composed(panorama: Panorama, source: Source) -> Panorama:
    """Return red, green and blue, (H, W, 3), of what `in_colours` rendered; a grey panorama as it is.

    Where a colour was hardly seen, or not at all, it follows from the others: see `filled`. Noise is lower by the detail that
    the colours share: see `with_shared_detail`. Clear pixels count for all colours: see `with_clear`. The weight is the number
    of frames that saw the place in this colour; it is 0 where the flux was filled. Flux is NaN in all colours where none was
    seen.
    """
    capture = capture_of(source)
    if capture.colour is None:
        return panorama
    flux, weight = filled(panorama.flux, panorama.weight), panorama.weight
    seen, trusted = seen_in(panorama), np.maximum(weight, _due(weight))
    flux = with_shared_detail(np.nan_to_num(flux), trusted, source.response)
    if flux.shape[-1] > len(COLOURS):
        flux = with_clear(flux, trusted, capture.clear_mix(), source.response)
    flux[~seen] = np.nan
    flux, weight = (np.ascontiguousarray(each[..., : len(COLOURS)]) for each in (flux, weight))
    return Panorama(flux, weight, panorama.canvas)


def filled(flux: FluxImage, weight: FluxImage) -> FluxImage:
    """Fill the places that a colour of (H, W, C) was hardly seen at, from its neighbourhood and from the other colours there.

    The ratio of colours changes less from place to place than their sum does. The sum at a place is that of the flux expected
    of each colour, times the photons seen there over those expected; at first, the mean around the place is expected. Then the
    flux expected of a colour is the sum, times the ratio of the two where the colour was seen around the place. The
    neighbourhood is as small as it can be with all colours in it. What was seen is averaged with what is expected by the number
    of frames, so that nothing jumps where the filling begins. Flux is NaN where nothing was seen.
    """
    due = _due(weight)
    thin: BoolArray = np.any(weight < due, axis=-1)
    if not thin.any():
        return flux
    # Only a box around the thin places is computed.
    rows, columns = (np.unique(each) for each in np.nonzero(thin))
    margin = 2 ** (_LARGEST - 2)
    box = tuple(slice(max(0, each[0] - margin), each[-1] + 1 + margin) for each in (rows, columns))
    seen, frames = np.nan_to_num(flux[box]), weight[box]
    share = weight.sum(axis=(0, 1)) / weight.sum()
    photons = frames * seen
    followed = _around(photons, frames, frames, share)
    for _ in range(_ROUNDS):
        expected = (frames * followed).sum(axis=-1)
        brightness = np.divide(photons.sum(axis=-1), expected, out=np.ones_like(expected), where=expected > 0)
        luminance = (brightness * followed.sum(axis=-1))[..., None]
        followed = luminance * _around(photons, frames * luminance, frames, share)
    lacking = np.maximum(due[box] - frames, 0)
    both = frames + lacking
    mixed = np.divide(frames * seen + lacking * followed, both, out=np.full_like(seen, np.nan), where=both > 0)
    result = flux.copy()
    result[box] = np.where(lacking > 0, mixed, flux[box])
    result[~(weight > 0).any(axis=-1)] = np.nan
    return result


def with_clear(flux: FluxImage, weight: FluxImage, mix: FloatArray, response: Response) -> FluxImage:
    """Correct red, green and blue by what clear pixels saw: the least-squares flux of all four.

    With photon noise of the variances v of the colours and u of the clear pixels, whose flux is `c = mix . f`, the flux becomes
    `f + v mix (c - mix . f) / (u + mix . v mix)`: (H, W, 4), the last one clear, become (H, W, 3).
    """
    colours, clear = flux[..., : len(COLOURS)], flux[..., -1]
    variance = frame_variance(np.maximum(flux, _DARKEST), response) / np.maximum(weight, np.float32(1e-3))
    factors = mix.astype(np.float32)
    gain = variance[..., :-1] * factors
    difference = clear - colours @ factors
    step = difference / np.maximum(variance[..., -1] + gain @ factors, np.float32(1e-12))
    return np.asarray(np.maximum(colours + gain * step[..., None], 0), np.float32)


def with_shared_detail(flux: FluxImage, weight: FluxImage, response: Response) -> FluxImage:
    """Return the flux of each colour, (H, W, C), with less noise where all colours have the same detail.

    What is expected of a colour is the brightness of the place, from the photons of all colours, times the ratio of the colour
    to the brightness around the place. The flux differs from that by photon noise of the variance v, and by detail of the
    colour's own of the variance e, which is measured around the place. The linear estimate with the least error is

        expected + e / (e + v) (flux - expected)                        (Wiener 1949)

    With many photons it is the flux itself.
    """
    weight = np.maximum(weight, np.float32(_FEWEST_FRAMES))
    photons = flux * weight
    mean = _blurred(photons, _RATIO_PX) / _blurred(weight, _RATIO_PX)
    brightness = photons.sum(axis=-1) / np.maximum((weight * mean).sum(axis=-1), np.float32(1e-9))
    luminance = (brightness * mean.sum(axis=-1))[..., None]
    below = np.maximum(_blurred(weight * luminance, _RATIO_PX), np.float32(1e-9))
    expected = luminance * _blurred(photons, _RATIO_PX) / below
    noise = frame_variance(np.asarray(np.maximum(expected, _DARKEST), np.float32), response) / weight
    certain = 1 / np.maximum(noise, np.float32(1e-12))
    difference = flux - expected
    own = _blurred(difference**2 * certain - 1, _WINDOW_PX) / _blurred(certain, _WINDOW_PX)
    own = np.maximum(own, 0)
    return np.asarray(np.maximum(expected + own / np.maximum(own + noise, np.float32(1e-12)) * difference, 0), np.float32)


def _due(weight: FluxImage) -> FluxImage:
    """Return the number of frames below which each colour is thin: (H, W, C)."""
    share = weight.sum(axis=(0, 1)) / max(float(weight.sum()), 1e-9)
    return np.asarray(_THIN * weight.sum(axis=-1, keepdims=True) * share, np.float32)


def _around(above: FluxImage, below: FluxImage, weight: FluxImage, share: NDArray[np.float32]) -> FluxImage:
    """Return the ratio of two sums over the smallest neighbourhood of each place that has all colours: (H, W, C).

    `weight` is in frames; `share` (C,) of all frames saw each colour.
    """
    height, width = weight.shape[:2]
    found, known = np.zeros_like(above), np.zeros((height, width), np.bool_)
    last = min(_LARGEST, int(np.log2(max(1, min(height, width)))))
    for level in range(last + 1):
        over, under, frames = (_smooth(each, (height, width)) for each in (above, below, weight))
        ratio = np.divide(over, under, out=np.zeros_like(over), where=under > 0)
        enough = np.all((frames > 0) & (frames >= _ENOUGH * share * frames.sum(axis=-1, keepdims=True)), axis=-1)
        new = ~known if level == last else enough & ~known
        found[new], known = ratio[new], known | new
        if known.all():
            break
        above, below, weight = (_halved(each) for each in (above, below, weight))
    return found


def _smooth(image: FluxImage, shape: tuple[int, int]) -> FluxImage:
    """Blur an image by 1 px of its own, and enlarge it to a shape."""
    blurred = cv2.GaussianBlur(image, (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
    enlarged = blurred if image.shape[:2] == shape else cv2.resize(blurred, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged, np.float32).reshape(*shape, -1)


def _halved(image: FluxImage) -> FluxImage:
    """Average squares of 2 px; an odd row or column at the end is left as it is."""
    height, width, n_colours = image.shape
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    averaged = padded.reshape(-(-height // 2), 2, -(-width // 2), 2, n_colours).mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(averaged, np.float32)


def _blurred(image: FluxImage, std_px: float) -> FluxImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), std_px, borderType=cv2.BORDER_REFLECT), np.float32)


def seen_in(panorama: Panorama) -> BoolArray:
    """Return where a panorama was seen, in any colour: (H, W)."""
    return np.asarray(panorama.weight > 0 if panorama.weight.ndim == 2 else (panorama.weight > 0).any(axis=-1))
