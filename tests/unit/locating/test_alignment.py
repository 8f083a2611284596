from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import Homography, NotLocated
from photonpano.geometry import translation
from photonpano.locating import ALL_PARAMETERS, View, coarse_to_fine, free_parameters, view_pyramid

STILL = np.eye(3)


def test_free_parameters_grow_from_coarse_to_fine() -> None:
    assert [len(free_parameters(depth, 4)) for depth in (3, 2, 1, 0)] == [2, 6, 8, 8]
    assert free_parameters(0, 1) == ALL_PARAMETERS


@pytest.mark.parametrize("failing", [{0}, {1}, {2}, {0, 1, 2}])
def test_coarse_to_fine_skips_layers_that_fail_and_reports_the_finest(seen_from: Callable, failing: set[int]) -> None:
    views = view_pyramid(seen_from(STILL), 1.0, 3, 24)
    starts = {}

    def align(moving: View, fixed: View, start: Homography, depth: int) -> Homography | NotLocated:
        starts[depth] = start * 1.0
        return NotLocated(f"layer {depth}") if depth in failing else start @ translation(1, 0)

    found, failure = coarse_to_fine(views, views, translation(8, 0), align)
    assert len(found) == 3 - len(failing)
    assert failure == (NotLocated("layer 0") if 0 in failing else None)
    shift = 8.0
    for depth in (2, 1, 0):
        assert starts[depth][0, 2] == pytest.approx(shift / 2**depth)
        shift += 0 if depth in failing else 2**depth
    if found:
        assert found[-1][0, 2] == pytest.approx(shift)
