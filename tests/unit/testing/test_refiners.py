from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import Refined
from photonpano.geometry import inverse, normalised, step_motions
from photonpano.testing import RefinerConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.refiners import REFERENCE, SHAPE
from photonpano.testing.stages import StageConformance


class Honest:
    """Applies the steps, if they are more than photon noise: line by line between the centres of the spans."""

    def __init__(self, context):
        self.rng = np.random.default_rng(context.seed)

    def ratio(self, residuals):
        squares = np.einsum("si,sij,sj->s", residuals.steps, residuals.information, residuals.steps)
        return squares.mean() / 4

    def motion(self, trajectory, residuals, n_frames):
        frames, centres = np.arange(n_frames), [span.centre for span in residuals.spans]
        steps = np.stack([np.interp(frames, centres, step) for step in residuals.steps.T], axis=1)
        moved = trajectory.at(frames) @ step_motions(steps, SHAPE)
        return normalised(inverse(moved[REFERENCE]) @ moved)

    def refine(self, source, trajectory, std_px, residuals, view):
        if self.ratio(residuals) < 2:
            return None
        return Refined(self.motion(trajectory, residuals, len(std_px)), std_px.copy(), "a tremor")


class Changed(Honest):
    """Changes what an honest refiner returns."""

    def refine(self, *given):
        found = super().refine(*given)
        return found and self.changed(found)


def changed(change):
    return type("Broken", (Changed,), {"changed": staticmethod(change)})


def with_homographies(change):
    return changed(lambda found: replace(found, homographies=change(found.homographies)))


def with_std_px(change):
    return changed(lambda found: replace(found, std_px=change(found.std_px)))


def one_nan(array):
    array = array.copy()
    array[20] = np.nan
    return array


class AppliesNoise(Honest):
    def ratio(self, residuals):
        return 3.0


class WrongWay(Honest):
    def motion(self, trajectory, residuals, n_frames):
        return super().motion(trajectory, replace(residuals, steps=-residuals.steps), n_frames)


class NeedsFourSpans(Honest):
    def refine(self, source, trajectory, std_px, residuals, view):
        np.gradient(residuals.steps, axis=0, edge_order=2)
        return super().refine(source, trajectory, std_px, residuals, view)


class InvertsInformation(Honest):
    def refine(self, source, trajectory, std_px, residuals, view):
        np.linalg.inv(residuals.information)
        return super().refine(source, trajectory, std_px, residuals, view)


class LosesSpans(Honest):
    def motion(self, trajectory, residuals, n_frames):
        moved = super().motion(trajectory, residuals, n_frames)
        return moved if residuals.information[10, 0, 0] else moved * np.nan


class Writes(Honest):
    def refine(self, source, trajectory, std_px, residuals, view):
        std_px *= 2
        return super().refine(source, trajectory, std_px, residuals, view)


class FailsReadOnly(Honest):
    def refine(self, source, trajectory, std_px, residuals, view):
        residuals.steps[:] = residuals.steps
        return super().refine(source, trajectory, std_px, residuals, view)


class Unseeded(Honest):
    def refine(self, *given):
        found = super().refine(*given)
        return found and replace(found, std_px=found.std_px * np.random.default_rng().random())


class ReturnsArray(Honest):
    def refine(self, source, trajectory, std_px, residuals, view):
        return super().motion(trajectory, residuals, len(std_px))


SHAPES = "test_refined_homographies_are_finite_with_h33_of_1"
ERRORS = "test_expected_errors_are_kept_infinite_where_nothing_was_located"
BROKEN = [
    (SHAPES, ReturnsArray, "refine.. must return a Refined or None, got a ndarray"),
    (SHAPES, with_homographies(lambda all_: all_[16:488]), r"shape \(512, 3, 3\).*; got \(472, 3, 3\)"),
    (SHAPES, with_homographies(one_nan), "finite; that of frame 20 is"),
    (SHAPES, with_homographies(lambda all_: 2 * all_), "h33 = 1; one has 2"),
    (SHAPES, with_homographies(lambda all_: all_.astype(np.float32)), "float64; homographies are float32"),
    (ERRORS, with_std_px(lambda std_px: std_px[16:488]), r"shape \(512,\).*; got \(472,\)"),
    (ERRORS, with_std_px(one_nan), "not be negative or NaN; that of frame 20 is nan"),
    (ERRORS, with_std_px(lambda std_px: -std_px), "not be negative or NaN; that of frame 0 is -inf"),
    (ERRORS, with_std_px(np.nan_to_num), "infinite exactly where the given one is; for frame 0 it is 1.*, and inf was given"),
    (
        "test_reference_frame_stays_the_identity",
        with_homographies(lambda all_: all_[100] @ all_),
        "the reference frame, here 256, must stay the identity; it differs by 8",
    ),
    (
        "test_refined_motion_passes_the_checks_of_a_run",
        with_homographies(lambda all_: all_ + 0j),
        r"a run refuses the refined motion: homographies are arrays of float64, got \(512, 3, 3\) of complex128",
    ),
    (
        "test_refined_motion_passes_the_checks_of_a_run",
        with_homographies(lambda all_: all_ * [[1], [0], [1]]),
        "a run refuses the refined motion: a homography is invertible and has h33 = 1, that of frame 0 is",
    ),
    ("test_summary_is_one_line", changed(lambda found: replace(found, summary="two\nlines")), "one line .* got 'two.nlines'"),
    ("test_summary_is_one_line", changed(lambda found: replace(found, summary="")), "one line .* got ''"),
    ("test_summary_is_one_line", changed(lambda found: replace(found, summary=None)), "must be text, got a NoneType"),
    ("test_photon_noise_is_not_corrected", AppliesNoise, r"by more than 4 expected errors; frame \d+ was moved by 1.\d+ px"),
    ("test_tremor_is_reduced_or_left", WrongWay, r"tremor of 1.5 px must be reduced, .* was 1.\d+ px, and is [23].\d+ px"),
    ("test_few_spans_are_enough", NeedsFourSpans, "must not raise; it raised ValueError"),
    ("test_refine_accepts_spans_without_information", InvertsInformation, "must not raise; it raised LinAlgError"),
    (
        "test_refine_accepts_spans_without_information",
        LosesSpans,
        "finite, also if the photons of some spans determine no step",
    ),
    ("test_refine_leaves_inputs_unchanged", Writes, "refine.. modifies its arguments"),
    ("test_refine_leaves_inputs_unchanged", FailsReadOnly, "refine.. fails with read-only arrays"),
    ("test_refine_is_deterministic", Unseeded, "other results for the same residuals"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(RefinerConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(RefinerConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_checks_pass_on_correct_component_and_on_one_that_corrects_nothing(checks_of, failure):
    never = type("Never", (Honest,), {"refine": lambda *_: None})
    for check in checks_of(RefinerConformance, Conformance):
        assert failure(RefinerConformance, check, Honest) is None, check
        assert failure(RefinerConformance, check, never) is None, check
