"""Contrast of an image and similarity of two aligned ones, without photon noise, and whether chance explains it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, FloatArray, VirtualExposure

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
        """Return why the images are not accepted as views of one place; None if they are.

        Args:
            min_correlation: the value of the option `min_agreement`.
        """
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
    """Subtract from each pixel the mean of the 13 px square around it.

    Large shadows and gradients look alike in any two images; what remains is what distinguishes one place from another.

    Args:
        image: (H, W) float32.
        seen: (H, W) False for pixels that count in no mean.

    Returns:
        (H, W) float32, 0 where not seen.
    """
    import cv2

    def local_mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(values, (LOCAL_PX, LOCAL_PX)), np.float32)

    mask = seen.astype(np.float32)
    seen_share = np.maximum(local_mean(mask), np.float32(1e-6))
    return np.asarray((image - local_mean(image * mask) / seen_share) * mask, np.float32)


def noise_free_correlation(covariance: FloatArray, noise: tuple[float, float], independent: float) -> float:
    """Return the correlation that two images would have without their noise.

    Args:
        covariance: (2, 2) covariance of the pixels of both images.
        noise: variance of the noise of a pixel of each image.
        independent: number of pixels with independent noise; less than the number of pixels where images are blurred.

    Returns:
        1 for the same scene and around 0 for different ones; 0 where there are fewer than 50 independent pixels, or where the
        scene does not stand out from the noise.
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

    Args:
        image: (H, W), of mean 0; 0 where nothing was seen.

    Returns:
        (2 H // 4 + 1, W // 4 + 1): lags along y from the most negative to the largest, lags along x from 0.
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


def signal_to_noise(exposure: VirtualExposure) -> float:
    """Return the standard deviation of the scene over that of a pixel's noise, on the scale where noise is uniform.

    At 1 and below, single pixels are mostly noise, and registration needs larger structures. 0 if there is no contrast.
    """
    flux, weight = _some_rows(exposure.flux), _some_rows(exposure.weight)
    seen = weight > 0
    if not seen.any():
        return 0.0
    values = np.where(seen, exposure.response.stabilised(flux, weight), np.float32(0))
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
