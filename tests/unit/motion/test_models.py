"""Models of the motion: groups of homographies."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from photonpano.geometry import corner_displacements, inverse, normalised
from photonpano.motion.planar import PLANAR_NAMES, PlanarName, basis_of, moved, nearest

from .measured_graphs import SHAPE


@given(model=st.sampled_from(PLANAR_NAMES), steps=st.lists(st.floats(-0.5, 0.5), min_size=16, max_size=16))
def test_motions_of_a_model_stay_within_it(model: PlanarName, steps: list[float]) -> None:
    basis = basis_of(model)
    first, second = np.array(steps).reshape(2, 1, 8)[:, :, : basis.shape[1]] * (1 if model != "homography" else 0.3)
    once = moved(np.eye(3)[None], first, basis, SHAPE)
    for element in (once, moved(once, second, basis, SHAPE), normalised(inverse(once))):
        np.testing.assert_allclose(corner_displacements(nearest(model, element, SHAPE), element, SHAPE), 0, atol=1e-6)
