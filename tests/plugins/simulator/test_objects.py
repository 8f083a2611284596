from __future__ import annotations

import numpy as np
import pytest

from photonpano_simulator.config import FrameObject
from photonpano_simulator.objects import DrawnObject

SHAPE = (40, 60)


def covered(**settings: object) -> np.ndarray:
    """Return the share of each pixel that an object covers: it is dark, and drawn over light."""
    config = FrameObject.model_validate({"flux": 0.0, **settings})
    view = np.ones(SHAPE, np.float32)
    DrawnObject(config, SHAPE, 1.0, np.zeros((10, 2))).draw(view, 4)
    return 1 - view


@pytest.mark.parametrize("size", [(0.5, 0.5), (0.2, 0.9), (0.31, 0.47)])
def test_a_disc_is_the_largest_in_its_rectangle(size: tuple[float, float]) -> None:
    disc, rectangle = covered(shape="disc", size=size), covered(size=size)
    diameter = min(size[0] * SHAPE[1], size[1] * SHAPE[0])
    assert disc.sum() == pytest.approx(np.pi / 4 * diameter**2, rel=0.005)
    assert not disc[rectangle == 0].any()
    y, x = np.nonzero(disc > 0.5)
    assert (x.mean(), y.mean()) == pytest.approx((29.5, 19.5), abs=1e-9)
    assert max(np.ptp(x), np.ptp(y)) + 1 == pytest.approx(diameter, abs=1.01)


def test_a_disc_moves_as_its_rectangle() -> None:
    disc = covered(shape="disc", size=(0.3, 0.3), at=(0.25, 0.5), moves_px=(1.5, -0.5))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    assert ((disc * x).sum() / disc.sum(), (disc * y).sum() / disc.sum()) == pytest.approx((14.5 + 6, 19.5 - 2), abs=0.01)
