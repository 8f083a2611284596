"""Footprints of frames on a grid."""

import numpy as np
import pytest

from photonpano.geometry import Canvas, inverse, rescaling, translation
from photonpano.merging.footprints import Footprint, footprints_of

FRAME, GRID = (254, 496), Canvas(300, 700, np.eye(3))


def footprints(to_grid: np.ndarray) -> list[Footprint]:
    return footprints_of(GRID, None, to_grid, FRAME)


def test_footprint_of_shift_covers_shifted_frame() -> None:
    (footprint,) = footprints(translation(10.5, 20.25)[None])
    assert footprint.shrink == 1
    assert (footprint.rows, footprint.columns) == (range(19, 276), (range(9, 508),))
    assert footprint.to_image == pytest.approx(translation(-10.5, -20.25))


def test_footprint_is_empty_outside_of_grid() -> None:
    for shift in (translation(800, 0), translation(-600, 0), translation(0, 400)):
        (footprint,) = footprints(shift[None])
        assert not (footprint.rows and footprint.columns)


def test_footprint_shrinks_frame_on_coarse_grid() -> None:
    found = footprints(np.array([rescaling(1), rescaling(0.5), rescaling(0.26)]))
    assert [footprint.shrink for footprint in found] == [1, 2, 3]
    assert found[1].to_image == pytest.approx(np.eye(3))
    assert found[2].to_image == pytest.approx(inverse(rescaling(0.26) @ rescaling(3)))
