import numpy as np
import pytest

from photonpano.testing import LocatorConformance
from photonpano_example.hooks import PROFILE_SHIFT
from photonpano_example.profiles import offset


class TestProfileShift(LocatorConformance):
    contribution = PROFILE_SHIFT
    motions = ("sub-pixel shift", "shift")  # it estimates shifts only
    free = (4, 5)  # indices into p1 to p8: the kit's shifts do not roll, so the other parameters are not compared
    tolerance_px = 0.1


@pytest.mark.parametrize("shift", [-12.75, -0.3, 0.0, 0.5, 9.0])
def test_offset_finds_shift_of_two_curves(shift: float) -> None:
    def bumps(at: np.ndarray) -> np.ndarray:
        return np.exp(-(((at - 40) / 6) ** 2)) + 0.5 * np.exp(-(((at - 60) / 4) ** 2))

    samples = np.arange(100.0)
    assert offset(bumps(samples), bumps(samples - shift), furthest=30) == pytest.approx(shift, abs=0.05)
