from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photonpano import InputError, StreamInfo
from photonpano.captures.summary import require_photons
from photonpano.photometry import IntensityResponse

DARK = (
    "no pixel is lit in any of {} frames sampled all over the capture; "
    "check that the file is the right one, and that the lens was open"
)
LIT = (
    "every pixel is lit in all of {} frames sampled all over the capture, so the flux cannot be estimated; "
    "check the layout of the file, or expose less"
)


@pytest.mark.parametrize(("n_frames", "looked_at"), [(1, 1), (40, 40), (256, 256), (257, 256), (1000, 256)])
@pytest.mark.parametrize(("value", "text"), [(0, DARK), (1, LIT)])
def test_require_photons_refuses_all_dark_and_all_lit(
    memory_source: type, n_frames: int, looked_at: int, value: int, text: str
) -> None:
    with pytest.raises(InputError) as caught:
        require_photons(memory_source(np.full((n_frames, 4, 8), value)))
    assert str(caught.value) == text.format(looked_at)


@pytest.mark.parametrize("value", [0, 1])
def test_require_photons_accepts_one_pixel_of_the_last_frame(memory_source: type, value: int) -> None:
    frames = np.full((1000, 4, 8), value)
    frames[-1, 2, 3] = 1 - value
    require_photons(memory_source(frames))


@pytest.mark.parametrize("value", [0, 1])
def test_require_photons_ignores_masked_pixels(memory_source: type, value: int) -> None:
    frames, valid = np.full((100, 4, 8), value), np.ones((4, 8), bool)
    frames[:, 2, 3], valid[2, 3] = 1 - value, False
    with pytest.raises(InputError):
        require_photons(memory_source(frames, valid))


@pytest.mark.parametrize(("level", "text"), [(16, "no pixel is brighter than black"), (235, "every pixel is saturated")])
def test_require_photons_compares_grey_levels_with_black_and_white(memory_source: type, level: int, text: str) -> None:
    with pytest.raises(InputError, match=f"^{text} in"):
        require_photons(grey(memory_source, level))
    require_photons(grey(memory_source, 100))


def grey(memory_source: type, level: int) -> Any:
    """Return a capture of one level, whose black is 16 and whose white is 235."""
    source = memory_source(np.full((40, 4, 8), level))
    source.info, source.response = StreamInfo(40, 4, 8, None, "intensity", 8), IntensityResponse(40.0, 16.0, 235.0, 20.0)
    return source
