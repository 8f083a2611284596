"""Errors of trajectories name their interpolator, whoever calls them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import PluginError
from photonpano.contracts.loop import AttributedTrajectory


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any) -> Any:
        raise error

    return fail


def test_attributed_trajectory_returns_what_the_trajectory_returns(pan: Callable) -> None:
    motion = pan(0.3)
    named = AttributedTrajectory(motion, "interpolator 'toy' of toys 1.0", 2)
    for frames in ([3], [0, 2.5, 7], np.arange(4), 3):
        np.testing.assert_array_equal(named.at(frames), motion.at(frames))


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (raising(KeyError("knot")), "failed at level 2: KeyError: 'knot'"),
        (lambda _: np.eye(3), "broke its contract at level 2: expected homographies of the shape (2, 3, 3), got (3, 3)"),
        (
            lambda _: [np.eye(3), np.diag([1.0, 1.0, 0.0])],
            "broke its contract at level 2: a homography is finite with h33 = 1, that of frame 7.5 is "
            "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]",
        ),
    ],
    ids=["raises", "shape", "h33"],
)
def test_attributed_trajectory_names_interpolator_on_exception_or_broken_contract(
    answer: Callable[..., Any], problem: str
) -> None:
    class Odd:
        at = staticmethod(answer)

    with pytest.raises(PluginError) as caught:
        AttributedTrajectory(Odd(), "interpolator 'toy' of toys 1.0", 2).at([3, 7.5])
    assert str(caught.value) == f"interpolator 'toy' of toys 1.0 {problem}"
