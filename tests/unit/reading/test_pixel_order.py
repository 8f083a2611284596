from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.reading import PixelOrder, other_order, sampled_spans

ORDERS = {
    PixelOrder(along, order): (axis, order) for along, axis in (("width", 2), ("height", 1)) for order in ("big", "little")
}


USUAL = PixelOrder("width", "big")


def samples_of(frames: np.ndarray, order: PixelOrder = USUAL) -> list[np.ndarray]:
    axis, bit_order = ORDERS[order]
    packed = np.packbits(frames, axis=axis, bitorder=bit_order)
    return [packed[span.start : span.stop] for span in sampled_spans(len(packed), packed[0].size)]


@pytest.mark.parametrize("expected", ORDERS)
@pytest.mark.parametrize("stored", ORDERS)
@pytest.mark.parametrize("flux", [1.0, 0.03])
def test_stored_order_is_found_whichever_was_expected(
    clouds: Callable[..., np.ndarray], stored: PixelOrder, expected: PixelOrder, flux: float
) -> None:
    found = other_order(samples_of(clouds(flux), stored), expected)
    assert (found and found.order) == (None if stored == expected else stored)


def test_figures_are_correlations_within_and_across_bytes(clouds: Callable[..., np.ndarray]) -> None:
    found = other_order(samples_of(clouds(), PixelOrder("width", "little")))
    assert found is not None
    assert found.found == pytest.approx(found.within, abs=0.05)
    assert found.expected < found.within / 2
    assert str(found) == (
        f"pixels correlate by {found.within:.2f} within bytes, by {found.expected:.2f} across their borders, and by "
        f"{found.found:.2f} across their borders if the first pixel is the lowest bit"
    )


def still(flux: np.ndarray, seed: int) -> np.ndarray:
    """Return frames of a camera that stands still."""
    return (np.random.default_rng(seed).random((256, *flux.shape)) < -np.expm1(-flux)).astype(np.uint8)


Y, X = np.mgrid[:64, :96]
PLAIN = {
    "uniform": 1 + 0 * X,
    "gradient": X / 48,
    "vignette": np.exp(-((X - 48) ** 2 + (Y - 32) ** 2) / 1000),
    "columns": np.random.default_rng(0).gamma(4, 0.25, (1, 96)) + 0 * X,
    "rows": np.random.default_rng(0).gamma(4, 0.25, (64, 1)) + 0 * X,
    "pixels": np.random.default_rng(0).gamma(4, 0.25, (64, 96)),
    "hot pixels": np.where(np.random.default_rng(0).random((64, 96)) < 0.05, 1000, 1),
    "a gap every eight columns": np.where(X % 8, 1, 0.2),
    **{f"vertical stripes of {period} px": 1 + 0.8 * (X % period < period / 2) for period in (2, 3, 5, 8, 15, 16)},
    **{f"horizontal stripes of {period} px": 1 + 0.8 * (Y % period < period / 2) for period in (2, 5, 8)},
    **{f"tilted stripes of {period} px": 1 + 0.8 * np.sin((X + 0.4 * Y) * 2 * np.pi / period) for period in (3, 5, 7, 15)},
    **{f"chequers of {side} px": 1 + 0.8 * ((X // side + Y // side) % 2) for side in (1, 4, 5, 8)},
}


@pytest.mark.parametrize("flux", [1.0, 0.1, 0.003])
@pytest.mark.parametrize("scene", PLAIN)
def test_no_order_is_found_in_noise_plain_light_and_regular_patterns(scene: str, flux: float) -> None:
    assert other_order(samples_of(still(flux * PLAIN[scene], seed=1))) is None


@pytest.mark.parametrize("frames", [np.zeros((64, 16, 32), np.uint8), np.ones((64, 16, 32), np.uint8)])
def test_no_order_is_found_in_dark_and_saturated_frames(frames: np.ndarray) -> None:
    assert other_order(samples_of(frames)) is None


@pytest.mark.parametrize("shape", [(3, 64, 96), (64, 1, 96), (64, 64, 8), (64, 1, 1)])
def test_no_order_is_found_in_too_few_pixels(shape: tuple[int, int, int]) -> None:
    assert other_order(samples_of(np.random.default_rng(0).integers(0, 2, shape, np.uint8))) is None
