"""How alike two noisy images are, and whether chance would make them so."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.values import FloatArray

_FEWEST = 50
"""Fewer independent pixels than this correlate by chance."""
_STANDS_OUT = 5.0
"""The variance of a scene exceeds that of the noise by at least so many of its standard errors."""
_LAGS = 4
"""Autocorrelations are known up to lags of the sides of an image over this."""
_CHANCE = 5.5
"""What an alignment finds is to agree by so many standard deviations of chance, since it looks for what agrees. Of 576 pairs of
one place at flux 0.02 and 0.1, among them pale and blurred ones, those that `direct` aligned scored 6.6 and more; of 370 smears
and pairs of different places none reached 5.2, and up to 0.77 in correlation. What repeats itself, as windows do, may pass."""


class Likeness(NamedTuple):
    """How alike two images are.

    Attributes:
        correlation: what it would be without noise: 1 where they show the same, around 0 where they do not, and 0 where
            nothing stands out from the noise.
        structures: how many independent samples their pixels are worth; structures, where there is little noise.
        score: the correlation that is seen, in standard deviations of what chance gives with so many.
    """

    correlation: float
    structures: float
    score: float

    @property
    def evidence(self) -> dict[str, float]:
        """The numbers that decide, for the record."""
        return {"agreement": self.correlation, "structures": self.structures}

    def objection(self, least: float) -> str | None:
        """Return why images that were aligned do not show the same place; None if they do.

        Args:
            least: the correlation that is asked for.
        """
        if self.correlation < least:
            if not self.correlation:
                return "where the images overlap after alignment, nothing stands out from photon noise"
            return f"after alignment the images agree by {self.correlation:.2f}, less than min_agreement = {least:g}"
        if self.score < _CHANCE:
            return (
                f"after alignment the images agree by {self.correlation:.2f}, but what they show amounts to "
                f"{self.structures:.0f} independent structures, and so few may agree by chance"
            )
        return None


def noise_free_correlation(
    first: NDArray[np.float32], second: NDArray[np.float32], noise: tuple[float, float], independent: float
) -> float:
    """Return the correlation that two images would have without their noise.

    Args:
        first: (N,) pixels of one image.
        second: (N,) what the other one shows there.
        noise: the variance of the noise of a pixel of each.
        independent: how many of the N pixels have noise of their own; fewer where images were blurred.

    Returns:
        1 where they show the same; around 0 where they do not, and 0 where there are hardly any pixels, or nothing stands out
        from the noise, so that any two places look alike.
    """
    return correlation_without_noise(np.cov(first, second), noise, independent)


def correlation_without_noise(covariance: FloatArray, noise: tuple[float, float], independent: float) -> float:
    """Return the correlation that two images would have without their noise; see `noise_free_correlation`.

    Args:
        covariance: (2, 2) that of the pixels of both images.
        noise: the variance of the noise of a pixel of each.
        independent: how many pixels have noise of their own.
    """
    if independent < _FEWEST:
        return 0.0
    (first, both), (_, second) = np.asarray(covariance).tolist()
    scene = first - noise[0], second - noise[1]
    if any(left < _STANDS_OUT * math.sqrt(2 / independent) * of for left, of in zip(scene, noise, strict=True)):
        return 0.0
    return float(both / math.sqrt(scene[0] * scene[1]))


def autocorrelation(image: NDArray[np.float32]) -> FloatArray:
    """Return the autocorrelation of an image at lags of up to a quarter of its sides, 1 at lag 0; all 0 for one that is flat.

    Args:
        image: (H, W), of mean 0; 0 where it is not known.

    Returns:
        (2 H // 4 + 1, W // 4 + 1): lags along y from the most negative to the largest, lags along x from 0.
    """
    down, across = (side // _LAGS for side in image.shape)
    # So wide that what leaves at one side does not come back at the other, and of factors that are quick to transform.
    shape = _rounded_up(image.shape[0] + down), _rounded_up(image.shape[1] + across)
    spectrum = np.fft.rfft2(image, shape)
    products = np.fft.irfft2(spectrum.real**2 + spectrum.imag**2, shape)
    lags = np.roll(products, down, axis=0)[: 2 * down + 1, : across + 1]
    return np.asarray(lags / lags[down, 0] if lags[down, 0] > 0 else np.zeros_like(lags))


def _rounded_up(length: int) -> int:
    return -(-length // 32) * 32


def likeness_of(
    covariance: FloatArray,
    noise: tuple[float, float],
    pixels: float,
    independent: float,
    autocorrelations: tuple[FloatArray, FloatArray],
) -> Likeness:
    """Return how alike two aligned images are.

    Pixels that depend on each other tell less than their number: a correlation of two images with the autocorrelations a and b
    has the variance of one between N / sum(a b) independent samples (Bartlett 1946), whose `arctanh` is normal with a standard
    deviation of 1 / sqrt(samples - 3) (Fisher 1921).

    Args:
        covariance: (2, 2) that of the pixels of both images.
        noise: the variance of the noise of a pixel of each.
        pixels: how many there are.
        independent: how many of them have noise of their own; fewer where images were blurred.
        autocorrelations: those of both images, from `autocorrelation`.
    """
    first, second = autocorrelations
    # Lags across are given from 0: all others count for their opposites, too.
    products = first * second
    area = 2 * products.sum() - products[:, 0].sum()
    structures = pixels / max(1.0, float(area))
    seen = covariance[0, 1] / math.sqrt(max(covariance[0, 0] * covariance[1, 1], np.finfo(float).tiny))
    score = math.atanh(min(float(seen), 1 - 1e-9)) * math.sqrt(max(0.0, structures - 3))
    return Likeness(correlation_without_noise(covariance, noise, independent), structures, score)
