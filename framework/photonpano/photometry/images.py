"""Images of flux: their contrast, the similarity of two aligned ones, and pictures of 8 bits by tone curves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, FloatArray, VirtualExposure

# Factors of red, green and blue in a picture: all 1, those that make the mean grey, or given ones.
WhiteBalance: TypeAlias = Literal["none", "grey-world"] | tuple[float, float, float]
# Range of OpenCV's operators, in powers of ten: what is darker than 1e-4 of the brightest pixel is black in them.
_OPENCV_DECADES = 4.0
_FLOOR_QUANTILE = 0.01  # quantile of the positive flux that is the darkest in a picture; below, there is mostly noise
_EVEN = 1.01  # an image that is not brighter than its darkest pixels by this factor has no range to compress
_WHITE_QUANTILE = 0.995  # quantile that is white after an operator that has a brightness of its own
_ERRORS = 2  # the log level of OpenCV at which it writes errors only
_BASE_STOPS = 4.5  # range to which `local` compresses the light without its details, in powers of two
_BASE_SHARE = 1 / 60  # radius of the details that `local` keeps, as a share of the longer side
_BASE_EDGE = 1.0  # steps of more than this many stops count as edges of the light, not as details
LOCAL_PX = 13  # side of the square whose mean is subtracted from each pixel before images are compared, px
_MIN_INDEPENDENT = 50  # with fewer independent pixels, a correlation is not estimated
_MIN_SIGMA = 5.0  # least variance of a scene, in standard errors of the variance of its noise
_LAGS = 4  # the largest lag of an autocorrelation is the side of the image over this
# Least score of an accepted pair; high, because an alignment searches for the best correlation. Of 576 pairs of one place at
# flux 0.02 and 0.1, pale and blurred ones among them, those that `direct` aligned scored 6.6 and more; of 370 pairs of smears
# or of different places none reached 5.2, at correlations of up to 0.77. Repeated texture, such as windows, may pass.
_MIN_SCORE = 5.5
_ROWS = 16  # rows of blocks that are sampled
_BLOCK = 4  # side of the blocks, px, whose averages separate scene and noise: averaging reduces the noise and hardly the scene


def srgb_to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1): encoded values in [0, 1] to linear intensities in [0, 1]."""
    encoded = np.asarray(encoded, dtype=np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Apply the sRGB curve: linear intensities, clipped to [0, 1], to encoded values in [0, 1]. NaN stays NaN."""
    linear = np.clip(np.asarray(linear, dtype=np.float32), 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def balanced(flux: NDArray[np.float32], white_balance: WhiteBalance) -> NDArray[np.float32]:
    """Multiply the colours of an image by the factors of a white balance; a grey image stays as it is.

    Flux is (H, W), or (H, W, 3) of red, green and blue; NaN where unknown. "grey-world" makes the means of the colours equal,
    and keeps that of green.
    """
    if flux.ndim == 2 or white_balance == "none":
        return flux
    if white_balance != "grey-world":
        return np.asarray(flux * np.array(white_balance, np.float32), np.float32)
    return np.asarray(flux * grey_world(flux), np.float32)


def grey_world(flux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the factors of red, green and blue that make the means of an image equal, and keep that of green: (3,)."""
    means = np.nanmean(flux, axis=(0, 1)) if np.isfinite(flux).any() else np.ones(3, np.float32)
    return np.asarray(means[1] / np.maximum(means, 1e-6), np.float32)


def tone_mapped(flux: NDArray[np.float32], white: float, *, srgb: bool = True) -> NDArray[np.uint8]:
    """Return a picture of 8 bits: `white` photons per pixel per frame and more become 255, unknown pixels are black.

    Flux is of any shape, photons per pixel per frame, NaN where unknown. Levels follow the sRGB curve, for screens, or are
    proportional to it.
    """
    level = linear_to_srgb(flux / white) if srgb else np.clip(flux / white, 0, 1)
    return np.asarray(np.nan_to_num(level) * 255 + 0.5).astype(np.uint8)


# How flux becomes a picture: the sRGB curve, three operators of OpenCV, and one that keeps local contrast.
Tone = Literal["srgb", "reinhard", "drago", "mantiuk", "local"]


def picture_of(flux: NDArray[np.float32], white: float, tone: Tone = "srgb", stops: float = 0.0) -> NDArray[np.uint8]:
    """Return a picture of 8 bits in sRGB; unknown pixels are black.

    Args:
        flux: (H, W) or (H, W, 3), photons per pixel per frame, NaN where unknown.
        white: flux that becomes white with the tone "srgb"; the others find their own.
        tone: "srgb" shows flux up to `white` as it is. The others compress the range: "reinhard" (Reinhard and Devlin 2005),
            "drago" (Drago et al. 2003) and "mantiuk" (Mantiuk et al. 2006) with OpenCV; "local" compresses the light and keeps
            the details, as Durand and Dorsey 2002.
        stops: exposure: how much brighter the picture is, in powers of two.
    """
    if tone == "srgb":
        return tone_mapped(flux, white / 2**stops)
    known = np.isfinite(flux)
    positive = flux[known & (flux > 0)]
    if not positive.size:
        return np.zeros(flux.shape, np.uint8)
    floor = np.quantile(positive, _FLOOR_QUANTILE)
    lit = np.where(known, np.maximum(flux, floor), floor).astype(np.float32)
    if lit.max() < _EVEN * floor:
        return tone_mapped(flux, float(lit.max()) / 2**stops)
    linear = _local(lit) if tone == "local" else _by_opencv(lit, tone)
    level = float(np.quantile(linear[known], _WHITE_QUANTILE)) or 1.0
    return tone_mapped(np.where(known, linear, np.nan), level / 2**stops)


def _by_opencv(flux: NDArray[np.float32], tone: Tone) -> NDArray[np.float32]:
    """Compress flux with an operator of OpenCV: to linear, from 0 to 1. A larger range is first compressed evenly."""
    import cv2

    relative = flux / flux.max()
    decades = -float(np.log10(relative.min()))
    held = np.asarray(relative ** min(1.0, _OPENCV_DECADES / max(decades, 1e-6)), np.float32)
    coloured = held if held.ndim == 3 else np.repeat(held[..., None], 3, axis=-1)
    operator: Any
    match tone:
        case "reinhard":
            operator = cv2.createTonemapReinhard(1.0, 0.0, 0.5, 0.0)
        case "drago":
            operator = cv2.createTonemapDrago(1.0)
        case _:
            operator = cv2.createTonemapMantiuk(1.0, 0.7)
    verbosity = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(_ERRORS)  # OpenCV 5.0 warns of its own code
    try:
        toned = np.nan_to_num(operator.process(np.ascontiguousarray(coloured)))
    finally:
        cv2.utils.logging.setLogLevel(verbosity)
    return np.asarray(np.clip(toned if held.ndim == 3 else toned[..., 0], 0, 1), np.float32)


def _local(flux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compress the light of each region and keep the details in it, with a guided filter (He et al. 2013) of the logarithm."""
    import cv2

    brightness = flux if flux.ndim == 2 else flux.mean(axis=-1)
    stops = np.asarray(np.log2(brightness), np.float32)
    side = 2 * max(2, round(max(stops.shape) * _BASE_SHARE)) + 1

    def mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)

    average = mean(stops)
    variance = np.maximum(mean(np.asarray(stops * stops, np.float32)) - average * average, 0)
    gain = np.asarray(variance / (variance + np.float32(_BASE_EDGE**2)), np.float32)
    base = mean(gain) * stops + mean(np.asarray((1 - gain) * average, np.float32))
    dark, bright = np.quantile(base, (1 - _WHITE_QUANTILE, _WHITE_QUANTILE))
    factor = np.float32(min(1.0, _BASE_STOPS / max(float(bright - dark), 1e-6)))
    change = np.exp2((factor - 1) * (base - np.float32(bright)))
    return np.asarray(flux * (change if flux.ndim == 2 else change[..., None]), np.float32)


def hann_window(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the Hann window of OpenCV: (H, W), 0 at the edges of an image; along sides of 1 or 2 px it is constant."""
    import cv2

    height, width = (max(side, 3) for side in shape)
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    for axis, side in enumerate(shape):
        if side < 3:
            window = np.repeat(window.take([1], axis), side, axis)
    return np.asarray(window)


tapered = hann_window  # deprecated: use `hann_window`


class Similarity(NamedTuple):
    """Similarity of two aligned images."""

    # correlation without noise: 1 for the same scene, around 0 for different ones, 0 where the variance of the scene cannot be
    # distinguished from that of the noise
    correlation: float
    structures: float  # effective number of independent samples
    score: float  # significance of the observed correlation, in standard deviations of that of unrelated images

    @property
    def evidence(self) -> dict[str, float]:
        """The numbers that decide, for the record."""
        return {"similarity": self.correlation, "structures": self.structures}

    def why_different(self, min_correlation: float) -> str | None:
        """Return why the images are not accepted as views of one place, by the option `min_agreement`; None if they are."""
        if self.score < _MIN_SCORE and not self.correlation:
            return "where the images overlap after alignment, nothing stands out from photon noise"
        # A few structures may be certain where, all over the image, the scene varies by no more than its noise.
        if self.correlation and self.correlation < min_correlation:
            return (
                f"after alignment the similarity of the images is {self.correlation:.2f}, "
                f"less than min_agreement = {min_correlation:g}"
            )
        if self.score < _MIN_SCORE:
            return (
                f"after alignment the similarity of the images is {self.correlation:.2f}, but with {self.structures:.0f} "
                "independent structures in them this may be chance"
            )
        return None


def without_local_mean(image: NDArray[np.float32], seen: BoolArray) -> NDArray[np.float32]:
    """Subtract from each pixel, (H, W) float32, the mean of the 13 px square around it; 0 where not seen.

    Large shadows and gradients look alike in any two images; what remains is what distinguishes one place from another. Pixels
    where `seen` is False count in no mean.
    """
    import cv2

    def local_mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values, (LOCAL_PX, LOCAL_PX)), np.float32)

    mask = seen.astype(np.float32)
    seen_share = np.maximum(local_mean(mask), np.float32(1e-6))
    return np.asarray((image - local_mean(image * mask) / seen_share) * mask, np.float32)


def noise_free_correlation(covariance: FloatArray, noise: tuple[float, float], independent: float) -> float:
    """Return the correlation that two images would have without their noise, by the (2, 2) covariance of their pixels.

    It is 1 for the same scene and around 0 for different ones; 0 where there are fewer than 50 independent pixels, or where the
    scene does not stand out from the noise. `noise` is the variance of the noise of a pixel of each image; `independent`, the
    number of pixels with independent noise, is less than that of pixels where images are blurred.
    """
    if independent < _MIN_INDEPENDENT:
        return 0.0
    (first, both), (_, second) = np.asarray(covariance).tolist()
    scene = first - noise[0], second - noise[1]
    if any(signal < _MIN_SIGMA * math.sqrt(2 / independent) * variance for signal, variance in zip(scene, noise, strict=True)):
        return 0.0
    return float(both / math.sqrt(scene[0] * scene[1]))


def autocorrelation(image: NDArray[np.float32]) -> FloatArray:
    """Return the autocorrelation of an image at lags of up to a quarter of its sides: 1 at lag 0, all 0 for a flat image.

    The image, (H, W), has the mean 0, and is 0 where nothing was seen. The result is (2 H // 4 + 1, W // 4 + 1): lags along y
    from the most negative to the largest, lags along x from 0.
    """
    down, across = (side // _LAGS for side in image.shape)
    # Padded against wrap-around, to a length whose transform is fast.
    shape = _rounded_up(image.shape[0] + down), _rounded_up(image.shape[1] + across)
    spectrum = np.fft.rfft2(image, shape)
    products = np.fft.irfft2(spectrum.real**2 + spectrum.imag**2, shape)
    lags = np.roll(products, down, axis=0)[: 2 * down + 1, : across + 1]
    return np.asarray(lags / lags[down, 0] if lags[down, 0] > 0 else np.zeros_like(lags))


def _rounded_up(length: int) -> int:
    return -(-length // 32) * 32


def similarity_of(
    covariance: FloatArray,
    noise: tuple[float, float],
    pixels: float,
    independent: float,
    autocorrelations: tuple[FloatArray, FloatArray],
) -> Similarity:
    """Return the similarity of two aligned images.

    With N pixels and the autocorrelations a and b, the correlation of unrelated images has the variance of N / sum(a b)
    independent samples (Bartlett 1946); its `arctanh` is normal with standard deviation 1 / sqrt(samples - 3) (Fisher 1921).

    Args:
        covariance: (2, 2) covariance of the pixels of both images.
        noise: variance of the noise of a pixel of each image.
        pixels: number of pixels that both images show.
        independent: number of pixels with independent noise; less than `pixels` where images are blurred.
        autocorrelations: those of both images, from `autocorrelation`.
    """
    first, second = autocorrelations
    # Lags along x start at 0: all others stand for their opposites, too.
    products = first * second
    area = 2 * products.sum() - products[:, 0].sum()
    structures = pixels / max(1.0, float(area))
    observed = covariance[0, 1] / math.sqrt(max(covariance[0, 0] * covariance[1, 1], np.finfo(float).tiny))
    score = math.atanh(min(float(observed), 1 - 1e-9)) * math.sqrt(max(0.0, structures - 3))
    return Similarity(noise_free_correlation(covariance, noise, independent), structures, score)


def stabilised_flux(exposure: VirtualExposure) -> NDArray[np.float32]:
    """Return the flux of an exposure on the scale on which its noise is uniform, 0 where nothing was seen.

    Where pixels hold less than a photon, values on that scale depend on the number of frames. Those that a mask covers in part
    would be brighter, and stand still while the scene moves: there, all pixels are taken as of the mean number of frames.
    """
    flux, weight = exposure.flux, exposure.weight
    seen = weight > 0
    if not seen.any():
        return np.zeros_like(flux)
    frames, mean = float(weight[seen].mean()), float(flux[seen].mean())
    values = exposure.response.stabilised(flux, weight if frames * mean >= 1 else np.full_like(weight, frames))
    return np.where(seen, values, np.float32(0))


def signal_to_noise(exposure: VirtualExposure) -> float:
    """Return the standard deviation of the scene over that of a pixel's noise, on the scale where noise is uniform.

    At 1 and below, single pixels are mostly noise, and registration needs larger structures. 0 if there is no contrast.
    """
    rows = replace(exposure, flux=_some_rows(exposure.flux), weight=_some_rows(exposure.weight))
    weight, values = rows.weight, stabilised_flux(rows)
    seen = weight > 0
    if not seen.any():
        return 0.0
    sums, counts = sums_of_blocks(values, _BLOCK), sums_of_blocks(seen.astype(np.float32), _BLOCK)
    full = counts == _BLOCK**2
    if np.count_nonzero(full) < 2:
        return 0.0
    noise = float(exposure.response.stabilised_std(np.median(weight[seen], keepdims=True)).item())
    variance = float(np.var(sums[full] / _BLOCK**2)) - noise**2 / _BLOCK**2
    return float(np.sqrt(max(variance, 0.0))) / noise


def _some_rows(image: np.ndarray) -> np.ndarray:
    """Return about `_ROWS` evenly spaced rows of blocks."""
    rows = image[: len(image) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, image.shape[1])
    step = max(1, len(rows) // _ROWS)
    return rows[::step].reshape(-1, image.shape[1])


def sums_of_blocks(images: NDArray[Any], side: int) -> NDArray[Any]:
    """Sum squares of pixels, (..., H, W) to (..., h, w); those that the border cuts are left out."""
    rows, columns = (length // side for length in images.shape[-2:])
    whole = images[..., : rows * side, : columns * side]
    return np.asarray(whole.reshape(*images.shape[:-2], rows, side, columns, side).sum(axis=(-3, -1)))
