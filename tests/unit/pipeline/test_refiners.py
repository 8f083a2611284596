"""Refiners of strangers: what breaks the contract is an error that names them, and a worse motion is kept out."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import FrameSpan, PluginError, Refined
from photonpano.context import Context
from photonpano.geometry import FrameTrajectory, inverse, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.timeline import Timeline
from photonpano.pipeline.refiners import refine
from photonpano.pipeline.state import State
from photonpano.record.run_json import refinement_record
from photonpano.record.run_warnings import refinement_warnings
from photonpano.residuals.refinement import Explained, NamedRefiner
from photonpano.specs import parse_spec
from photonpano.testing.captures import KnownMotion, ReadOnlySource, recorded
from photonpano.testing.scenes import Scene

SHAPE, FRAMES = (40, 64), 400
PLAN = parse_spec({"version": 1, "source": {"use": "simulator"}})
PATH = KnownMotion(lambda frame: translation(0.05 * (frame - FRAMES // 2), 0))


class Answering:
    """A refiner that returns what a function makes of the motion."""

    def __init__(self, answer: Callable[..., object]) -> None:
        self.answer = answer
        self.calls = 0

    def refine(self, source, trajectory, std_px, residuals, view):
        self.calls += 1
        return self.answer(trajectory.at(np.arange(len(std_px))), std_px)


@pytest.fixture(scope="module")
def source() -> ReadOnlySource:
    return ReadOnlySource(recorded(Scene(seed=5, flux=(0.1, 0.8)), PATH, FRAMES, SHAPE))


@pytest.fixture
def run(source: ReadOnlySource) -> Callable[..., Explained]:
    """Refine a motion, the true one by default, by a refiner named "odd" that answers with a function."""

    def run(answer: Callable[..., object] | Answering, offset_px: float = 0.0) -> Explained:
        homographies = PATH.at(np.arange(FRAMES))
        homographies[: FRAMES // 2, 0, 2] += offset_px
        motion = FrameMotion(
            FrameTrajectory(homographies),
            FrameSpan(0, FRAMES),
            homographies,
            np.ones(FRAMES, np.bool_),
            np.full(FRAMES, 0.05),
            FRAMES // 2,
            SHAPE,
        )
        component = answer if isinstance(answer, Answering) else Answering(answer)
        named = NamedRefiner("odd", component, "refiner 'odd' of toys 1.0")
        state = State(PLAN, source, Context(), FRAMES // 2, (), Timeline.regular(FRAMES), refined=motion)
        return refine(state, [named])

    return run


def shaken(homographies: np.ndarray, std_px: np.ndarray) -> Refined:
    tremor = np.array([translation(2 * np.sin(frame / 5), 0) for frame in range(len(std_px))])
    return Refined(homographies @ tremor, std_px, "shaken")


def hollow(homographies: np.ndarray, std_px: np.ndarray) -> Refined:
    homographies[17, 0, 2] = np.nan
    return Refined(homographies, std_px, "hollow")


BROKE = "refiner 'odd' of toys 1.0 broke its contract at round 1: "
NOT_FINITE = "is not finite, or its std_px is negative or NaN"


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (
            lambda homographies, std_px: Refined(homographies[:-1], std_px, "short"),
            f"{BROKE}the capture has 400 frames: expected homographies of the shape (400, 3, 3) and std_px of the shape "
            "(400,), got (399, 3, 3) and (400,)",
        ),
        (hollow, f"{BROKE}the motion of frame 17 {NOT_FINITE}"),
        (
            lambda homographies, std_px: Refined(homographies, std_px * 0 - 1, "odd"),
            f"{BROKE}the motion of frame 0 {NOT_FINITE}",
        ),
        (
            lambda homographies, std_px: Refined(homographies, std_px * np.nan, "odd"),
            f"{BROKE}the motion of frame 0 {NOT_FINITE}",
        ),
        (lambda homographies, _: homographies, f"{BROKE}expected a Refined or None, got ndarray"),
        (lambda *_: 1 / 0, "refiner 'odd' of toys 1.0 failed at round 1: ZeroDivisionError: division by zero"),
    ],
)
def test_refiner_that_breaks_its_contract_is_named(
    run: Callable[..., Explained], answer: Callable[..., object], message: str
) -> None:
    with pytest.raises(PluginError) as caught:
        run(answer)
    assert str(caught.value) == message


def test_motion_that_explains_photons_worse_is_kept_out_with_warning(run: Callable[..., Explained]) -> None:
    before, after = run(lambda *_: None), run(shaken)
    np.testing.assert_array_equal(after.motion.homographies, before.motion.homographies)
    np.testing.assert_array_equal(after.motion.std_px, before.motion.std_px)
    [refinement] = after.refinements
    assert (refinement.rounds, refinement.change_px) == ((), 0)
    [warning] = refinement_warnings(after.refinements)
    assert re.sub(r"\d+(\.\d+)?", "N", warning) == (
        "the motion of the refiner 'odd' is not used, since it explains the photons worse: "
        "the misfit of the photons grew from N to N"
    )
    assert refinement_record(refinement)["kept_out"] == refinement.kept_out


def test_motion_that_explains_photons_better_is_used_until_none_is_left(run: Callable[..., Explained]) -> None:
    """Half of the frames are off by 1 px; the refiner corrects them at its first call."""

    def mend(homographies: np.ndarray, std_px: np.ndarray) -> Refined | None:
        return Refined(PATH.at(np.arange(FRAMES)), std_px, "1 px") if refiner.calls == 1 else None

    refiner = Answering(mend)
    found = run(refiner, offset_px=1.0)
    [refinement] = found.refinements
    assert (refinement.rounds, refinement.kept_out, refiner.calls) == (("1 px",), "", 2)
    assert refinement.change_px == pytest.approx(0.5, rel=0.05)
    assert refinement_warnings(found.refinements) == []
    np.testing.assert_allclose(found.motion.homographies, PATH.at(np.arange(FRAMES)), atol=1e-9)


def test_motion_is_returned_with_identity_at_reference_frame(run: Callable[..., Explained]) -> None:
    """A refiner may move the whole plane, which changes nothing that can be seen."""
    moved = Answering(
        lambda homographies, std_px: Refined(translation(3, 4) @ homographies, std_px, "moved") if moved.calls == 1 else None
    )
    found = run(moved).motion
    np.testing.assert_allclose(found.homographies[found.reference], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(inverse(found.homographies[0]) @ found.homographies[9], translation(0.45, 0), atol=1e-9)


def test_refiner_that_never_stops_is_stopped(run: Callable[..., Explained]) -> None:
    eager = Answering(lambda homographies, std_px: Refined(homographies, std_px, "again"))
    [refinement] = run(eager).refinements
    assert len(refinement.rounds) == eager.calls <= 10
    assert replace(refinement, rounds=()).change_px == 0
