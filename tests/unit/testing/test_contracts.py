"""A run refuses what breaks the contract of a component, and names its plugin; the conformance kit refuses it, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any, TypeAlias

import numpy as np
import pytest

from photonpano import FrameSpan, Group, NotLocated, Refined, testing
from photonpano.geometry import translation
from photonpano_poses.testing import PoseEstimatorConformance

from .strange import KINDS, NOTHING, SHAPE, Around, Outcome, around, holed, instead, require_named

Change: TypeAlias = Callable[[Any], Any]
KITS = {kit.kind: kit for name in testing.__all__ if name.endswith("Conformance") for kit in [getattr(testing, name)]}
KITS["pose-estimator"] = PoseEstimatorConformance


def answer(method: str, **parts: Callable[[Any], Any]) -> Change:
    """Change some attributes of what a method of a good component returns; a locator's, where it located the pair."""

    def changed(found: Any, *_: Any) -> Any:
        return found if isinstance(found, NotLocated) else replace(found, **{name: of(found) for name, of in parts.items()})

    return around(method, changed)


def trajectory(change: Callable[[np.ndarray], Any]) -> Change:
    """Return an interpolator whose trajectories are what `change` makes of good homographies."""
    return around("fit", lambda found, *_: Around(found, at=lambda at: change(found.at(at))))


def lost_later(found: Any, *_: Any) -> Any:
    """Return a trajectory that is NaN after its second call."""
    calls, at = count(), found.at
    return Around(found, at=lambda frames: at(frames) * (1 if next(calls) < 2 else np.nan))


def refined(change: Callable[[np.ndarray, np.ndarray], Any]) -> Change:
    """Return a refiner that returns what `change` makes of the motion of every frame, and of its expected errors."""

    def refine(source: Any, trajectory: Any, std_px: np.ndarray, residuals: Any, view: Any) -> Any:
        return change(trajectory.at(np.arange(len(std_px))), std_px)

    return instead("refine", refine)


def info(**fields: Any) -> Change:
    return lambda inner: Around(inner, info=replace(inner.info, **fields))


def skipped(found: Any, *_: Any) -> Any:
    """Return an estimate without the frames 50 to 59, and without a reason."""
    gone = np.isin(np.arange(len(found.located)), np.arange(50, 60))
    nan = np.where(gone, np.nan, 0.0)
    poses = found.camera_from_world + nan[:, None, None]
    return replace(found, located=~gone, camera_from_world=poses, std_position=nan, std_rotation_deg=nan)


# What is wrong with a component of a kind, and the beginning of the clause that says so.
BROKEN: list[tuple[str, str, Change, str]] = [
    ("source", "a rate of text", info(frame_rate_hz="fast"), "info.frame_rate_hz is a finite number"),
    ("source", "a mask of numbers", lambda inner: Around(inner, valid=np.ones(SHAPE)), "valid must be (48, 64) of bool"),
    ("source", "a list", around("counts", lambda found, _: found.tolist()), "counts() returns an array of whole numbers"),
    ("source", "turned", around("counts", lambda found, _: found.T), "expected the shape (48, 64), got (64, 48)"),
    (
        "source",
        "beyond the frames",
        around("counts", lambda found, span: found + np.uint32(len(span))),
        "counts() returns num",
    ),
    (
        "source",
        "a response that inverts nothing",
        lambda inner: Around(inner, response=Around(inner.response, flux=lambda counts, _: counts * 7)),
        "response.flux() inverts response.mean_count()",
    ),
    ("resampler", "spans", instead("groups", lambda *_: (FrameSpan(0, 40),)), "expected Group, got a FrameSpan"),
    ("resampler", "none", instead("groups", lambda *_: ()), "expected at least one group, in order"),
    ("resampler", "backwards", around("groups", lambda found, *_: found[::-1]), "expected at least one group, in order"),
    (
        "resampler",
        "beyond the end",
        instead("groups", lambda n, _: (Group(FrameSpan(n - 10, n + 10), n),)),
        "the capture has 160 frames (0 to 159), got a group of frames 150 to 169",
    ),
    (
        "merger",
        "flux alone",
        around("merge", lambda found, *_: found.flux),
        "expected VirtualExposure, got (48, 64)",
    ),
    ("merger", "another shape", answer("merge", flux=lambda it: it.flux[:-1]), "flux must be (48, 64) of float32"),
    ("merger", "NaN that was seen", answer("merge", flux=lambda it: holed(it.flux, np.nan)), "flux is finite where weight is"),
    ("merger", "seen without weight", answer("merge", weight=lambda it: holed(it.weight, 0)), "flux is finite where weight is"),
    ("merger", "another group", answer("merge", group=lambda _: Group(FrameSpan(0, 7), 3)), "expected the exposure of frames"),
    ("merger", "another scale", answer("merge", scale=lambda it: it.scale / 2), "expected an exposure of scale 1, got 0.5"),
    ("locator", "a bare matrix", instead("register", lambda *_: np.eye(3)), "expected Located or NotLocated, got (3, 3)"),
    (
        "locator",
        "affine",
        answer("register", homography=lambda it: it.homography[:2]),
        "a homography must be (3, 3)",
    ),
    (
        "locator",
        "NaN",
        answer("register", homography=lambda it: it.homography * np.nan),
        "a homography is finite and inv",
    ),
    ("locator", "flat", answer("register", homography=lambda _: np.diag([1.0, 0, 1])), "a homography is finite and inv"),
    ("locator", "negative information", answer("register", information=lambda _: -np.eye(8)), "information is an inverse cov"),
    ("locator", "a negative residual", answer("register", residual_px=lambda _: -5.0), "residual_px is a finite number"),
    ("locator", "evidence of text", answer("register", evidence=lambda _: {"inliers": "many"}), "evidence consists of numbers"),
    ("locator", "no reason", instead("register", lambda *_: NotLocated(NOTHING)), "the reason of NotLocated is a text"),
    ("interpolator", "none", instead("fit", lambda *_: None), "expected an object with the method at(), got a NoneType"),
    ("interpolator", "a single one", trajectory(lambda found: found[0]), "the result of at() must be (7, 3, 3) of float64"),
    ("interpolator", "NaN", trajectory(lambda found: found * np.nan), "a homography is finite with h33 = 1"),
    ("interpolator", "h33 of 0", trajectory(lambda found: found - np.diag([0, 0, 1])), "a homography is finite with h33 = 1"),
    ("interpolator", "far away", trajectory(lambda found: 2 * found - np.eye(3)), "the trajectory misses half of its knots"),
    ("refiner", "homographies alone", refined(lambda found, _: found), "expected Refined, got (160, 3, 3) of float64"),
    ("refiner", "fewer frames", refined(lambda it, std: Refined(it[1:], std[1:], "short")), "homographies must be (160, 3, 3)"),
    ("refiner", "NaN", refined(lambda it, std: Refined(it * np.nan, std, "NaN")), "the motion of frame 0 is not finite"),
    ("refiner", "flat", refined(lambda it, std: Refined(it * [[1], [0], [1]], std, "flat")), "a homography is invertible"),
    ("refiner", "unsure", refined(lambda it, std: Refined(it, std + np.inf, "unsure")), "std_px is infinite exactly where"),
    ("renderer", "flux alone", around("render", lambda found, *_: found.flux), "expected Panorama, got (57, 89) of float32"),
    ("renderer", "another shape", answer("render", flux=lambda it: it.flux[1:]), "flux must be (57, 89) of float32"),
    ("renderer", "zeros that were not seen", answer("render", flux=lambda it: np.nan_to_num(it.flux)), "flux is finite where"),
    ("renderer", "another canvas", answer("render", canvas=lambda it: 2 * it.canvas), "the canvas of the panorama is"),
    ("pose-estimator", "none", instead("estimate", lambda *_: None), "expected PoseEstimate, got a NoneType"),
    (
        "pose-estimator",
        "fewer frames",
        answer("estimate", camera_from_world=lambda it: it.camera_from_world[1:]),
        "camera_from_world must be (160, 3, 4) of float64, got (159, 3, 4)",
    ),
    (
        "pose-estimator",
        "mirrored",
        answer("estimate", camera_from_world=lambda it: it.camera_from_world * [-1, 1, 1, 1]),
        "the pose of frame 0 must be a finite rotation and translation",
    ),
    ("pose-estimator", "skipped", around("estimate", skipped), "frame 50 is not located, and no entry of lost says why"),
]
# What only a whole run can see.
ONLY_IN_A_RUN: list[tuple[str, str, Change, str]] = [
    ("locator", "the identity", answer("register", homography=lambda _: np.eye(3)), "got the identity where"),
    (
        "locator",
        "nearly",
        answer("register", homography=lambda _: translation(1e-6, 0)),
        "got the identity where",
    ),
    ("interpolator", "NaN later", around("fit", lost_later), "a homography is finite with h33 = 1"),
    (
        "renderer",
        "nothing seen",
        answer("render", flux=lambda it: it.flux * np.nan, weight=lambda it: 0 * it.weight),
        "no pixel has a positive weight",
    ),
]
PLACES = {"source": "", "refiner": "the refinement", "renderer": "the panorama", "pose-estimator": "the capture"}
LABELS = ("kind", "what", "change", "clause")


@pytest.mark.parametrize(LABELS, [*BROKEN, *ONLY_IN_A_RUN])
def test_run_with_a_broken_component_names_its_plugin(
    misbehaving: Callable[..., Outcome], kind: str, what: str, change: Change, clause: str
) -> None:
    outcome = misbehaving(kind, change)
    place = PLACES.get(kind, "level 1")
    require_named(outcome, kind, f"broke its contract at {place}")
    assert f": {clause}" in outcome.printed, what


@pytest.mark.parametrize(LABELS, BROKEN)
def test_kit_refuses_what_a_run_refuses(
    fails: Callable[..., bool], catalog: Any, kind: str, what: str, change: Change, clause: str
) -> None:
    inner = catalog.find(kind, KINDS[kind][2]).contribution
    config = {"group_size": 40} if kind == "resampler" else {}
    settings, record = inner.config.model_validate(config), {"config": inner.config}
    check = "test_source_passes_the_checks_of_a_run" if kind == "source" else "test_answers_keep_the_contract"
    if clause.startswith("the trajectory misses"):
        check = "test_trajectory_passes_its_knots"

    def build(context: Any) -> Any:
        return change(inner.build(settings, context))

    assert fails(KITS[kind], check, build, record, config=config), (what, clause)


@pytest.mark.parametrize(
    "moved",
    [lambda frame: translation(1e6 * frame, 0), lambda frame: translation(30 * (-1) ** frame, 0)],
    ids=["far away", "shaken"],
)
def test_refiner_that_makes_the_motion_worse_is_kept_out(
    misbehaving: Callable[..., Outcome], moved: Callable[[int], np.ndarray]
) -> None:
    outcome = misbehaving("refiner", refined(lambda found, std: Refined(found @ [*map(moved, range(160))], std, "worse")))
    assert outcome.code == 0
    assert outcome.record is not None
    (refinement,) = outcome.record["refinements"]
    assert (refinement["use"], refinement["rounds"]) == ("strange", [])
    assert refinement["kept_out"]
