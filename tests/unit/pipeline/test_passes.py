"""Passes and refiners: what explains the photons no worse is accepted, and the state before is kept otherwise."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import FrameSpan, Refined
from photonpano.contracts.attribution import attributed
from photonpano.execution.context import Context
from photonpano.geometry import Camera, FrameTrajectory, likely_rotations, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Timeline
from photonpano.pipeline.passes import refine
from photonpano.pipeline.state import State
from photonpano.record.run_json import refinement_record, refinement_warnings
from photonpano.residuals.refinement import Explained, NamedRefiner
from photonpano.specs import parse_spec
from photonpano.testing.captures import KnownMotion, ReadOnlySource, Scene, recorded

PLAN = parse_spec({"version": 1, "source": {"use": "simulator"}})


SHAPE, FRAMES = (40, 64), 400
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

    def run(answer: Callable[..., object] | Answering, offset_px: float = 0.0, camera: Camera | None = None) -> Explained:
        homographies = PATH.at(np.arange(FRAMES))
        homographies[: FRAMES // 2, 0, 2] += offset_px
        if camera is not None:
            homographies = camera.homographies(likely_rotations(camera, homographies, SHAPE))
        motion = FrameMotion(
            trajectory=FrameTrajectory(homographies),
            span=FrameSpan(0, FRAMES),
            homographies=homographies,
            located=np.ones(FRAMES, np.bool_),
            std_px=np.full(FRAMES, 0.05),
            reference=FRAMES // 2,
            frame_shape=SHAPE,
            camera=camera,
        )
        component = answer if isinstance(answer, Answering) else Answering(answer)
        named = NamedRefiner("odd", attributed(component, "refiner 'odd' of toys 1.0", "the refinement"))
        state = State(
            plan=PLAN,
            source=source,
            context=Context(),
            reference=FRAMES // 2,
            levels=(),
            timeline=Timeline.regular(FRAMES),
            refined=motion,
        )
        return refine(state, [named])[1]

    return run


def shaken(homographies: np.ndarray, std_px: np.ndarray) -> Refined:
    tremor = np.array([translation(2 * np.sin(frame / 5), 0) for frame in range(len(std_px))])
    return Refined(homographies @ tremor, std_px, "shaken")


def test_motion_that_explains_photons_worse_is_kept_out_with_warning(run: Callable[..., Explained]) -> None:
    before, after = run(lambda *_: None), run(shaken)
    np.testing.assert_array_equal(after.motion.homographies, before.motion.homographies)
    np.testing.assert_array_equal(after.motion.std_px, before.motion.std_px)
    [refinement] = after.refinements
    assert (refinement.rounds, refinement.change_px) == ((), 0)
    [warning] = refinement_warnings(after.refinements)
    assert re.sub(r"\d+(\.\d+)?", "N", warning) == (
        "the motion of the refiner 'odd' is not used, since it explains the photons worse: "
        "the reduced chi-square of the photons grew from N to N"
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


def test_what_a_level_left_is_replaced_by_a_share_of_the_correction(run: Callable[..., Explained]) -> None:
    """Noise stays; the frames that were right keep less of the expected error than those that were corrected by 1 px."""

    def mend(homographies: np.ndarray, std_px: np.ndarray) -> Refined | None:
        given.append(std_px)
        return Refined(PATH.at(np.arange(FRAMES)), std_px, "1 px") if len(given) == 1 else None

    given = list[np.ndarray]()
    found = run(mend, offset_px=1.0)
    motion, tied_px = found.motion, found.halves.tied_px(found.motion.located)
    np.testing.assert_allclose(given, [np.full(FRAMES, 0.05)] * 2)
    assert motion.remaining_px[: FRAMES // 2] == pytest.approx(0.25, rel=0.01)
    assert motion.remaining_px[FRAMES // 2 :] == pytest.approx(0, abs=1e-9)
    assert (motion.noise_px < np.maximum(0.051, 1.001 * tied_px)).all()
    assert np.median(tied_px) < 0.05


@pytest.mark.parametrize(("offset_px", "relocated"), [(1.5, []), (3.0, [1])], ids=["sharp", "blurred"])
def test_last_level_runs_again_along_a_motion_corrected_by_more_than_a_pixel(
    offset_px: float, relocated: list[int], run: Callable[..., Explained], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the frames are off; the level that runs again would shift them all, which the photons refute."""
    ran = list[int]()

    def run_again(state: State) -> State:
        ran.append(refiner.calls)
        wrong = shaken(state.motion.homographies, state.motion.std_px).homographies
        return replace(state, refined=replace(state.motion, homographies=wrong, trajectory=FrameTrajectory(wrong)))

    monkeypatch.setattr(State, "relocated", run_again)
    refiner = Answering(
        lambda *_: Refined(PATH.at(np.arange(FRAMES)), np.full(FRAMES, 0.05), "some") if refiner.calls == 1 else None
    )
    found = run(refiner, offset_px=offset_px)
    assert ran == relocated
    np.testing.assert_allclose(found.motion.homographies, PATH.at(np.arange(FRAMES)), atol=1e-9)


def test_refiner_that_never_stops_is_stopped(run: Callable[..., Explained]) -> None:
    eager = Answering(lambda homographies, std_px: Refined(homographies, std_px, "again"))
    [refinement] = run(eager).refinements
    assert len(refinement.rounds) == eager.calls <= 10
    assert replace(refinement, rounds=()).change_px == 0
