from __future__ import annotations

from collections.abc import Callable

import numpy as np

from photonpano.geometry import from_parameters, inverse, normalised, translation
from photonpano.motion.loop import ReferencedTrajectory


def test_it_is_seen_from_the_reference_frame(pan: Callable) -> None:
    trajectory = ReferencedTrajectory(pan(0.5), 40)
    np.testing.assert_allclose(trajectory.at([40, 50, 20.5]), [np.eye(3), translation(5, 0), translation(-9.75, 0)])


def test_pairwise_motions_do_not_depend_on_the_reference(known_motion: type) -> None:
    """A camera that zooms while it pans: these maps do not commute."""
    zoom, speed = np.array([1e-3, -2e-4, 3e-4, 1e-3, 0, 0, 1e-6, 2e-6]), np.array([0.3, -0.1])
    free = known_motion(lambda frame: translation(*speed * frame) @ from_parameters(zoom * frame))
    pairs = []
    for reference in (0, 25, 100):
        first, second = ReferencedTrajectory(free, reference).at([20, 70])
        pairs.append(normalised(inverse(first) @ second))
        np.testing.assert_allclose(ReferencedTrajectory(free, reference).at([reference]), [np.eye(3)], atol=1e-12)
    np.testing.assert_allclose(pairs[1:], [pairs[0]] * 2, atol=1e-9)
