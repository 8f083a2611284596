"""Resamplers, mergers, locators and interpolators that return what their contract forbids."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated
from photonpano.geometry import translation

from .strange import NOTHING, Around, Outcome, around, cases_of, holed, instead, require_named

HALF: Any = 0.5
"""What a plugin that is not typed gives instead of a number of frames."""
AT_LEVEL = "broke its contract at level 1: "
NO_HOMOGRAPHY = AT_LEVEL + "a homography is a finite (3, 3) matrix with h33 = 1, got "
NO_INFORMATION = AT_LEVEL + (
    "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
)


def motion_of(change: Callable[[np.ndarray], Any]) -> Callable[[Any], Any]:
    """Return a locator whose homographies are what `change` makes of good ones."""
    return around("register", lambda found, *_: replace(found, homography=change(found.homography)))


def exposure_of(change: Callable[[Any], Mapping[str, Any]]) -> Callable[[Any], Any]:
    """Return a merger some of whose attributes are what `change` makes of a good exposure."""
    return around("merge", lambda found, *_: replace(found, **change(found)))


def trajectory_of(change: Callable[[np.ndarray], Any]) -> Callable[[Any], Any]:
    """Return an interpolator whose trajectories are what `change` makes of good homographies."""
    return around("fit", lambda found, *_: Around(found, at=lambda at: change(found.at(at))))


def lost_between_knots(found: Any, instants: np.ndarray, *_: Any) -> Any:
    """Return a trajectory that is 60 px off wherever there is no knot."""
    at = found.at
    return Around(found, at=lambda frames: at(frames) @ [translation(60 * (each not in instants), 0) for each in frames])


class Plain:
    """A locator that keeps no hypotheses."""

    def __init__(self, inner: Any, answer: Any) -> None:
        self.describe = inner.describe
        self.register = lambda *_: answer


RESAMPLERS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (instead("groups", lambda *_: None), "failed at level 1: TypeError: 'NoneType' object is not iterable"),
    "empty": (
        instead("groups", lambda *_: ()),
        AT_LEVEL + "expected at least one group, in order, each instant once; got the ",
    ),
    "spans": (instead("groups", lambda *_: (FrameSpan(0, 40),)), AT_LEVEL + "expected groups, got FrameSpan(start=0, stop=40)"),
    "backwards": (around("groups", lambda found, *_: found[::-1]), AT_LEVEL + "expected at least one group, in order, each "),
    "twice": (around("groups", lambda found, *_: found[:1] * 2), AT_LEVEL + "expected at least one group, in order, each "),
    "beyond the end": (
        instead("groups", lambda *_: (Group(FrameSpan(150, 170), 160),)),
        AT_LEVEL + "the capture has 160 frames (0 to 159), got a group of frames 150 to 169",
    ),
    "without end": (
        instead("groups", lambda *_: (Group(FrameSpan(start, start + 1), start) for start in count())),
        AT_LEVEL + "the capture has 160 frames, got 320 groups or more",
    ),
    "half frames": (
        instead("groups", lambda *_: (Group(FrameSpan(HALF, 40 + HALF), 20),)),
        AT_LEVEL + "expected groups, got Group(span=FrameSpan(start=0.5, stop=40.5), reference=20)",
    ),
    "outside of its span": (instead("groups", lambda *_: (Group(FrameSpan(0, 9), 50),)), "failed at level 1: ValueError: the "),
}
MERGERS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (instead("merge", lambda *_: None), AT_LEVEL + "expected a VirtualExposure, got NoneType"),
    "flux alone": (around("merge", lambda found, *_: found.flux), AT_LEVEL + "expected a VirtualExposure, got ndarray"),
    "another group": (
        exposure_of(lambda _: {"group": Group(FrameSpan(0, 7), 3)}),
        AT_LEVEL + "expected the exposure of frames 0 to 39 at the instant 19.5, got that of Group(span=FrameSpan(start=0, ",
    ),
    "another instant": (
        exposure_of(lambda found: {"group": Group(found.group.span, found.group.span.start)}),
        AT_LEVEL + "expected the exposure of frames 0 to 39 at the instant 19.5, got that of ",
    ),
    "no group": (exposure_of(lambda _: {"group": None}), AT_LEVEL + "expected the exposure of frames 0 to 39 at the "),
    "another scale": (exposure_of(lambda _: {"scale": 0.5}), AT_LEVEL + "expected an exposure of scale 1, got 0.5"),
    "flux of another shape": (
        exposure_of(lambda found: {"flux": found.flux[:-1]}),
        AT_LEVEL + "flux is (48, 64) of float32, got (47, 64) of float32",
    ),
    "both of another shape": (
        exposure_of(lambda found: {"flux": found.flux.T, "weight": found.weight.T}),
        AT_LEVEL + "flux is (48, 64) of float32, got (64, 48) of float32",
    ),
    "weight of another shape": (
        exposure_of(lambda found: {"weight": found.weight[0]}),
        AT_LEVEL + "weight is (48, 64) of float32, got (64,) of float32",
    ),
    "flux of a list": (
        exposure_of(lambda found: {"flux": found.flux.tolist()}),
        AT_LEVEL + "flux is (48, 64) of float32, got a list",
    ),
    "flux of complex": (
        exposure_of(lambda found: {"flux": found.flux + 0j}),
        AT_LEVEL + "flux is (48, 64) of float32, got (48, 64) of complex64",
    ),
    "weight of integers": (
        exposure_of(lambda found: {"weight": found.weight.astype(int)}),
        AT_LEVEL + "weight is (48, 64) of float32, got (48, 64) of int64",
    ),
    "NaN that was seen": (
        exposure_of(lambda found: {"flux": holed(found.flux, np.nan)}),
        AT_LEVEL
        + "flux is finite where weight is positive, and NaN where weight is 0; at row 3, column 5 flux is nan and weight 40",
    ),
    "infinite flux": (
        exposure_of(lambda found: {"flux": holed(found.flux, np.inf)}),
        AT_LEVEL + "flux is finite where weight ",
    ),
    "flux that was not seen": (
        exposure_of(lambda found: {"weight": holed(found.weight, 0)}),
        AT_LEVEL + "flux is finite where weight is positive, and NaN where weight is 0; at row 3, column 5 flux is ",
    ),
    "negative weight": (exposure_of(lambda found: {"weight": -found.weight}), AT_LEVEL + "flux is finite where weight "),
    "weight of NaN": (exposure_of(lambda found: {"weight": holed(found.weight, np.nan)}), AT_LEVEL + "flux is finite where "),
    "infinite weight": (exposure_of(lambda found: {"weight": holed(found.weight, np.inf)}), AT_LEVEL + "flux is finite where "),
    "no response": (exposure_of(lambda _: {"response": None}), AT_LEVEL + "response is that of the source, got a NoneType"),
    "a generator": (instead("merge", lambda *_: iter(())), AT_LEVEL + "expected a VirtualExposure, got "),
}
LOCATORS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (instead("register", lambda *_: None), AT_LEVEL + "expected Located or NotLocated, got NoneType"),
    "a bare matrix": (
        around("register", lambda found, *_: found.homography),
        AT_LEVEL + "expected Located or NotLocated, got ndarray",
    ),
    "a list": (
        motion_of(np.ndarray.tolist),
        AT_LEVEL + "a homography is a (3, 3) array of float64, got a list; a failure is NotLocated",
    ),
    "complex": (
        motion_of(lambda matrix: matrix + 0j),
        AT_LEVEL + "a homography is a (3, 3) array of float64, got (3, 3) of complex128; a failure is NotLocated",
    ),
    "objects": (
        motion_of(lambda matrix: matrix.astype(object)),
        AT_LEVEL + "a homography is a (3, 3) array of float64, got (3, 3) of object; a failure is NotLocated",
    ),
    "text": (
        motion_of(lambda matrix: matrix.astype(str)),
        AT_LEVEL + "a homography is a (3, 3) array of float64, got (3, 3) of <U",
    ),
    "no matrix": (motion_of(lambda _: None), AT_LEVEL + "a homography is a (3, 3) array of float64, got a NoneType"),
    "affine": (motion_of(lambda matrix: matrix[:2]), NO_HOMOGRAPHY),
    "eight numbers": (motion_of(lambda matrix: matrix.ravel()[:8]), NO_HOMOGRAPHY),
    "NaN": (motion_of(lambda matrix: matrix * np.nan), NO_HOMOGRAPHY),
    "infinite": (motion_of(lambda matrix: matrix + translation(np.inf, 0)), NO_HOMOGRAPHY),
    "zeros": (motion_of(np.zeros_like), NO_HOMOGRAPHY),
    "huge": (motion_of(lambda matrix: matrix * np.array([[1e300], [1e300], [1]])), NO_HOMOGRAPHY),
    "tiny h33": (motion_of(lambda matrix: matrix * np.array([[1], [1], [1e-300]])), NO_HOMOGRAPHY),
    "the identity": (
        motion_of(lambda _: np.eye(3)),
        AT_LEVEL + "got the identity where the motion known so far moves the corners by ",
    ),
    "nearly the identity": (
        motion_of(lambda _: translation(1e-6, 0)),
        AT_LEVEL + "got the identity where the motion known so far moves the corners by ",
    ),
    "the identity without hypotheses": (
        lambda inner: Plain(inner, Located(np.eye(3))),
        AT_LEVEL + "every pair that was located is exactly the identity, which a camera that stands still does not give; ",
    ),
    "nearly the identity without hypotheses": (
        lambda inner: Plain(inner, Located(translation(1e-6, 0))),
        AT_LEVEL + "every pair that was located moves the corners by less than 0.001 px, while short spans of frames show a "
        "motion of ",
    ),
    **{
        f"a residual of {value!r}": (
            around("register", lambda found, *_, value=value: replace(found, residual_px=value)),
            AT_LEVEL + f"residual_px is a finite number of at least 0, None if it is not known; got {value!r}",
        )
        for value in (-5.0, float("nan"), float("inf"), "small", 1j, [0.1])
    },
    **{
        f"information of {name}": (
            around("register", lambda found, *_, matrix=matrix: replace(found, information=matrix)),
            NO_INFORMATION,
        )
        for name, matrix in {
            "zeros": np.zeros((8, 8)),
            "less than nothing": -np.eye(8),
            "NaN": np.full((8, 8), np.nan),
            "six numbers": np.eye(6),
            "a list": np.eye(8).tolist(),
            "complex": np.eye(8) + 0j,
            "text": np.eye(8).astype(str),
            "a half": np.eye(8) + np.triu(np.ones((8, 8)), 1) / 9,
            "one number": 5.0,
        }.items()
    },
    "evidence of text": (
        around("register", lambda found, *_: replace(found, evidence={"inliers": "many"})),
        AT_LEVEL + "evidence consists of numbers, got inliers = 'many'",
    ),
    "evidence of a list": (
        around("register", lambda found, *_: replace(found, evidence=[3])),
        AT_LEVEL + "evidence is a mapping of numbers by name, got a list",
    ),
    "evidence of complex": (
        around("register", lambda found, *_: replace(found, evidence={"score": np.complex64(1)})),
        AT_LEVEL + "evidence consists of numbers, got score = ",
    ),
    "no reason": (
        instead("register", lambda *_: NotLocated(NOTHING)),
        AT_LEVEL + "the reason of NotLocated is a text, got a NoneType",
    ),
}
INTERPOLATORS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (instead("fit", lambda *_: None), "failed at level 1: AttributeError: 'NoneType' object has no attribute 'at'"),
    "the identity": (
        trajectory_of(lambda found: np.broadcast_to(np.eye(3), found.shape)),
        AT_LEVEL + "the trajectory misses half of its knots by ",
    ),
    "the middle of the knots": (
        trajectory_of(lambda found: np.broadcast_to(found.mean(axis=0), found.shape)),
        AT_LEVEL + "the trajectory misses half of its knots by ",
    ),
    "inverses": (
        trajectory_of(lambda found: np.linalg.inv(found)),
        AT_LEVEL + "the trajectory misses half of its knots by ",
    ),
    "twice as far": (
        trajectory_of(lambda found: 2 * found - np.eye(3)),
        AT_LEVEL + "the trajectory misses half of its knots by ",
    ),
    "lost between knots": (
        around("fit", lost_between_knots),
        AT_LEVEL + "the trajectory passes its knots, but half-way between them it is typically ",
    ),
    "a list": (trajectory_of(lambda _: [["a"] * 3] * 3), AT_LEVEL + "homographies are float64, got (3, 3) of <U1"),
    "complex": (trajectory_of(lambda found: found + 0j), AT_LEVEL + "homographies are float64, got ("),
    "objects": (trajectory_of(lambda found: found.astype(object)), AT_LEVEL + "homographies are float64, got ("),
    "a single one": (trajectory_of(lambda found: found[0]), AT_LEVEL + "expected homographies of the shape ("),
    "NaN": (trajectory_of(lambda found: found * np.nan), AT_LEVEL + "a homography is finite with h33 = 1, that of frame "),
    "h33 of 0": (
        trajectory_of(lambda found: found - np.diag([0, 0, 1])),
        AT_LEVEL + "a homography is finite with h33 = 1, ",
    ),
}
CASES = cases_of(
    {
        "resampler": RESAMPLERS,
        "merger": MERGERS,
        "locator": LOCATORS,
        "interpolator": INTERPOLATORS,
    }
)


@pytest.mark.parametrize(("kind", "change", "message"), CASES.values(), ids=CASES)
def test_broken_contract_names_plugin(
    misbehaving: Callable[..., Outcome], kind: str, change: Callable[[Any], Any], message: str
) -> None:
    require_named(misbehaving(kind, change), kind, message)
