"""Components that break a contract: how they differ from a good component. What is said of them stands in contracts.txt."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any, TypeAlias

import numpy as np

from photonpano import FrameSpan, Group, Located, NotLocated, Patches, Refined
from photonpano.geometry import inverse, normalised, translation
from photonpano.testing import MemorySource

from .strange import NOTHING, SHAPE, Around, around, holed, instead

Change: TypeAlias = Callable[[Any], Any]
HALF: Any = 0.5  # what a plugin that is not typed gives instead of a number of frames


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


BROKEN: Mapping[str, Mapping[str, Change]] = {
    "resampler": {
        "empty": groups(lambda _: ()),
        "spans": groups(lambda _: (FrameSpan(0, 40),)),
        "pairs": groups(lambda _: ((0, 300),)),
        "backwards": groups(lambda it: it[::-1]),
        "twice": groups(lambda it: it[:1] * 2),
        "beyond the end": instead("groups", lambda n, _: (Group(FrameSpan(n - 10, n + 10), n),)),
        "without end": instead("groups", lambda *_: (Group(FrameSpan(start, start + 1), start) for start in count())),
        "half frames": groups(lambda _: (Group(FrameSpan(HALF, 40 + HALF), 20),)),
    },
    "merger": {
        "none": instead("merge", lambda *_: None),
        "flux alone": around("merge", lambda found, *_: found.flux),
        "a generator": instead("merge", lambda *_: iter(())),
        "another group": answer("merge", group=lambda _: Group(FrameSpan(0, 7), 3)),
        "another instant": answer("merge", group=lambda it: Group(it.group.span, it.group.span.start)),
        "no group": answer("merge", group=lambda _: None),
        "another scale": answer("merge", scale=lambda it: it.scale / 2),
        "flux of another shape": answer("merge", flux=lambda it: it.flux[:-1]),
        "both of another shape": answer("merge", flux=lambda it: it.flux.T, weight=lambda it: it.weight.T),
        "weight of another shape": answer("merge", weight=lambda it: it.weight[0]),
        "flux of a list": answer("merge", flux=lambda it: it.flux.tolist()),
        "flux of complex": answer("merge", flux=lambda it: it.flux + 0j),
        "weight of integers": answer("merge", weight=lambda it: it.weight.astype(int)),
        "NaN that was seen": answer("merge", flux=lambda it: holed(it.flux, np.nan)),
        "infinite flux": answer("merge", flux=lambda it: holed(it.flux, np.inf)),
        "flux that was not seen": answer("merge", weight=lambda it: holed(it.weight, 0)),
        "infinite flux that was not seen": answer(
            "merge", flux=lambda it: holed(it.flux, np.inf), weight=lambda it: holed(it.weight, 0)
        ),
        "negative weight": answer("merge", weight=lambda it: -it.weight),
        "weight of NaN": answer("merge", weight=lambda it: holed(it.weight, np.nan)),
        "infinite weight": answer("merge", weight=lambda it: holed(it.weight, np.inf)),
        "no response": answer("merge", response=lambda _: None),
    },
    "locator": {
        "none": instead("register", lambda *_: None),
        "a bare matrix": instead("register", lambda *_: np.eye(3)),
        "a list": homography(np.ndarray.tolist),
        "complex": homography(lambda matrix: matrix + 0j),
        "objects": homography(lambda matrix: matrix.astype(object)),
        "text": homography(lambda matrix: matrix.astype(str)),
        "no matrix": homography(lambda _: None),
        "affine": homography(lambda matrix: matrix[:2]),
        "eight numbers": homography(lambda matrix: matrix.ravel()[:8]),
        "NaN": homography(lambda matrix: matrix * np.nan),
        "infinite": homography(lambda matrix: matrix + translation(np.inf, 0)),
        "zeros": homography(np.zeros_like),
        "h33 of 0": homography(lambda _: np.diag([1.0, 1.0, 0.0])),
        "huge": homography(lambda matrix: matrix * np.array([[1e300], [1e300], [1]])),
        "tiny h33": homography(lambda matrix: matrix * np.array([[1], [1], [1e-300]])),
        **{
            f"a residual of {value!r}": motion(residual_px=value)
            for value in (-5.0, float("nan"), float("inf"), "small", 1j, [0.1])
        },
        **{
            f"information of {name}": motion(information=matrix)
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
        **{
            f"patches of {name}": motion(patches=Patches(*each))
            for name, each in {
                "NaN": (np.full((144, 2), np.nan), np.zeros((144, 2, 2))),
                "infinite information": (np.zeros((144, 2)), np.full((144, 2, 2), np.inf)),
                "one variance": (np.zeros((144, 2)), np.zeros((144, 2))),
                "a list": ([[0.0, 0.0]] * 144, np.zeros((144, 2, 2))),
                "another grid": (np.zeros((5, 2)), np.zeros((5, 2, 2))),
            }.items()
        },
        "patches of text": motion(patches="many"),
        "evidence of text": motion(evidence={"inliers": "many"}),
        "evidence of a list": motion(evidence=[3]),
        "evidence of complex": motion(evidence={"score": np.complex64(1)}),
        "evidence of a failure": instead("register", lambda *_: NotLocated("lost", {"matches": NOTHING})),
        "no reason": instead("register", lambda *_: NotLocated(NOTHING)),
    },
    "interpolator": {
        "the identity": trajectory(lambda found: np.broadcast_to(np.eye(3), found.shape)),
        "the middle of the knots": trajectory(lambda found: np.broadcast_to(found.mean(axis=0), found.shape)),
        "inverses": trajectory(lambda found: normalised(inverse(found))),
        "twice as far": trajectory(lambda found: 2 * found - np.eye(3)),
        "lost between knots": around("fit", lost_between_knots),
        "a list": trajectory(lambda _: [["a"] * 3] * 3),
        "complex": trajectory(lambda found: found + 0j),
        "objects": trajectory(lambda found: found.astype(object)),
        "a single one": trajectory(lambda found: found[0]),
        "NaN": trajectory(lambda found: found * np.nan),
        "h33 of 0": trajectory(lambda found: found - np.diag([0, 0, 1])),
    },
    "refiner": {
        "homographies alone": refined(lambda found, _: found),
        "a list": refined(lambda found, std: Refined(found.tolist(), std, "")),
        "complex": refined(lambda found, std: Refined(found + 0j, std, "complex")),
        "errors of text": refined(lambda found, std: Refined(found, std.astype(str), "text")),
        "fewer frames": refined(lambda found, std: Refined(found[1:], std[1:], "short")),
        "NaN": refined(lambda found, std: Refined(found * np.nan, std, "NaN")),
        "one NaN": refined(lambda found, std: Refined(found, np.where(np.arange(len(std)) == 17, np.nan, std), "hollow")),
        "negative errors": refined(lambda found, std: Refined(found, -std, "sure")),
        "flat homographies": refined(lambda found, std: Refined(found * [[1], [0], [1]], std, "flat")),
        "infinite errors": refined(lambda found, std: Refined(found, std + np.inf, "unsure")),
        "no summary": refined(lambda found, std: Refined(found, std, NOTHING)),
    },
    "renderer": {
        "flux alone": around("render", lambda found, *_: found.flux),
        "another shape": answer("render", flux=lambda it: it.flux[1:]),
        "whole numbers": answer("render", weight=lambda it: it.weight.astype(int)),
        "NaN where frames were seen": answer("render", flux=lambda it: np.where(it.weight > 20, np.nan, it.flux)),
        "infinite flux": answer("render", flux=lambda it: it.flux + np.inf),
        "zeros where nothing was seen": answer("render", flux=lambda it: np.nan_to_num(it.flux)),
        "negative weight": answer("render", weight=lambda it: -it.weight),
        "another canvas": answer("render", canvas=lambda it: 2 * it.canvas),
    },
    "pose-estimator": {
        "none": instead("estimate", lambda *_: None),
        "poses alone": around("estimate", lambda found, *_: found.camera_from_world),
        "flags of numbers": answer("estimate", located=lambda it: it.located.astype(int)),
        "NaN": answer("estimate", camera_from_world=lambda it: it.camera_from_world * np.nan),
        "one NaN": answer("estimate", camera_from_world=lambda it: one_nan(it.camera_from_world)),
        "mirrored": answer("estimate", camera_from_world=lambda it: it.camera_from_world * [-1, 1, 1, 1]),
        "frames that are skipped": around("estimate", skipped),
        "doubts that are sentences": answer("estimate", doubts=lambda _: ("the path is straight",)),
        "frames that are not located with a pose": answer("estimate", located=lambda it: np.arange(len(it.located)) < 100),
        "no frame": answer("estimate", located=lambda it: np.zeros_like(it.located)),
        "fewer frames": answer("estimate", camera_from_world=lambda it: it.camera_from_world[1:]),
        "single precision": answer("estimate", camera_from_world=lambda it: it.camera_from_world.astype(np.float32)),
        **{
            f"{name} below 0": answer("estimate", **{name: lambda it: np.full(len(it.located), -1.0)})
            for name in ("std_position", "std_rotation_deg")
        },
        **{
            f"{name} of one number": answer("estimate", **{name: lambda _: np.float64(1)})
            for name in ("std_position", "std_rotation_deg", "camera_matrix", "distortion")
        },
        "a camera without a focal length": answer("estimate", camera_matrix=lambda _: np.diag([0.0, 0, 1])),
        "an infinite distortion": answer("estimate", distortion=lambda _: np.full(4, np.inf)),
        "points at infinity": answer("estimate", points=lambda it: replace(it.points, positions=np.full((3, 3), np.inf))),
        "a view beyond the end": view(span=lambda _: FrameSpan(990, 1010), instant=lambda _: 1000),
        "a view with half a pose": view(camera_from_world=lambda it: it.camera_from_world[:2]),
        "a view that is mirrored": view(camera_from_world=lambda it: -it.camera_from_world),
        "points that do not exist": view(points=lambda _: np.arange(1, 4)),
        "a place that is infinite": view(xy=lambda it: it.xy * np.inf),
        "a place for every other point": view(xy=lambda _: np.zeros((2, 2))),
    },
    "source": {
        "info of None": lambda inner: Around(inner, info=None),
        "no frames": info(n_frames=0),
        "a height of text": info(height="48"),
        "a width of 64.0": info(width=64.0),
        "a kind of its own": info(kind="colour"),
        "a rate of NaN": info(frame_rate_hz=np.nan),
        "a rate of text": info(frame_rate_hz="fast"),
        "another width": info(width=66),
        "no mask": lambda inner: Around(inner, valid=None),
        "a mask of numbers": lambda inner: Around(inner, valid=np.ones(SHAPE)),
        "a response of NaN": response(flux=lambda counts, _: counts * np.float32(np.nan)),
        "a response that sums": response(mean_count=lambda flux: flux.sum()),
        "a response that inverts nothing": response(flux=lambda counts, _: counts * 7),
    },
    "source, read": {
        "a list": around("counts", lambda found, _: found.tolist()),
        **{
            name: around("counts", lambda found, _, kind=kind: found.astype(kind))
            for name, kind in {"float64": float, "object": object, "text": str}.items()
        },
        "turned": around("counts", lambda found, _: found.T),
        "None": around("counts", lambda *_: None),
        "four numbers": around("counts", lambda *_: np.zeros(4, np.uint32)),
        "beyond the frames": around("counts", lambda found, span: found + np.uint32(len(span))),
        "below 0": around("counts", lambda found, _: found.astype(np.int32) - 200),
        "in one buffer": OneBuffer,
    },
}
# What the kit refuses, while a run converts it or can do without.
STRICT: Mapping[str, Mapping[str, Change]] = {
    "resampler": {
        "an instant outside": last_group(reference=1e6),
        "integers of numpy": groups(
            lambda it: tuple(replace(each, span=FrameSpan(np.int64(each.span.start), each.span.stop)) for each in it)
        ),
    },
    "merger": {
        "double precision": answer("merge", flux=lambda it: it.flux.astype(float)),
        "weight of double precision": answer("merge", weight=lambda it: it.weight.astype(float)),
        "negative flux": answer("merge", flux=lambda it: holed(it.flux, -0.01)),
        "a response of its own": answer("merge", response=lambda it: Around(it.response)),
    },
    "locator": {
        "evidence of NaN": motion(evidence={"share": np.nan}),
        "a reason without words": around(
            "register", lambda found, *_: replace(found, reason=" ") if isinstance(found, NotLocated) else found
        ),
        "single precision": homography(lambda matrix: matrix.astype(np.float32)),
        "without scale": homography(lambda matrix: 2 * matrix),
        "not quite symmetric": around(
            "register",
            lambda found, *_: (
                replace(found, information=found.information * (1 + 1e-5 * np.triu(np.ones((8, 8)))))
                if isinstance(found, Located)
                else found
            ),
        ),
    },
    "interpolator": {
        "single precision": trajectory(lambda found: found.astype(np.float32)),
        "without scale": trajectory(lambda found: 2 * found),
        "mirrored far away": trajectory(lambda found: np.where(found[:, :1, 2:] > 100, found * [-1.0, 1, 1], found)),
    },
    "refiner": {
        "single precision": refined(lambda found, std: Refined(found.astype(np.float32), std, "single")),
        "without scale": refined(lambda found, std: Refined(2 * found, std, "double")),
        "two lines": refined(lambda found, std: Refined(found, std, "two\nlines")),
        "no line": refined(lambda found, std: Refined(found, std, "")),
    },
    "renderer": {
        "double precision": answer("render", flux=lambda it: it.flux.astype(float)),
        "weight of double precision": answer("render", weight=lambda it: it.weight.astype(float)),
        "negative flux": answer("render", flux=lambda it: np.where(it.weight > 20, np.float32(-0.01), it.flux)),
    },
}
# What only a whole run can see.
ONLY_IN_A_RUN: Mapping[str, Mapping[str, Change]] = {
    "locator": {
        "the identity": motion(homography=np.eye(3)),
        "nearly the identity": motion(homography=translation(1e-6, 0)),
        "the identity without hypotheses": lambda inner: Plain(inner, Located(np.eye(3))),
        "nearly the identity without hypotheses": lambda inner: Plain(inner, Located(translation(1e-6, 0))),
    },
    "interpolator": {"NaN later": around("fit", lost_later)},
    "renderer": {
        "nothing seen": answer("render", flux=lambda it: it.flux * np.nan, weight=lambda it: 0 * it.weight),
    },
}


class Plain:
    """A locator that keeps no hypotheses."""

    def __init__(self, inner: Any, answer: Any) -> None:
        self.describe = inner.describe
        self.register = lambda *_: answer


# What fails in other ways than by a broken contract.
FAILING: Mapping[str, Mapping[str, Change]] = {
    "resampler": {
        "no groups": instead("groups", lambda *_: None),
        "a group outside of its span": instead("groups", lambda *_: (Group(FrameSpan(0, 9), 50),)),
    },
    "interpolator": {"no trajectory": instead("fit", lambda *_: None)},
    "source": {
        "none": lambda _: None,
        "a class": lambda _: MemorySource,
        "no info": lambda _: Around(object(), counts=len, frames=len, close=len),
        "no response": lambda inner: Around(inner, response=None),
    },
}


def rows(*tables: Mapping[str, Mapping[str, Change]]) -> Mapping[str, tuple[str, str, Change]]:
    """Return the cases of some tables by their name in contracts.txt: name, kind, and what is changed."""
    return {
        (label := f"{where}, {name}"): (label, where.partition(",")[0], change)
        for table in tables
        for where, cases in table.items()
        for name, change in cases.items()
    }
