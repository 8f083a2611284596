"""Components that break a contract: how they differ from a good component, and the sentence that a run and the kit end with.

Numbers in a sentence are those of the run of `conftest.py`; those of the kit differ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any, TypeAlias

import numpy as np

from photonpano import FrameSpan, Group, Located, NotLocated, Refined
from photonpano.geometry import inverse, normalised, translation
from photonpano.testing import MemorySource

from .strange import NOTHING, SHAPE, Around, around, holed, instead

Change: TypeAlias = Callable[[Any], Any]
Case: TypeAlias = tuple[Change, str]
HALF: Any = 0.5  # what a plugin that is not typed gives instead of a number of frames
NO_HOMOGRAPHY = "a homography is a finite (3, 3) matrix with h33 = 1, got "
NO_INFORMATION = "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
FINITE_WHERE_SEEN = "flux is finite where weight is positive, and NaN where weight is 0; at row "
NO_MAP = "a homography is finite with h33 = 1, that of frame "
MISSES_KNOTS = "the trajectory misses half of its knots by "
# Where a component of each kind breaks its contract, as messages of a run say.
PLACES = {
    "source": "opening",
    "source, when it is read": "frames 0 to 159",
    "resampler": "level 1",
    "merger": "level 1",
    "locator": "level 1",
    "interpolator": "level 1",
    "refiner": "round 1",
    "renderer": "the panorama",
    "pose-estimator": "the capture",
}


def answer(method: str, **parts: Callable[[Any], Any]) -> Change:
    """Change some attributes of what a method of a good component returns."""
    return around(method, lambda found, *_: replace(found, **{name: part(found) for name, part in parts.items()}))


def groups(change: Callable[[Any], Any]) -> Change:
    return around("groups", lambda found, *_: change(found))


def last_group(**fields: Any) -> Change:
    """Change attributes of the last group, whose class refuses some of these values."""

    def changed(found: tuple[Group, ...]) -> tuple[Group, ...]:
        last = replace(found[-1])
        for name, value in fields.items():
            object.__setattr__(last, name, value)
        return *found[:-1], last

    return groups(changed)


def homography(change: Callable[[np.ndarray], Any]) -> Change:
    return around(
        "register",
        lambda found, *_: replace(found, homography=change(found.homography)) if isinstance(found, Located) else found,
    )


def motion(**parts: Any) -> Change:
    """Change attributes of the motion of pairs that are located."""
    return around("register", lambda found, *_: replace(found, **parts) if isinstance(found, Located) else found)


def trajectory(change: Callable[[np.ndarray], Any]) -> Change:
    """Return an interpolator whose trajectories are what `change` makes of good homographies."""
    return around("fit", lambda found, *_: Around(found, at=lambda at: change(found.at(at))))


def lost_between_knots(found: Any, instants: np.ndarray, *_: Any) -> Any:
    """Return a trajectory that is 90 px off wherever there is no knot."""
    at = found.at
    return Around(
        found, at=lambda frames: normalised(at(frames) @ [translation(90 * (each not in instants), 0) for each in frames])
    )


def lost_later(found: Any, *_: Any) -> Any:
    """Return a trajectory that is NaN after its second call."""
    calls, at = count(), found.at
    return Around(found, at=lambda frames: at(frames) * (1 if next(calls) < 2 else np.nan))


def refined(change: Callable[[np.ndarray, np.ndarray], Any]) -> Change:
    """Return a refiner that returns what `change` makes of the motion of every frame, and of its expected errors."""

    def refine(source: Any, trajectory: Any, std_px: np.ndarray, residuals: Any, view: Any) -> Any:
        return change(trajectory.at(np.arange(len(std_px))), std_px)

    return instead("refine", refine)


def view(**parts: Callable[[Any], Any]) -> Change:
    """Return a pose estimator some attributes of whose view are changed."""
    return answer(
        "estimate",
        views=lambda it: (replace(it.views[0], **{name: part(it.views[0]) for name, part in parts.items()}),),
    )


def skipped(found: Any, *_: Any) -> Any:
    """Return an estimate without the frames 50 to 59, and without a reason."""
    gone = np.isin(np.arange(len(found.located)), np.arange(50, 60))
    nan = np.where(gone, np.nan, 0.0)
    poses = found.camera_from_world + nan[:, None, None]
    return replace(found, located=~gone, camera_from_world=poses, std_position=nan, std_rotation_deg=nan)


def one_nan(poses: np.ndarray) -> np.ndarray:
    return holed(poses.reshape(len(poses), 12), np.nan).reshape(-1, 3, 4)


def info(**fields: Any) -> Change:
    return lambda inner: Around(inner, info=replace(inner.info, **fields))


def response(**methods: Any) -> Change:
    return lambda inner: Around(inner, response=Around(inner.response, **methods))


class OneBuffer(MemorySource):
    """A source that returns the same array of counts again and again."""

    def __init__(self, inner: Any) -> None:
        super().__init__(inner.frames(inner.info.span))
        self.buffer = np.zeros(self.info.frame_shape, np.uint32)

    def counts(self, span: FrameSpan) -> Any:
        self.buffer[:] = super().counts(span)
        return self.buffer


BROKEN: Mapping[str, Mapping[str, Case]] = {
    "resampler": {
        "empty": (groups(lambda _: ()), "expected at least one group, in order, each instant once; got the instants []"),
        "spans": (groups(lambda _: (FrameSpan(0, 40),)), "expected groups, got FrameSpan(start=0, stop=40)"),
        "pairs": (groups(lambda _: ((0, 300),)), "expected groups, got (0, 300)"),
        "backwards": (groups(lambda it: it[::-1]), "expected at least one group, in order, each instant once; got the "),
        "twice": (groups(lambda it: it[:1] * 2), "expected at least one group, in order, each instant once; got the "),
        "beyond the end": (
            instead("groups", lambda n, _: (Group(FrameSpan(n - 10, n + 10), n),)),
            "the capture has 160 frames (0 to 159), got a group of frames 150 to 169",
        ),
        "without end": (
            instead("groups", lambda *_: (Group(FrameSpan(start, start + 1), start) for start in count())),
            "the capture has 160 frames, got 320 groups or more",
        ),
        "half frames": (
            groups(lambda _: (Group(FrameSpan(HALF, 40 + HALF), 20),)),
            "expected groups, got Group(span=FrameSpan(start=0.5, stop=40.5), reference=20)",
        ),
    },
    "merger": {
        "none": (instead("merge", lambda *_: None), "expected a VirtualExposure, got NoneType"),
        "flux alone": (around("merge", lambda found, *_: found.flux), "expected a VirtualExposure, got ndarray"),
        "a generator": (instead("merge", lambda *_: iter(())), "expected a VirtualExposure, got tuple_iterator"),
        "another group": (
            answer("merge", group=lambda _: Group(FrameSpan(0, 7), 3)),
            "expected the exposure of frames 0 to 39 at the instant 19.5, got that of Group(span=FrameSpan(start=0, ",
        ),
        "another instant": (
            answer("merge", group=lambda it: Group(it.group.span, it.group.span.start)),
            "expected the exposure of frames 0 to 39 at the instant 19.5, got that of Group(span=FrameSpan(start=0, ",
        ),
        "no group": (
            answer("merge", group=lambda _: None),
            "expected the exposure of frames 0 to 39 at the instant 19.5, got that of None",
        ),
        "another scale": (answer("merge", scale=lambda it: it.scale / 2), "expected an exposure of scale 1, got 0.5"),
        "flux of another shape": (
            answer("merge", flux=lambda it: it.flux[:-1]),
            "flux is (48, 64) of float32, got (47, 64) of float32",
        ),
        "both of another shape": (
            answer("merge", flux=lambda it: it.flux.T, weight=lambda it: it.weight.T),
            "flux is (48, 64) of float32, got (64, 48) of float32",
        ),
        "weight of another shape": (
            answer("merge", weight=lambda it: it.weight[0]),
            "weight is (48, 64) of float32, got (64,) of float32",
        ),
        "flux of a list": (answer("merge", flux=lambda it: it.flux.tolist()), "flux is (48, 64) of float32, got a list"),
        "flux of complex": (
            answer("merge", flux=lambda it: it.flux + 0j),
            "flux is (48, 64) of float32, got (48, 64) of complex64",
        ),
        "weight of integers": (
            answer("merge", weight=lambda it: it.weight.astype(int)),
            "weight is (48, 64) of float32, got (48, 64) of int64",
        ),
        "NaN that was seen": (
            answer("merge", flux=lambda it: holed(it.flux, np.nan)),
            FINITE_WHERE_SEEN + "3, column 5 flux is nan and weight 40",
        ),
        "infinite flux": (answer("merge", flux=lambda it: holed(it.flux, np.inf)), FINITE_WHERE_SEEN),
        "flux that was not seen": (
            answer("merge", weight=lambda it: holed(it.weight, 0)),
            FINITE_WHERE_SEEN + "3, column 5 flux is ",
        ),
        "infinite flux that was not seen": (
            answer("merge", flux=lambda it: holed(it.flux, np.inf), weight=lambda it: holed(it.weight, 0)),
            FINITE_WHERE_SEEN + "3, column 5 flux is inf and weight 0",
        ),
        "negative weight": (answer("merge", weight=lambda it: -it.weight), FINITE_WHERE_SEEN),
        "weight of NaN": (answer("merge", weight=lambda it: holed(it.weight, np.nan)), FINITE_WHERE_SEEN),
        "infinite weight": (answer("merge", weight=lambda it: holed(it.weight, np.inf)), FINITE_WHERE_SEEN),
        "no response": (answer("merge", response=lambda _: None), "response is that of the source, got a NoneType"),
    },
    "locator": {
        "none": (instead("register", lambda *_: None), "expected Located or NotLocated, got NoneType"),
        "a bare matrix": (instead("register", lambda *_: np.eye(3)), "expected Located or NotLocated, got ndarray"),
        "a list": (
            homography(np.ndarray.tolist),
            "a homography is a (3, 3) array of float64, got a list; a failure is NotLocated",
        ),
        "complex": (
            homography(lambda matrix: matrix + 0j),
            "a homography is a (3, 3) array of float64, got (3, 3) of complex128; a failure is NotLocated",
        ),
        "objects": (
            homography(lambda matrix: matrix.astype(object)),
            "a homography is a (3, 3) array of float64, got (3, 3) of object; a failure is NotLocated",
        ),
        "text": (homography(lambda matrix: matrix.astype(str)), "a homography is a (3, 3) array of float64, got (3, 3) of <U"),
        "no matrix": (homography(lambda _: None), "a homography is a (3, 3) array of float64, got a NoneType"),
        "affine": (homography(lambda matrix: matrix[:2]), NO_HOMOGRAPHY),
        "eight numbers": (homography(lambda matrix: matrix.ravel()[:8]), NO_HOMOGRAPHY),
        "NaN": (
            homography(lambda matrix: matrix * np.nan),
            NO_HOMOGRAPHY + "[[nan, nan, nan], [nan, nan, nan], [nan, nan, nan]]; ",
        ),
        "infinite": (homography(lambda matrix: matrix + translation(np.inf, 0)), NO_HOMOGRAPHY),
        "zeros": (homography(np.zeros_like), NO_HOMOGRAPHY),
        "h33 of 0": (
            homography(lambda _: np.diag([1.0, 1.0, 0.0])),
            NO_HOMOGRAPHY + "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, ",
        ),
        "huge": (homography(lambda matrix: matrix * np.array([[1e300], [1e300], [1]])), NO_HOMOGRAPHY),
        "tiny h33": (homography(lambda matrix: matrix * np.array([[1], [1], [1e-300]])), NO_HOMOGRAPHY),
        **{
            f"a residual of {value!r}": (
                motion(residual_px=value),
                f"residual_px is a finite number of at least 0, None if it is not known; got {value!r}",
            )
            for value in (-5.0, float("nan"), float("inf"), "small", 1j, [0.1])
        },
        **{
            f"information of {name}": (motion(information=matrix), NO_INFORMATION)
            for name, matrix in {
                "zeros": np.zeros((8, 8)),
                "less than nothing": -np.eye(8),
                "NaN": np.full((8, 8), np.nan),
                "six numbers": np.eye(6),
                "nine numbers": np.eye(9),
                "a list": np.eye(8).tolist(),
                "complex": np.eye(8) + 0j,
                "text": np.eye(8).astype(str),
                "a half": np.eye(8) + np.triu(np.ones((8, 8)), 1) / 9,
                "one number": 5.0,
            }.items()
        },
        "evidence of text": (motion(evidence={"inliers": "many"}), "evidence consists of numbers, got inliers = 'many'"),
        "evidence of a list": (motion(evidence=[3]), "evidence is a mapping of numbers by name, got a list"),
        "evidence of complex": (motion(evidence={"score": np.complex64(1)}), "evidence consists of numbers, got score = "),
        "evidence of a failure": (
            instead("register", lambda *_: NotLocated("lost", {"matches": NOTHING})),
            "evidence consists of numbers, got matches = None",
        ),
        "no reason": (
            instead("register", lambda *_: NotLocated(NOTHING)),
            "the reason of NotLocated is a text, got a NoneType",
        ),
    },
    "interpolator": {
        "the identity": (trajectory(lambda found: np.broadcast_to(np.eye(3), found.shape)), MISSES_KNOTS),
        "the middle of the knots": (trajectory(lambda found: np.broadcast_to(found.mean(axis=0), found.shape)), MISSES_KNOTS),
        "inverses": (trajectory(lambda found: normalised(inverse(found))), MISSES_KNOTS),
        "twice as far": (trajectory(lambda found: 2 * found - np.eye(3)), MISSES_KNOTS),
        "lost between knots": (
            around("fit", lost_between_knots),
            "the trajectory passes its knots, but half-way between them it is typically ",
        ),
        "a list": (trajectory(lambda _: [["a"] * 3] * 3), "homographies are float64, got (3, 3) of <U1"),
        "complex": (trajectory(lambda found: found + 0j), "homographies are float64, got ("),
        "objects": (trajectory(lambda found: found.astype(object)), "homographies are float64, got ("),
        "a single one": (trajectory(lambda found: found[0]), "expected homographies of the shape ("),
        "NaN": (trajectory(lambda found: found * np.nan), NO_MAP),
        "h33 of 0": (
            trajectory(lambda found: found - np.diag([0, 0, 1])),
            NO_MAP,
        ),
    },
    "refiner": {
        "homographies alone": (refined(lambda found, _: found), "expected a Refined or None, got ndarray"),
        "a list": (
            refined(lambda found, std: Refined(found.tolist(), std, "")),
            "homographies are arrays of float64, got a list",
        ),
        "complex": (
            refined(lambda found, std: Refined(found + 0j, std, "complex")),
            "homographies are arrays of float64, got (160, 3, 3) of complex128",
        ),
        "errors of text": (
            refined(lambda found, std: Refined(found, std.astype(str), "text")),
            "std_px are arrays of float64, got (160,) of <U",
        ),
        "fewer frames": (
            refined(lambda found, std: Refined(found[1:], std[1:], "short")),
            "the capture has 160 frames: expected homographies of the shape (160, 3, 3) and std_px of the shape (160,), got ",
        ),
        "NaN": (
            refined(lambda found, std: Refined(found * np.nan, std, "NaN")),
            "the motion of frame 0 is not finite, or its std_px is negative or NaN",
        ),
        "negative errors": (
            refined(lambda found, std: Refined(found, -std, "sure")),
            "the motion of frame 0 is not finite, or its std_px is negative or NaN",
        ),
        "flat homographies": (
            refined(lambda found, std: Refined(found * [[1], [0], [1]], std, "flat")),
            "a homography is invertible and has h33 = 1, that of frame 0 is [[",
        ),
        "infinite errors": (
            refined(lambda found, std: Refined(found, std + np.inf, "unsure")),
            "std_px is infinite exactly where it was before; that of frame 0 was ",
        ),
        "no summary": (refined(lambda found, std: Refined(found, std, NOTHING)), "the summary is a text, got a NoneType"),
    },
    "renderer": {
        "flux alone": (around("render", lambda found, *_: found.flux), "expected a Panorama, got ndarray"),
        "another shape": (answer("render", flux=lambda it: it.flux[1:]), "flux is (60, 91) of float32, got "),
        "whole numbers": (answer("render", weight=lambda it: it.weight.astype(int)), "weight is (60, 91) of float32, got ("),
        "NaN where frames were seen": (
            answer("render", flux=lambda it: np.where(it.weight > 20, np.nan, it.flux)),
            FINITE_WHERE_SEEN,
        ),
        "infinite flux": (answer("render", flux=lambda it: it.flux + np.inf), FINITE_WHERE_SEEN),
        "zeros where nothing was seen": (answer("render", flux=lambda it: np.nan_to_num(it.flux)), FINITE_WHERE_SEEN),
        "negative weight": (answer("render", weight=lambda it: -it.weight), FINITE_WHERE_SEEN),
        "another canvas": (
            answer("render", canvas=lambda it: 2 * it.canvas),
            "the canvas of the panorama is the transform of the given canvas, got another one",
        ),
    },
    "pose-estimator": {
        "none": (instead("estimate", lambda *_: None), "expected a PoseEstimate, got a NoneType"),
        "poses alone": (
            around("estimate", lambda found, *_: found.camera_from_world),
            "expected a PoseEstimate, got (160, 3, 4) of float64",
        ),
        "flags of numbers": (
            answer("estimate", located=lambda it: it.located.astype(int)),
            "expected located as 160 flags, got (160,) of int64",
        ),
        "NaN": (
            answer("estimate", camera_from_world=lambda it: it.camera_from_world * np.nan),
            "the pose of frame 0 must be a finite rotation and translation",
        ),
        "one NaN": (
            answer("estimate", camera_from_world=lambda it: one_nan(it.camera_from_world)),
            "the pose of frame 3 must be a finite rotation and translation",
        ),
        "mirrored": (
            answer("estimate", camera_from_world=lambda it: it.camera_from_world * [-1, 1, 1, 1]),
            "the pose of frame 0 must be a finite rotation and translation",
        ),
        "frames that are skipped": (around("estimate", skipped), "frame 50 is not located, and no entry of lost says why"),
        "frames that are not located with a pose": (
            answer("estimate", located=lambda it: np.arange(len(it.located)) < 100),
            "camera_from_world must be NaN where a frame is not located",
        ),
        "no frame": (
            answer("estimate", located=lambda it: np.zeros_like(it.located)),
            "no frame is located; raise a LocationError with the reason instead",
        ),
        "fewer frames": (
            answer("estimate", camera_from_world=lambda it: it.camera_from_world[1:]),
            "expected camera_from_world as float64 of the shape (160, 3, 4), got (159, 3, 4) of float64",
        ),
        "single precision": (
            answer("estimate", camera_from_world=lambda it: it.camera_from_world.astype(np.float32)),
            "expected camera_from_world as float64 of the shape (160, 3, 4), got (160, 3, 4) of float32",
        ),
        **{
            f"{name} below 0": (
                answer("estimate", **{name: lambda it: np.full(len(it.located), -1.0)}),
                f"{name} must be 0 or more where a frame is located, inf if not known, and NaN elsewhere",
            )
            for name in ("std_position", "std_rotation_deg")
        },
        **{
            f"{name} of one number": (
                answer("estimate", **{name: lambda _: np.float64(1)}),
                f"expected {name} as float64 of the shape {shape}, got a float64",
            )
            for name, shape in {
                "std_position": "(160,)",
                "std_rotation_deg": "(160,)",
                "camera_matrix": "(3, 3)",
                "distortion": "(4,)",
            }.items()
        },
        "a camera without a focal length": (
            answer("estimate", camera_matrix=lambda _: np.diag([0.0, 0, 1])),
            "camera_matrix must be finite with positive focal lengths, got ",
        ),
        "an infinite distortion": (
            answer("estimate", distortion=lambda _: np.full(4, np.inf)),
            "distortion must be finite, and std_focal_px 0 or more",
        ),
        "points at infinity": (
            answer("estimate", points=lambda it: replace(it.points, positions=np.full((3, 3), np.inf))),
            "expected finite positions of 3 points as float64, and a flux for each",
        ),
        "a view beyond the end": (
            view(span=lambda _: FrameSpan(990, 1010), instant=lambda _: 1000),
            "the view of frames 990 to 1009 is seen from the instant 1000, or reaches beyond the capture",
        ),
        "a view with half a pose": (
            view(camera_from_world=lambda it: it.camera_from_world[:2]),
            "expected the pose of the view of frames 0 to 39 as float64 of the shape (3, 4), got (2, 4) of float64",
        ),
        "a view that is mirrored": (
            view(camera_from_world=lambda it: -it.camera_from_world),
            "the view of frames 0 to 39 must have a pose that is a finite rotation and translation, and finite xy",
        ),
        "points that do not exist": (
            view(points=lambda _: np.arange(1, 4)),
            "the view of frames 0 to 39 must show points 0 to 2, got (3,) of int64",
        ),
        "a place for every other point": (
            view(xy=lambda _: np.zeros((2, 2))),
            "expected xy of the view of frames 0 to 39 as float64 of the shape (3, 2), got (2, 2) of float64",
        ),
    },
    "source": {
        "info of None": (lambda inner: Around(inner, info=None), "info is a StreamInfo, got a NoneType"),
        "no frames": (info(n_frames=0), "info.n_frames is a whole number of at least 1, got 0"),
        "a height of text": (info(height="48"), "info.height is a whole number of at least 1, got '48'"),
        "a width of 64.0": (info(width=64.0), "info.width is a whole number of at least 1, got 64.0"),
        "a kind of its own": (info(kind="colour"), "info.kind is binary or intensity, got 'colour'"),
        "a rate of NaN": (
            info(frame_rate_hz=np.nan),
            "info.frame_rate_hz is a finite number above 0, or None if it is not known; got nan",
        ),
        "a rate of text": (
            info(frame_rate_hz="fast"),
            "info.frame_rate_hz is a finite number above 0, or None if it is not known; got 'fast'",
        ),
        "another width": (info(width=66), "valid is (48, 66) of bool, got (48, 64) of bool"),
        "no mask": (lambda inner: Around(inner, valid=None), "valid is (48, 64) of bool, got a NoneType"),
        "a mask of numbers": (
            lambda inner: Around(inner, valid=np.ones(SHAPE)),
            "valid is (48, 64) of bool, got (48, 64) of float64",
        ),
        "a response of NaN": (
            response(flux=lambda counts, _: counts * np.float32(np.nan)),
            "response.flux() keeps NaN, and gives no other; ",
        ),
        "a response that sums": (
            response(mean_count=lambda flux: flux.sum()),
            "response.mean_count() of (2, 3) returns (2, 3) of float32, got a float32",
        ),
        "a response that inverts nothing": (
            response(flux=lambda counts, _: counts * 7),
            "response.flux() inverts response.mean_count(); ",
        ),
    },
    "source, when it is read": {
        "a list": (around("counts", lambda found, _: found.tolist()), "counts() returns an array of whole numbers, got a list"),
        **{
            name: (
                around("counts", lambda found, _, kind=kind: found.astype(kind)),
                f"counts() returns an array of whole numbers, got an array of {name}",
            )
            for name, kind in {"float64": float, "object": object, "<U": str}.items()
        },
        "turned": (around("counts", lambda found, _: found.T), "expected the shape (48, 64), got (64, 48)"),
        "None": (around("counts", lambda *_: None), "expected the shape (48, 64), got ()"),
        "four numbers": (around("counts", lambda *_: np.zeros(4, np.uint32)), "expected the shape (48, 64), got (4,)"),
        "beyond the frames": (
            around("counts", lambda found, span: found + np.uint32(len(span))),
            "counts() returns numbers from 0 to 160 for these frames, got ",
        ),
        "below 0": (
            around("counts", lambda found, _: found.astype(np.int32) - 200),
            "counts() returns numbers from 0 to 160 for these frames, got -",
        ),
        "in one buffer": (
            OneBuffer,
            "the array that counts() returned changed when other frames were read; return a new array",
        ),
    },
}
# What the kit refuses, while a run converts it or can do without.
STRICT: Mapping[str, Mapping[str, Case]] = {
    "resampler": {
        "an instant outside": (last_group(reference=1e6), "the reference must lie between the first and the last frame, got "),
        "integers of numpy": (
            groups(lambda it: tuple(replace(each, span=FrameSpan(np.int64(each.span.start), each.span.stop)) for each in it)),
            "spans must consist of Python's int, which run.json can hold; got int64",
        ),
    },
    "merger": {
        "double precision": (answer("merge", flux=lambda it: it.flux.astype(float)), "flux must be float32, got float64"),
        "weight of double precision": (
            answer("merge", weight=lambda it: it.weight.astype(float)),
            "weight must be float32, got float64",
        ),
        "negative flux": (answer("merge", flux=lambda it: holed(it.flux, -0.01)), "flux must not be negative, got -"),
        "a response of its own": (
            answer("merge", response=lambda it: Around(it.response)),
            "response must be that of the source, ",
        ),
    },
    "locator": {
        "evidence of NaN": (motion(evidence={"share": np.nan}), "evidence must be finite numbers by name, got {'share': nan}"),
        "a reason without words": (
            around("register", lambda found, *_: replace(found, reason=" ") if isinstance(found, NotLocated) else found),
            "NotLocated needs a reason: a clause with the numbers behind it",
        ),
        "single precision": (
            homography(lambda matrix: matrix.astype(np.float32)),
            "homography must be float64, as all geometry; got float32",
        ),
        "without scale": (homography(lambda matrix: 2 * matrix), "a homography must have h33 = 1, got 2: divide by it"),
        "not quite symmetric": (
            around(
                "register",
                lambda found, *_: (
                    replace(found, information=found.information * (1 + 1e-5 * np.triu(np.ones((8, 8)))))
                    if isinstance(found, Located)
                    else found
                ),
            ),
            "information must be symmetric, as every inverse covariance is",
        ),
    },
    "interpolator": {
        "single precision": (
            trajectory(lambda found: found.astype(np.float32)),
            "homographies must be float64, as all geometry; got float32",
        ),
        "without scale": (trajectory(lambda found: 2 * found), "a homography must have h33 = 1, got 2: divide by it"),
        "mirrored far away": (
            trajectory(lambda found: np.where(found[:, :1, 2:] > 100, found * [-1.0, 1, 1], found)),
            "homographies must be invertible maps; that at ",
        ),
    },
    "refiner": {
        "single precision": (
            refined(lambda found, std: Refined(found.astype(np.float32), std, "single")),
            "homographies must be float64, as all geometry; got float32",
        ),
        "without scale": (
            refined(lambda found, std: Refined(2 * found, std, "double")),
            "a homography must have h33 = 1, got 2: divide by it",
        ),
        "two lines": (
            refined(lambda found, std: Refined(found, std, "two\nlines")),
            r"the summary must be one line that says what was corrected, got 'two\nlines'",
        ),
        "no line": (
            refined(lambda found, std: Refined(found, std, "")),
            "the summary must be one line that says what was corrected, got ''",
        ),
    },
    "renderer": {
        "double precision": (answer("render", flux=lambda it: it.flux.astype(float)), "flux must be float32, got float64"),
        "weight of double precision": (
            answer("render", weight=lambda it: it.weight.astype(float)),
            "weight must be float32, got float64",
        ),
        "negative flux": (
            answer("render", flux=lambda it: np.where(it.weight > 20, np.float32(-0.01), it.flux)),
            "flux must not be negative, got -",
        ),
    },
}
# What only a whole run can see.
ONLY_IN_A_RUN: Mapping[str, Mapping[str, Case]] = {
    "locator": {
        "the identity": (
            motion(homography=np.eye(3)),
            "got the identity where the motion known so far moves the corners by ",
        ),
        "nearly the identity": (
            motion(homography=translation(1e-6, 0)),
            "got the identity where the motion known so far moves the corners by ",
        ),
        "the identity without hypotheses": (
            lambda inner: Plain(inner, Located(np.eye(3))),
            "every pair that was located is exactly the identity, which a camera that stands still does not give; a failure is "
            "NotLocated",
        ),
        "nearly the identity without hypotheses": (
            lambda inner: Plain(inner, Located(translation(1e-6, 0))),
            "every pair that was located moves the corners by less than 0.001 px, while short spans of frames show a motion ",
        ),
    },
    "interpolator": {"NaN later": (around("fit", lost_later), NO_MAP + "0 is [[nan, nan, nan], ")},
    "renderer": {
        "nothing seen": (
            answer("render", flux=lambda it: it.flux * np.nan, weight=lambda it: 0 * it.weight),
            "no pixel has a positive weight",
        ),
    },
}


class Plain:
    """A locator that keeps no hypotheses."""

    def __init__(self, inner: Any, answer: Any) -> None:
        self.describe = inner.describe
        self.register = lambda *_: answer


def rows(table: Mapping[str, Mapping[str, Case]]) -> Mapping[str, tuple[str, Change, str]]:
    """Return the cases of a table by an id: where, what is changed, and the sentence."""
    return {f"{where}: {name}": (where, *case) for where, cases in table.items() for name, case in cases.items()}
