"""Sources, refiners, renderers and pose estimators that return what their contract forbids."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Refined
from photonpano.geometry import translation
from photonpano.testing import MemorySource

from .strange import FRAMES, NOTHING, SHAPE, Around, Outcome, around, cases_of, holed, instead, require_named

AT_OPENING = "broke its contract at opening: "
AT_READING = "broke its contract at frames 0 to 159: "
AT_ROUND = "broke its contract at round 1: "
AT_PANORAMA = "broke its contract at the panorama: "
AT_CAPTURE = "broke its contract at the capture: "
FINITE_WHERE_SEEN = "flux is finite where weight is positive, and NaN where weight is 0; at row "


def info_with(**changed: Any) -> Callable[[Any], Any]:
    return lambda inner: Around(inner, info=replace(inner.info, **changed))


def response_with(**changed: Any) -> Callable[[Any], Any]:
    return lambda inner: Around(inner, response=Around(inner.response, **changed))


class OneBuffer(MemorySource):
    """A source that returns the same array again and again."""

    def __init__(self, inner: Any, what: str) -> None:
        super().__init__(inner.frames(inner.info.span))
        self.what, self.buffers = what, {}

    def counts(self, span: FrameSpan) -> Any:
        return self.kept("counts", super().counts(span))

    def frames(self, span: FrameSpan) -> Any:
        return self.kept("frames", super().frames(span))

    def kept(self, what: str, found: np.ndarray) -> np.ndarray:
        if what != self.what:
            return found
        buffer = self.buffers.setdefault(what, np.zeros_like(found))
        flat = buffer.reshape(-1)
        flat[: found.size] = found.ravel()
        return flat[: found.size].reshape(found.shape)


def refined_by(change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return a refiner that returns what `change` makes of the motion of every frame, and of its expected errors."""

    def refine(source: Any, trajectory: Any, std_px: np.ndarray, residuals: Any, view: Any) -> Any:
        return change(trajectory.at(np.arange(len(std_px))), std_px)

    return instead("refine", refine)


def panorama_of(change: Callable[[Any], Mapping[str, Any]]) -> Callable[[Any], Any]:
    """Return a renderer some of whose attributes are what `change` makes of a good panorama."""
    return around("render", lambda found, *_: replace(found, **change(found)))


def poses_of(change: Callable[[Any], Mapping[str, Any]]) -> Callable[[Any], Any]:
    """Return a pose estimator some of whose attributes are what `change` makes of a good estimate."""
    return around("estimate", lambda found, *_: replace(found, **change(found)))


def view_of(**changed: Any) -> Callable[[Any], Any]:
    """Return a pose estimator some attributes of whose view are changed."""
    return poses_of(lambda found: {"views": (replace(found.views[0], **changed),)})


def skipped(found: Any) -> Mapping[str, Any]:
    """Return an estimate without the frames 50 to 59, and without a reason."""
    gone = np.zeros(FRAMES, np.bool_)
    gone[50:60] = True
    nan = np.where(gone, np.nan, 0.0)
    poses = found.camera_from_world + nan[:, None, None]
    return {"located": ~gone, "camera_from_world": poses, "std_position": nan, "std_rotation_deg": nan}


SOURCES: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (lambda _: None, "could not be built: build returned a NoneType, which has no counts, frames nor close"),
    "a class": (lambda _: MemorySource, AT_OPENING.replace("broke its contract", "failed")),
    "info of None": (lambda inner: Around(inner, info=None), AT_OPENING + "info is a StreamInfo, got a NoneType"),
    "no info": (lambda _: Around(object(), counts=len, frames=len, close=len), "failed at opening: AttributeError: "),
    "no frames": (info_with(n_frames=0), AT_OPENING + "info.n_frames is a whole number of at least 1, got 0"),
    "a height of text": (info_with(height="48"), AT_OPENING + "info.height is a whole number of at least 1, got '48'"),
    "a width of 64.0": (info_with(width=64.0), AT_OPENING + "info.width is a whole number of at least 1, got 64.0"),
    "a kind of its own": (info_with(kind="colour"), AT_OPENING + "info.kind is binary or intensity, got 'colour'"),
    "a rate of NaN": (
        info_with(frame_rate_hz=np.nan),
        AT_OPENING + "info.frame_rate_hz is a finite number above 0, or None if it is not known; got nan",
    ),
    "a rate of text": (
        info_with(frame_rate_hz="fast"),
        AT_OPENING + "info.frame_rate_hz is a finite number above 0, or None if it is not known; got 'fast'",
    ),
    "another width": (info_with(width=66), AT_OPENING + "valid is (48, 66) of bool, got (48, 64) of bool"),
    "no mask": (lambda inner: Around(inner, valid=None), AT_OPENING + "valid is (48, 64) of bool, got a NoneType"),
    "a mask of numbers": (
        lambda inner: Around(inner, valid=np.ones(SHAPE)),
        AT_OPENING + "valid is (48, 64) of bool, got (48, 64) of float64",
    ),
    "no response": (lambda inner: Around(inner, response=None), "failed at opening: AttributeError: "),
    "a response of NaN": (
        response_with(flux=lambda counts, _: counts * np.float32(np.nan)),
        AT_OPENING + "response.flux() keeps NaN, and gives no other; ",
    ),
    "a response that sums": (
        response_with(mean_count=lambda flux: flux.sum()),
        AT_OPENING + "response.mean_count() of (2, 3) returns (2, 3) of float32, got a float32",
    ),
    "a response that inverts nothing": (
        response_with(flux=lambda counts, _: counts * 7),
        AT_OPENING + "response.flux() inverts response.mean_count(); ",
    ),
    "counts of a list": (around("counts", lambda found, _: found.tolist()), AT_READING + "counts() returns an array of whole "),
    "counts of float": (
        around("counts", lambda found, _: found.astype(np.float64)),
        AT_READING + "counts() returns an array of whole numbers, got an array of float64",
    ),
    "counts of objects": (
        around("counts", lambda found, _: found.astype(object)),
        AT_READING + "counts() returns an array of whole numbers, got an array of object",
    ),
    "counts of text": (
        around("counts", lambda found, _: found.astype(str)),
        AT_READING + "counts() returns an array of whole numbers, got an array of <U",
    ),
    "counts turned": (
        around("counts", lambda found, _: found.T),
        AT_READING + "expected the shape (48, 64), got (64, 48)",
    ),
    "counts of None": (around("counts", lambda *_: None), AT_READING + "expected the shape (48, 64), got ()"),
    "counts beyond the frames": (
        around("counts", lambda found, span: found + np.uint32(len(span))),
        AT_READING + "counts() returns numbers from 0 to 160 for these frames, got ",
    ),
    "counts below 0": (
        around("counts", lambda found, _: found.astype(np.int32) - 200),
        AT_READING + "counts() returns numbers from 0 to 160 for these frames, got -",
    ),
    "counts in one buffer": (
        lambda inner: OneBuffer(inner, "counts"),
        AT_READING + "the array that counts() returned changed when other frames were read; return a new array",
    ),
}
REFINERS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "homographies alone": (refined_by(lambda found, _: found), AT_ROUND + "expected a Refined or None, got ndarray"),
    "a list": (
        refined_by(lambda found, std_px: Refined(found.tolist(), std_px, "a list")),
        AT_ROUND + "homographies are arrays of float64, got a list",
    ),
    "complex": (
        refined_by(lambda found, std_px: Refined(found + 0j, std_px, "complex")),
        AT_ROUND + "homographies are arrays of float64, got (160, 3, 3) of complex128",
    ),
    "errors of text": (
        refined_by(lambda found, std_px: Refined(found, std_px.astype(str), "text")),
        AT_ROUND + "std_px are arrays of float64, got (160,) of <U",
    ),
    "fewer frames": (
        refined_by(lambda found, std_px: Refined(found[1:], std_px[1:], "short")),
        AT_ROUND
        + "the capture has 160 frames: expected homographies of the shape (160, 3, 3) and std_px of the shape (160,), ",
    ),
    "NaN": (
        refined_by(lambda found, std_px: Refined(found * np.nan, std_px, "NaN")),
        AT_ROUND + "the motion of frame 0 is not finite, or its std_px is negative or NaN",
    ),
    "negative errors": (
        refined_by(lambda found, std_px: Refined(found, -std_px, "sure")),
        AT_ROUND + "the motion of frame 0 is not finite, or its std_px is negative or NaN",
    ),
    "flat homographies": (
        refined_by(lambda found, std_px: Refined(found * [[1], [0], [1]], std_px, "flat")),
        AT_ROUND + "a homography is invertible and has h33 = 1, that of frame 0 is [[",
    ),
    "infinite errors": (
        refined_by(lambda found, std_px: Refined(found, std_px + np.inf, "unsure")),
        AT_ROUND + "std_px is infinite exactly where it was before; that of frame 0 was ",
    ),
    "no summary": (
        refined_by(lambda found, std_px: Refined(found, std_px, NOTHING)),
        AT_ROUND + "the summary is a text, got a NoneType",
    ),
}
RENDERERS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "flux alone": (around("render", lambda found, *_: found.flux), AT_PANORAMA + "expected a Panorama, got ndarray"),
    "another shape": (
        panorama_of(lambda found: {"flux": found.flux[1:]}),
        AT_PANORAMA + "flux is (60, 91) of float32, got ",
    ),
    "whole numbers": (panorama_of(lambda found: {"weight": found.weight.astype(int)}), AT_PANORAMA + "weight is (60, 91) of f"),
    "NaN where frames were seen": (
        panorama_of(lambda found: {"flux": np.where(found.weight > 20, np.nan, found.flux)}),
        AT_PANORAMA + FINITE_WHERE_SEEN,
    ),
    "infinite flux": (panorama_of(lambda found: {"flux": found.flux + np.inf}), AT_PANORAMA + FINITE_WHERE_SEEN),
    "zeros where nothing was seen": (
        panorama_of(lambda found: {"flux": np.nan_to_num(found.flux)}),
        AT_PANORAMA + FINITE_WHERE_SEEN,
    ),
    "negative weight": (panorama_of(lambda found: {"weight": -found.weight}), AT_PANORAMA + FINITE_WHERE_SEEN),
    "another canvas": (
        panorama_of(lambda found: {"canvas": 2 * found.canvas}),
        AT_PANORAMA + "the canvas of the panorama is the transform of the given canvas, got another one",
    ),
    "nothing seen": (
        panorama_of(lambda found: {"flux": found.flux * np.nan, "weight": 0 * found.weight}),
        AT_PANORAMA + "no pixel has a positive weight",
    ),
}
"""What renderers return."""
POSE_ESTIMATORS: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "none": (instead("estimate", lambda *_: None), AT_CAPTURE + "expected a PoseEstimate, got a NoneType"),
    "poses alone": (
        around("estimate", lambda found, *_: found.camera_from_world),
        AT_CAPTURE + "expected a PoseEstimate, got (160, 3, 4) of float64",
    ),
    "NaN": (
        poses_of(lambda found: {"camera_from_world": found.camera_from_world * np.nan}),
        AT_CAPTURE + "the pose of frame 0 must be a finite rotation and translation",
    ),
    "one NaN": (
        poses_of(
            lambda found: {"camera_from_world": holed(found.camera_from_world.reshape(FRAMES, 12), np.nan).reshape(-1, 3, 4)}
        ),
        AT_CAPTURE + "the pose of frame 3 must be a finite rotation and translation",
    ),
    "mirrored": (
        poses_of(lambda found: {"camera_from_world": found.camera_from_world * [-1, 1, 1, 1]}),
        AT_CAPTURE + "the pose of frame 0 must be a finite rotation and translation",
    ),
    "frames that are skipped": (poses_of(skipped), AT_CAPTURE + "frame 50 is not located, and no entry of lost says why"),
    "frames that are not located with a pose": (
        poses_of(lambda _: {"located": np.arange(FRAMES) < 100}),
        AT_CAPTURE + "camera_from_world must be NaN where a frame is not located",
    ),
    "no frame": (
        poses_of(lambda _: {"located": np.zeros(FRAMES, np.bool_)}),
        AT_CAPTURE + "no frame is located; raise a LocationError with the reason instead",
    ),
    "fewer frames": (
        poses_of(lambda found: {"camera_from_world": found.camera_from_world[1:]}),
        AT_CAPTURE + "expected camera_from_world as float64 of the shape (160, 3, 4), got (159, 3, 4) of float64",
    ),
    "single precision": (
        poses_of(lambda found: {"camera_from_world": found.camera_from_world.astype(np.float32)}),
        AT_CAPTURE + "expected camera_from_world as float64 of the shape (160, 3, 4), got (160, 3, 4) of float32",
    ),
    "negative errors": (
        poses_of(lambda found: {"std_position": found.std_position - 1}),
        AT_CAPTURE + "std_position must be 0 or more where a frame is located, ",
    ),
    "a camera without a focal length": (
        poses_of(lambda _: {"camera_matrix": np.diag([0.0, 0, 1])}),
        AT_CAPTURE + "camera_matrix must be finite with positive focal lengths, got ",
    ),
    "a view beyond the end": (
        view_of(span=FrameSpan(150, 170), instant=155),
        AT_CAPTURE + "the view of frames 150 to 169 is seen from the instant 155, or reaches beyond the capture",
    ),
    "points that do not exist": (
        view_of(points=np.arange(1, 4)),
        AT_CAPTURE + "the view of frames 0 to 39 must show points 0 to 2, got ",
    ),
    "a place for every other point": (
        view_of(xy=np.zeros((2, 2))),
        AT_CAPTURE + "expected xy of the view of frames 0 to 39 as float64 of the shape (3, 2), got (2, 2) of float64",
    ),
}
"""What pose estimators return."""
CASES = cases_of(
    {
        "source": SOURCES,
        "refiner": REFINERS,
        "renderer": RENDERERS,
        "pose-estimator": POSE_ESTIMATORS,
    }
)


@pytest.mark.parametrize(("kind", "change", "message"), CASES.values(), ids=CASES)
def test_broken_contract_names_plugin(
    misbehaving: Callable[..., Outcome], kind: str, change: Callable[[Any], Any], message: str
) -> None:
    require_named(misbehaving(kind, change), kind, message)


def test_source_with_fewer_frames_than_info_says_is_an_error(misbehaving: Callable[..., Outcome]) -> None:
    outcome = misbehaving("source", info_with(n_frames=400))
    assert (outcome.code, outcome.files) == (1, [])
    assert outcome.printed.endswith("were requested, but the capture has 160 frames (0 to 159)\n")


@pytest.mark.parametrize(
    "change",
    [
        lambda found, std_px: Refined(found @ [translation(1e6 * each, 0) for each in range(160)], std_px, "far away"),
        lambda found, std_px: Refined(found @ [translation(30 * (-1) ** each, 0) for each in range(160)], std_px, "shaken"),
    ],
    ids=["far away", "shaken"],
)
def test_refiner_that_makes_the_motion_worse_is_kept_out(
    misbehaving: Callable[..., Outcome], change: Callable[..., Any]
) -> None:
    outcome = misbehaving("refiner", refined_by(change))
    assert outcome.code == 0
    assert outcome.record is not None
    (refinement,) = outcome.record["refinements"]
    assert (refinement["use"], refinement["rounds"]) == ("strange", [])
    assert refinement["kept_out"]
