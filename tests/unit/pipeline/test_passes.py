"""Passes and refiners: what explains the photons no worse is accepted, and the state before is kept otherwise."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, LocationError, Refined
from photonpano.capture import capture_of, with_background
from photonpano.contracts.attribution import attributed
from photonpano.errors import CanvasTooLargeError
from photonpano.execution.context import Context
from photonpano.geometry import Camera, FrameTrajectory, corner_displacements, inverse, likely_rotations, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.timeline import Cut, Timeline
from photonpano.pipeline.passes import Pass, Proposal, cut_at_jumps, later_levels, refine, tried, worse_in_light
from photonpano.pipeline.state import State
from photonpano.record.run_json import refinement_record, refinement_warnings
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.refinement import Explained, MotionFit, NamedRefiner
from photonpano.specs import parse_spec
from photonpano.testing import MemorySource
from photonpano.testing.captures import KnownMotion, ReadOnlySource, recorded
from photonpano.testing.scenes import Scene
from photonpano.values import Background

PLAN = parse_spec({"version": 1, "source": {"use": "simulator"}})
BEFORE = State(PLAN, MemorySource(np.zeros((9, 8, 16))), Context(), 0, (), Timeline.regular(9))


AFTER = replace(BEFORE, reference=4)


def propose(proposal: Any, worse: str = "", compared: bool = True) -> Callable[[State], Proposal]:
    """Make a pass that proposes a state, or raises an error."""

    def make() -> State | None:
        if isinstance(proposal, Exception):
            raise proposal
        return proposal

    def settle(proposed: State) -> State:
        return replace(proposed, reference=5)

    compare = (lambda *_: worse) if compared else None
    return lambda _: Proposal(make, compare, settle, "it is not used", logging.WARNING)


@pytest.mark.parametrize(
    ("step", "accepted", "worse"),
    [
        (propose(AFTER), True, ""),
        (propose(AFTER, "it grew"), False, "it grew"),
        (propose(AFTER, "it grew", compared=False), True, ""),
        (propose(None), False, ""),
        (propose(LocationError("lost")), False, "lost"),
        (propose(CanvasTooLargeError("too large")), False, "too large"),
        (lambda _: None, False, ""),
    ],
)
def test_proposal_is_accepted_if_not_worse(
    step: Pass, accepted: bool, worse: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(State, "fit", lambda _: None)
    trial = tried(BEFORE, step)
    assert (trial.accepted, trial.worse) == (accepted, worse)
    assert trial.state.reference == (5 if accepted else 0)
    assert caplog.messages == ([f"it is not used: {worse}"] if worse else [])


def test_errors_of_proposals_that_are_not_compared_end_the_run() -> None:
    with pytest.raises(LocationError, match="lost"):
        tried(BEFORE, propose(LocationError("lost"), compared=False))


@pytest.mark.parametrize(
    ("n_levels", "outdated", "located"), [(1, False, []), (1, True, [1]), (3, False, [2, 3]), (3, True, [2, 3])]
)
def test_single_level_is_located_again_if_the_capture_was_corrected_since(
    n_levels: int, outdated: bool, located: list[int], make_level: Callable, pan: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[list[int], Any]] = []

    def run(state: State, levels: Any, previous: Any) -> State:
        ran.append(([level.number for level in levels], previous))
        return state

    monkeypatch.setattr(State, "located", run)
    levels = tuple(make_level(number=number) for number in range(1, n_levels + 1))
    first = SimpleNamespace(trajectory=pan(0.3))
    source: Any = MemorySource(np.zeros((9, 8, 16)))
    tried(replace(BEFORE, source=source, levels=levels, results=(first,), outdated=outdated, watched=True), later_levels)
    assert ran == [(located, first.trajectory)]


@pytest.mark.parametrize(("reduced_chi2", "worse"), [(1.5, ""), (2.9, "the scatter grew")])
def test_scatter_of_steps_counts_only_if_light_does_not_lower_chi2(reduced_chi2: float, worse: str) -> None:
    proposed, before = (
        SimpleNamespace(reduced_chi2=each, worse_than=lambda _: "the scatter grew") for each in (reduced_chi2, 3.0)
    )
    assert worse_in_light(proposed, before) == worse


@pytest.mark.parametrize(("dark", "worse"), [(None, "the scatter grew"), (FrameSpan(3, 6), "")])
def test_cut_among_dark_frames_is_not_compared(dark: FrameSpan | None, worse: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cut = Cut(4, np.array([3.0, 0.0]), 9.0, dark)
    monkeypatch.setattr("photonpano.pipeline.passes.find_cuts", lambda *_: (cut,))
    monkeypatch.setattr(MotionFit, "worse_than", lambda *_: "the scatter grew")
    monkeypatch.setattr(State, "fit", lambda _: None)
    proposal = cut_at_jumps(BEFORE)
    assert proposal.worse(None, None) == worse
    assert proposal.rejection == "the image seems to jump before frame 4, but the motion is not cut there"


def test_jumps_are_looked_for_in_all_photons(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along a motion that misses a jump, most of the frames around it look as if something hid the background there."""
    searched = []
    monkeypatch.setattr("photonpano.pipeline.passes.find_cuts", lambda source, *_: searched.append(source) or ())
    monkeypatch.setattr(State, "fit", lambda _: None)
    cells = np.zeros((1, 1, 2), bool)
    assert (
        cut_at_jumps(replace(BEFORE, source=with_background(BEFORE.source, Background(np.array([4.0]), cells, cells, (8, 16)))))
        is None
    )
    assert [capture_of(each).background for each in searched] == [None]


@pytest.mark.parametrize(("sizes_px", "kept"), [((3.0, 0.2), [4]), ((3.0, 2.0), [4, 7]), ((0.9, 0.2), None)])
def test_motion_is_not_cut_where_pieces_meet(
    sizes_px: tuple[float, ...], kept: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    cuts = tuple(Cut(frame, np.array([3.0, 0.0]), 9.0) for frame in (4, 7))
    found = {cut.frame: replace(cut, shift_px=np.array([size, 0.0])) for cut, size in zip(cuts, sizes_px, strict=True)}
    monkeypatch.setattr("photonpano.pipeline.passes.find_cuts", lambda *_: cuts)
    monkeypatch.setattr("photonpano.pipeline.passes.build_levels", lambda *_: ())
    monkeypatch.setattr(Cut, "along", lambda cut, *_: found[cut.frame])
    monkeypatch.setattr(State, "motion", SimpleNamespace(trajectory=None, frame_shape=None))
    monkeypatch.setattr(State, "fit", lambda _: None)
    state = cut_at_jumps(BEFORE).make()
    assert (state and [cut.frame for cut in state.timeline.cuts]) == kept


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
            FrameTrajectory(homographies),
            FrameSpan(0, FRAMES),
            homographies,
            np.ones(FRAMES, np.bool_),
            np.full(FRAMES, 0.05),
            FRAMES // 2,
            SHAPE,
            camera,
        )
        component = answer if isinstance(answer, Answering) else Answering(answer)
        named = NamedRefiner("odd", attributed(component, "refiner 'odd' of toys 1.0", "the refinement"))
        state = State(PLAN, source, Context(), FRAMES // 2, (), Timeline.regular(FRAMES), refined=motion)
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


def test_correction_by_a_shift_moves_a_camera_that_turns_by_the_whole_of_it(run: Callable[..., Explained]) -> None:
    """Half of the frames are off by 1 px; the refiner answers with shifts, which no turn is exactly."""

    def mend(homographies: np.ndarray, std_px: np.ndarray) -> Refined | None:
        return Refined(PATH.at(np.arange(FRAMES)), std_px, "1 px") if refiner.calls == 1 else None

    refiner = Answering(mend)
    camera = Camera.of(1e4, SHAPE)
    found = run(refiner, offset_px=1.0, camera=camera).motion.homographies
    steps = [inverse(each[0]) @ each[FRAMES // 2] for each in (found, PATH.at(np.arange(FRAMES)))]
    assert corner_displacements(*steps, SHAPE).max() < 0.02
    np.testing.assert_allclose(np.linalg.det(found), 1)


def test_small_correction_after_another_is_not_measured_again(
    run: Callable[..., Explained], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the frames are off by 1 px; the refiner leaves a tremor at its first call, and corrects that at its second."""
    measured = list[Residuals]()

    def counted(*given: Any) -> Residuals:
        measured.append(measure(*given))
        return measured[-1]

    def mend(homographies: np.ndarray, std_px: np.ndarray) -> Refined | None:
        corrected = PATH.at(np.arange(FRAMES))
        corrected[:, 0, 2] += 0.1 * np.sin(np.arange(FRAMES) / 10) if refiner.calls == 1 else 0
        return Refined(corrected, std_px, "some") if refiner.calls < 3 else None

    def tremor_px(residuals: Residuals) -> float:
        return float(2 * np.mean(residuals.steps().steps[:, 0] * np.sin(residuals.instants / 10)))

    monkeypatch.setattr("photonpano.residuals.refinement.measure", counted)
    refiner = Answering(mend)
    found = run(refiner, offset_px=1.0)
    assert (found.refinements[0].rounds, len(measured)) == (("some", "some"), 2)
    np.testing.assert_allclose(found.motion.homographies, PATH.at(np.arange(FRAMES)), atol=1e-9)
    assert tremor_px(measured[-1]) == pytest.approx(-0.1, abs=0.03)
    assert tremor_px(found.residuals) == pytest.approx(0, abs=0.03)


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
