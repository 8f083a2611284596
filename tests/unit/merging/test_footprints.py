"""Where frames land on a grid."""

import numpy as np
import pytest

from photonpano.geometry import inverse, rescaling, translation
from photonpano.merging.footprints import landings

FRAME, GRID = (254, 496), (300, 700)


def test_a_shift_touches_what_it_covers_and_is_straight() -> None:
    (landing,) = landings(translation(10.5, 20.25)[None], FRAME, GRID)
    assert (landing.shrink, landing.straight) == (1, True)
    assert (landing.rows, landing.columns) == (range(19, 276), range(9, 508))
    assert landing.to_image == pytest.approx(translation(-10.5, -20.25))


def test_what_lies_outside_touches_nothing() -> None:
    for shift in (translation(800, 0), translation(-600, 0), translation(0, 400)):
        (landing,) = landings(shift[None], FRAME, GRID)
        assert not (landing.rows and landing.columns)


def test_what_is_turned_is_not_straight() -> None:
    turned = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in (0.005, 0.02)]
    assert [landing.straight for landing in landings(np.array(turned), FRAME, GRID)] == [True, False]


def test_small_grids_average_first() -> None:
    found = landings(np.array([rescaling(1), rescaling(0.5), rescaling(0.26)]), FRAME, GRID)
    assert [landing.shrink for landing in found] == [1, 2, 3]
    assert found[1].to_image == pytest.approx(np.eye(3))
    assert found[2].to_image == pytest.approx(inverse(rescaling(0.26) @ rescaling(3)))
