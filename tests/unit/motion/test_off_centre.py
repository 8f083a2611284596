"""Exposures merged along another motion than the true one show the mean of their frames, beside their instants."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Trajectory
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import translation
from photonpano.motion.level import VirtualExposures

LENGTH, SPEED, ACCELERATION = 40, 0.3, 0.01
SPANS = [FrameSpan(start, start + LENGTH) for start in range(0, 160, 40)]


@pytest.fixture
def exposures(memory_source: type, make_level: Callable) -> Callable[..., VirtualExposures]:
    def exposures(references: list[float], **known: Trajectory | None) -> VirtualExposures:
        groups = [Group(span, reference) for span, reference in zip(SPANS, references, strict=True)]
        source = memory_source(np.zeros((160, 40, 60)))
        return VirtualExposures(
            level=make_level(), source=source, groups=groups, previous=known.pop("previous", None), clock=Stopwatch(), **known
        )

    return exposures


def shift_px(frame: float) -> float:
    return SPEED * frame + ACCELERATION * frame**2


@pytest.fixture
def true(known_motion: type) -> Any:
    return known_motion(lambda frame: translation(shift_px(frame), 0))


CENTRES = [span.centre for span in SPANS]


def test_exposures_merged_without_motion_lie_where_the_mean_of_their_frames_does(exposures: Callable, true: Any) -> None:
    """A shift of a t^2 is on average a m^2 / 12 beside that of the middle of m frames."""
    found = exposures(CENTRES).off_centre(true)
    np.testing.assert_allclose(found[:, 0, 2], -ACCELERATION * LENGTH**2 / 12, rtol=0.05)
    np.testing.assert_allclose(found[:, :, :2], np.broadcast_to(np.eye(3)[:, :2], (4, 3, 2)), atol=1e-12)
    # Pixels of the frame at the instant are seen where the mean of all frames shows them.
    means = [np.mean([shift_px(frame) for frame in range(span.start, span.stop)]) for span in SPANS]
    np.testing.assert_allclose(found[:, 0, 2], np.array([shift_px(centre) for centre in CENTRES]) - means, rtol=0.05)


@pytest.mark.parametrize("known", ["previous", "start"])
def test_exposures_merged_along_the_true_motion_lie_at_their_instants(exposures: Callable, true: Any, known: str) -> None:
    np.testing.assert_allclose(exposures(CENTRES, **{known: true}).off_centre(true), [np.eye(3)] * 4, atol=1e-12)


def test_exposures_merged_along_a_steady_motion_keep_what_it_lacks(exposures: Callable, true: Any, known_motion: type) -> None:
    """What is merged along the velocity alone is off by the acceleration, as if nothing else had moved."""
    steady = known_motion(lambda frame: translation(5 * frame, -2 * frame))
    without = exposures(CENTRES).off_centre(true)
    bent = known_motion(lambda frame: translation((5 + SPEED) * frame + ACCELERATION * frame**2, -2 * frame))
    np.testing.assert_allclose(exposures(CENTRES, previous=steady).off_centre(bent), without, atol=1e-9)


def test_instants_beside_the_middle_are_displaced_by_the_way_between(exposures: Callable, known_motion: type) -> None:
    steady = known_motion(lambda frame: translation(SPEED * frame, 0))
    found = exposures([centre + 5 for centre in CENTRES]).off_centre(steady)
    np.testing.assert_allclose(found[:, 0, 2], 5 * SPEED, atol=1e-9)
