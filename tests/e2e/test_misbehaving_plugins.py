"""Plugins that misbehave in every way that was thought of: the right one is named, exit code 1, and no file is written."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from pydantic import Field, model_validator

from photonpano import (
    Config,
    FrameSpan,
    Group,
    InterpolatorContribution,
    Located,
    LocatorContribution,
    MergerContribution,
    NotLocated,
    PosedView,
    PoseEstimate,
    PoseEstimatorContribution,
    Refined,
    RefinerContribution,
    RendererContribution,
    ResamplerContribution,
    ScenePoints,
    SourceContribution,
    hookimpl,
)
from photonpano.cli.errors import reported
from photonpano.errors import described
from photonpano.geometry import translation
from photonpano.pipeline.run import run
from photonpano.registry import Catalog, Observer, Origin, discover
from photonpano.registry.catalog import make_entry
from photonpano.registry.plugins import observation_of
from photonpano.specs import parse_spec
from photonpano.testing import KnownMotion, MemorySource, Scene
from photonpano.testing.captures import recorded

pytestmark = pytest.mark.usefixtures("heeded")

ORIGIN = Origin("strange-plugin", "1.2", "strange = strange.hooks")
SHAPE, FRAMES = (48, 64), 160
KINDS: Mapping[str, tuple[str, Any, str]] = {
    "source": ("source", SourceContribution, "memory"),
    "resampler": ("resample", ResamplerContribution, "midpoint"),
    "merger": ("merge", MergerContribution, "photon-mle"),
    "locator": ("locate", LocatorContribution, "direct"),
    "interpolator": ("interpolate", InterpolatorContribution, "smoothing-spline"),
    "refiner": ("refine", RefinerContribution, "short-spans"),
    "renderer": ("render", RendererContribution, "merge"),
    "pose-estimator": ("pose", PoseEstimatorContribution, "known-path"),
}
"""The section that chooses a kind, its contribution, and the component that the strange one is built around."""


class Keys(Config):
    """No keys."""


class Odd(BaseException):
    """An exception that `except Exception` does not catch."""


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


class Around:
    """A component around a good one, some of whose attributes are replaced."""

    def __init__(self, inner: Any, **changed: Any) -> None:
        self.inner = inner
        self.__dict__.update(changed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def __enter__(self) -> Around:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def around(method: str, change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return what replaces a method of a good component: `change` gets what the good method returns, and its arguments."""
    return lambda inner: Around(inner, **{method: lambda *given: change(getattr(inner, method)(*given), *given)})


def instead(method: str, answer: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return what replaces a method of a good component by a function."""
    return lambda inner: Around(inner, **{method: answer})


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


class KnownPath:
    """A pose estimator that knows the path of the camera: straight, before three points that one view shows."""

    def estimate(self, *_: Any) -> PoseEstimate:
        poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
        poses[:, 0, 3] = -np.linspace(0, 1, FRAMES)
        points = ScenePoints(np.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6]]), np.full(3, 0.5, np.float32))
        flux = np.full(SHAPE, 0.5, np.float32)
        view = PosedView(FrameSpan(0, 40), 20, poses[20], np.arange(3), np.full((3, 2), 20.0), lambda: flux)
        matrix, nothing = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.zeros(FRAMES)
        located = np.ones(FRAMES, np.bool_)
        return PoseEstimate(matrix, np.zeros(4), 0.0, poses, located, nothing, nothing, points, (view,), (), ())


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """(160, 48, 64) frames of a pan of 24 px."""
    return recorded(Scene(), KnownMotion(lambda frame: translation(0.15 * frame, 0.05 * frame)), FRAMES, SHAPE)


@pytest.fixture(scope="module")
def catalog(frames: np.ndarray) -> Catalog:
    memory = SourceContribution(name="memory", summary="Frames in memory", config=Keys, build=lambda *_: MemorySource(frames))
    known = PoseEstimatorContribution(name="known-path", summary="A straight path", config=Keys, build=lambda *_: KnownPath())
    return discover().including(memory).including(known)


@pytest.fixture(autouse=True)
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the report out, which takes longer than the rest of a small run."""
    monkeypatch.setattr("photonpano.pipeline.run.render_report", lambda *_: "")
    monkeypatch.setattr("photonpano.pipeline.pose_run.render_pose_report", lambda *_: "")


@dataclass(frozen=True)
class Outcome:
    """What the command `run` ends with: its exit code, what it prints, and the files that it leaves."""

    code: int
    printed: str
    files: Sequence[str]
    record: Mapping[str, Any] | None


@pytest.fixture
def outcome_of(catalog: Catalog, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run the small capture as the command line does, with contributions of a strange plugin."""

    def outcome_of(sections: Mapping[str, Any], *contributions: Any, observers: tuple[Observer, ...] = ()) -> Outcome:
        rows = (*catalog.rows, *(make_entry(each, ORIGIN) for each in contributions))
        spec: dict[str, Any] = {"version": 1, "source": {"use": "memory"}, "corrections": []}
        if "pose" not in sections:
            spec |= {"resample": {"use": "midpoint", "with": {"group_size": 40}}, "levels": 1, "refine": []}
        code, record = 0, None
        try:
            with reported():
                plan = parse_spec(spec | sections, output=tmp_path / "run", catalog=replace(catalog, rows=rows))
                record = run(replace(plan, observers=observers)).record
        except typer.Exit as ended:
            code = ended.exit_code
        files = sorted(each.name for each in (tmp_path / "run").glob("*"))
        return Outcome(code, capsys.readouterr().err, files, record)

    return outcome_of


@pytest.fixture
def misbehaving(catalog: Catalog, outcome_of: Callable[..., Outcome]) -> Callable[..., Outcome]:
    """Run with a strange component of a kind: `change` makes it of a good one."""

    def misbehaving(kind: str, change: Callable[[Any], Any], **sections: Any) -> Outcome:
        section, contribution, good = KINDS[kind]
        inner = catalog.find(kind, good).contribution
        strange = contribution(
            name="strange",
            summary="Strange",
            config=inner.config,
            build=lambda config, context: change(inner.build(config, context)),
        )
        keys = {"group_size": 40} if kind == "resampler" else {}
        chosen: Any = {"use": "strange", "with": keys}
        return outcome_of({section: [chosen] if kind == "refiner" else chosen} | sections, strange)

    return misbehaving


def require_named(outcome: Outcome, kind: str, message: str) -> None:
    """Require that a run failed, wrote nothing, and that its message names the plugin."""
    label = f"{kind} 'strange' of strange-plugin 1.2"
    assert outcome.printed.startswith(f"error: {label} {message}"), outcome.printed
    assert "Traceback" not in outcome.printed
    assert (outcome.code, outcome.files) == (1, [])


ERRORS: Mapping[str, tuple[BaseException, str]] = {
    "sys.exit": (SystemExit(0), "SystemExit: 0"),
    "KeyboardInterrupt": (KeyboardInterrupt(), "KeyboardInterrupt"),
    "BaseException": (Odd("stop"), "Odd: stop"),
    "no words": (SpeechlessError(), "SpeechlessError: (its message cannot be written)"),
}
PLACES: Mapping[str, tuple[str, Callable[[BaseException], Callable[[Any], Any]], str]] = {
    "build a source": ("source", raising, "could not be built: "),
    "build a merger": ("merger", raising, "could not be built: "),
    "counts": ("source", lambda error: instead("counts", raising(error)), "failed at frames 0 to 159: "),
    "groups": ("resampler", lambda error: instead("groups", raising(error)), "failed at level 1: "),
    "merge": ("merger", lambda error: instead("merge", raising(error)), "failed at level 1: "),
    "describe": ("locator", lambda error: instead("describe", raising(error)), "failed at level 1: "),
    "register": ("locator", lambda error: instead("register", raising(error)), "failed at level 1: "),
    "fit": ("interpolator", lambda error: instead("fit", raising(error)), "failed at level 1: "),
    "at": (
        "interpolator",
        lambda error: instead("fit", lambda *_: KnownMotion(raising(error))),
        "failed at level 1: ",
    ),
    "refine": ("refiner", lambda error: instead("refine", raising(error)), "failed at round 1: "),
    "render": ("renderer", lambda error: instead("render", raising(error)), "failed at the panorama: "),
    "build a pose estimator": ("pose-estimator", raising, "could not be built: "),
    "estimate": ("pose-estimator", lambda error: instead("estimate", raising(error)), "failed at the capture: "),
}


@pytest.mark.parametrize(("error", "words"), ERRORS.values(), ids=ERRORS)
@pytest.mark.parametrize(("kind", "change", "message"), PLACES.values(), ids=PLACES)
def test_exception_of_any_kind_names_plugin(
    misbehaving: Callable[..., Outcome],
    kind: str,
    change: Callable[[BaseException], Callable[[Any], Any]],
    message: str,
    error: BaseException,
    words: str,
) -> None:
    require_named(misbehaving(kind, change(error)), kind, message + words)


def motion_of(change: Callable[[np.ndarray], Any]) -> Callable[[Any], Any]:
    """Return a locator whose homographies are what `change` makes of good ones."""
    return around("register", lambda found, *_: replace(found, homography=change(found.homography)))


def exposure_of(change: Callable[[Any], Mapping[str, Any]]) -> Callable[[Any], Any]:
    """Return a merger some of whose attributes are what `change` makes of a good exposure."""
    return around("merge", lambda found, *_: replace(found, **change(found)))


def holed(image: np.ndarray, value: float) -> np.ndarray:
    image = image.copy()
    image[3, 5] = value
    return image


def info_with(**changed: Any) -> Callable[[Any], Any]:
    return lambda inner: Around(inner, info=replace(inner.info, **changed))


def response_with(**changed: Any) -> Callable[[Any], Any]:
    return lambda inner: Around(inner, response=Around(inner.response, **changed))


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


def refined_by(change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return a refiner that returns what `change` makes of the motion of every frame, and of its expected errors."""

    def refine(source: Any, trajectory: Any, std_px: np.ndarray, residuals: Any, view: Any) -> Any:
        return change(trajectory.at(np.arange(len(std_px))), std_px)

    return instead("refine", refine)


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


AT_OPENING = "broke its contract at opening: "
AT_READING = "broke its contract at frames 0 to 159: "
AT_LEVEL = "broke its contract at level 1: "
AT_ROUND = "broke its contract at round 1: "
NO_HOMOGRAPHY = AT_LEVEL + "a homography is a finite (3, 3) matrix with h33 = 1, got "
NO_INFORMATION = AT_LEVEL + (
    "information is an inverse covariance: an (8, 8) matrix, finite and positive definite; None if there is none"
)
LEFT_HALF = np.arange(64) < 32

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
        instead("register", lambda *_: NotLocated(None)),  # type: ignore[arg-type]
        AT_LEVEL + "the reason of NotLocated is a text, got a NoneType",
    ),
}
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
        instead("groups", lambda *_: (Group(FrameSpan(0.5, 40.5), 20),)),  # type: ignore[arg-type]
        AT_LEVEL + "expected groups, got Group(span=FrameSpan(start=0.5, stop=40.5), reference=20)",
    ),
    "outside of its span": (instead("groups", lambda *_: (Group(FrameSpan(0, 9), 50),)), "failed at level 1: ValueError: the "),
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
        refined_by(lambda found, std_px: Refined(found, std_px, None)),  # type: ignore[arg-type]
        AT_ROUND + "the summary is a text, got a NoneType",
    ),
}


def panorama_of(change: Callable[[Any], Mapping[str, Any]]) -> Callable[[Any], Any]:
    """Return a renderer some of whose attributes are what `change` makes of a good panorama."""
    return around("render", lambda found, *_: replace(found, **change(found)))


AT_PANORAMA = "broke its contract at the panorama: "
FINITE_WHERE_SEEN = "flux is finite where weight is positive, and NaN where weight is 0; at row "
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


AT_CAPTURE = "broke its contract at the capture: "
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
CASES = {
    f"{kind}: {name}": (kind, *case)
    for kind, cases in {
        "source": SOURCES,
        "merger": MERGERS,
        "locator": LOCATORS,
        "resampler": RESAMPLERS,
        "interpolator": INTERPOLATORS,
        "refiner": REFINERS,
        "renderer": RENDERERS,
        "pose-estimator": POSE_ESTIMATORS,
    }.items()
    for name, case in cases.items()
}


@pytest.mark.parametrize(("kind", "change", "message"), CASES.values(), ids=CASES)
def test_broken_contract_names_plugin(
    misbehaving: Callable[..., Outcome], kind: str, change: Callable[[Any], Any], message: str
) -> None:
    require_named(misbehaving(kind, change), kind, message)


def test_source_with_fewer_frames_than_info_says_is_an_error(misbehaving: Callable[..., Outcome]) -> None:
    outcome = misbehaving("source", info_with(n_frames=400))
    assert (outcome.code, outcome.files) == (1, [])
    assert outcome.printed.endswith("were requested, but the capture has 160 frames (0 to 159)\n")


@pytest.mark.parametrize("error", [OSError("gone"), SystemExit(0), KeyboardInterrupt(), Odd("stop")], ids=repr)
def test_source_that_cannot_be_closed_is_warned_of(misbehaving: Callable[..., Outcome], error: BaseException) -> None:
    """The results are whole: what was read is not affected."""
    outcome = misbehaving("source", instead("close", raising(error)))
    assert outcome.code == 0
    assert outcome.printed.startswith("warning: source 'strange' of strange-plugin 1.2 failed at closing: ")
    assert {"panorama.png", "run.json", "trajectory.npz"} <= set(outcome.files)


@pytest.mark.parametrize("error", [SystemExit(0), KeyboardInterrupt(), Odd("stop")], ids=repr)
@pytest.mark.parametrize("hook", ["photonpano_run_started", "photonpano_stage_finished", "photonpano_run_finished"])
def test_observer_cannot_end_a_run(outcome_of: Callable[..., Outcome], hook: str, error: BaseException) -> None:
    class Watching:
        pass

    setattr(Watching, hook, staticmethod(hookimpl(raising(error))))
    relay = observation_of(Watching())
    assert relay is not None
    outcome = outcome_of({}, observers=(Observer(ORIGIN, relay),))
    assert outcome.code == 0
    assert outcome.printed.startswith(
        f"warning: {hook} of strange-plugin 1.2 (strange = strange.hooks) raised {described(error)};"
    )
    assert "panorama.png" in outcome.files


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


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
@pytest.mark.parametrize(("kind", "section"), [(kind, section) for kind, (section, *_) in KINDS.items()])
def test_check_that_raises_is_a_problem_of_the_spec(
    outcome_of: Callable[..., Outcome], kind: str, section: str, error: str
) -> None:
    raised, words = ERRORS[error]
    strange = KINDS[kind][1](
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), check=raising(raised)
    )
    outcome = outcome_of({section: [{"use": "strange"}] if kind == "refiner" else {"use": "strange"}}, strange)
    where = "refine.0" if kind == "refiner" else section
    problem = f"{where}: the check of the {kind} 'strange' of strange-plugin 1.2 raised {words}\n"
    assert outcome.printed == problem + "error: the spec has 1 problem\n"
    assert (outcome.code, outcome.files) == (2, [])


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (None, "raised TypeError: 'NoneType' object is not iterable"),
        (3, "raised TypeError: 'int' object is not iterable"),
        ([SpeechlessError()], "raised RuntimeError: no words"),
    ],
    ids=["None", "a number", "no words"],
)
def test_check_that_returns_no_sentences_is_a_problem_of_the_spec(
    outcome_of: Callable[..., Outcome], found: Any, words: str
) -> None:
    strange = SourceContribution(
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), check=lambda _: found
    )
    outcome = outcome_of({"source": {"use": "strange"}}, strange)
    assert (
        outcome.printed
        == f"source: the check of the source 'strange' of strange-plugin 1.2 {words}\nerror: the spec has 1 problem\n"
    )
    assert outcome.code == 2


def test_check_with_sentences_without_end_is_cut(outcome_of: Callable[..., Outcome]) -> None:
    strange = SourceContribution(
        name="strange",
        summary="Strange",
        config=Keys,
        build=raising(AssertionError("not built")),
        check=lambda _: map(str, count()),
    )
    outcome = outcome_of({"source": {"use": "strange"}}, strange)
    assert outcome.code == 2
    assert outcome.printed.endswith("source: 99\nerror: the spec has 100 problems\n")


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_config_that_raises_is_a_problem_of_the_spec(outcome_of: Callable[..., Outcome], error: str) -> None:
    raised, words = ERRORS[error]

    class Raising(Config):
        size: int = Field(1, description="any")

        @model_validator(mode="before")
        @classmethod
        def fails(cls, _: Any) -> Any:
            raise raised

    strange = MergerContribution(name="strange", summary="Strange", config=Raising, build=raising(AssertionError("not built")))
    outcome = outcome_of({"merge": {"use": "strange"}}, strange)
    named = f"the config of the merger 'strange' of strange-plugin 1.2 raised {words}"
    assert outcome.printed == f"merge.with: {named}\nerror: the spec has 1 problem\n"
    assert outcome.code == 2


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_source_that_raises_on_recognising_is_named(
    catalog: Catalog, outcome_of: Callable[..., Outcome], tmp_path: Path, error: str
) -> None:
    raised, words = ERRORS[error]
    (tmp_path / "cube.odd").write_bytes(b"odd")
    strange = SourceContribution(
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), recognise=raising(raised)
    )
    outcome = outcome_of({"source": {"use": "auto", "with": {"path": str(tmp_path / "cube.odd")}}}, strange)
    assert f"recognise of the source 'strange' of strange-plugin 1.2 raised {words}" in outcome.printed
    assert (outcome.code, outcome.files) == (2, [])


def test_signal_while_a_plugin_works_is_an_interrupt(misbehaving: Callable[..., Outcome]) -> None:
    """A resampler works in the main thread, which Ctrl-C interrupts."""
    outcome = misbehaving("resampler", instead("groups", lambda *_: signal.raise_signal(signal.SIGINT)))
    assert (outcome.code, outcome.files) == (130, [])
    assert "strange" not in outcome.printed
