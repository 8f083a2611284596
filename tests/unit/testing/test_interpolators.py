from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import from_parameters, inverse, parameters, translation
from photonpano.testing import InterpolatorConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.stages import StageConformance


class Straight:
    """Straight lines of p1..p8 between the knots, and a camera that stands still beyond them."""

    def __init__(self, instants, homographies):
        self.instants, self.p = instants.copy(), parameters(homographies)

    def at(self, frame_indices):
        frames = np.asarray(frame_indices, dtype=float)
        return from_parameters(np.stack([np.interp(frames, self.instants, p) for p in self.p.T], axis=-1))


class Honest:
    trajectory = Straight

    def __init__(self, context):
        pass

    def fit(self, instants, homographies, information):
        return self.trajectory(instants, homographies)


class Inverted(Honest):
    def fit(self, instants, homographies, information):
        return self.trajectory(instants, inverse(homographies))


class NeedsTwoKnots(Honest):
    def fit(self, instants, homographies, information):
        return super().fit(instants, homographies / (instants[1] - instants[0]), information)


class TrustsInformation(Honest):
    def fit(self, instants, homographies, information):
        return super().fit(instants + (0 if information is None else 10), homographies, information)


class UndefinedBeyond(Straight):
    def at(self, frame_indices):
        frames = np.asarray(frame_indices, dtype=float)
        return np.where((frames < 1000)[:, None, None], super().at(frames), np.nan)


class MirrorsBeyond(Straight):
    def at(self, frame_indices):
        far = np.asarray(frame_indices) > 2000
        return super().at(frame_indices) * np.where(far[:, None, None], np.diag([-1.0, 1, 1]) + (1 - np.eye(3)), 1)


class Unscaled(Straight):
    def at(self, frame_indices):
        return super().at(frame_indices) * 2


class OneAtATime(Straight):
    def at(self, frame_indices):
        return super().at(np.asarray(frame_indices)[:1])


class Smoothed(Straight):
    """Depends on the other instants of the call."""

    def at(self, frame_indices):
        frames = np.asarray(frame_indices, dtype=float)
        return super().at(frames + 0.01 * (frames - frames.mean()))


class Single(Straight):
    def at(self, frame_indices):
        return super().at(frame_indices).astype(np.float32)


class Nearest(Straight):
    def at(self, frame_indices):
        distances = np.abs(np.asarray(frame_indices, dtype=float)[:, None] - self.instants)
        return from_parameters(self.p[distances.argmin(axis=1)])


class LosesItsKnots(Straight):
    """Stands still."""

    def at(self, frame_indices):
        return super().at(np.asarray(frame_indices, dtype=float) * 0)


class StraysBetween(Straight):
    def at(self, frame_indices):
        off = ~np.isin(np.asarray(frame_indices), self.instants)
        return super().at(frame_indices) @ [translation(90 * each, 0) for each in off]


class WritesToKnots(Honest):
    def fit(self, instants, homographies, information):
        instants -= 1e-6
        return super().fit(instants, homographies, information)


class WritesAndUndoes(Honest):
    def fit(self, instants, homographies, information):
        instants *= 2
        instants /= 2
        return super().fit(instants, homographies, information)


class LeftToChance(Straight):
    def at(self, frame_indices):
        return super().at(np.asarray(frame_indices) + 1e-9 * np.random.default_rng().random())


def along(trajectory):
    """Make the interpolator of a broken trajectory."""
    return type(trajectory.__name__, (Honest,), {"trajectory": trajectory})


BROKEN = [
    (
        "test_trajectory_passes_the_checks_of_a_run",
        along(LosesItsKnots),
        "a run refuses the trajectory of 2 knots: the trajectory misses half of its knots by .* px or more",
    ),
    (
        "test_trajectory_passes_the_checks_of_a_run",
        along(StraysBetween),
        "a run refuses the trajectory of 2 knots: the trajectory passes its knots, but half-way between them",
    ),
    ("test_trajectory_passes_its_knots", NeedsTwoKnots, r"fit\(\) with 1 knots must not raise"),
    (
        "test_trajectory_passes_its_knots",
        Inverted,
        r"must pass its knots \(here 1\) within tolerance_px = 0.001; at instant 24.5 it is .* px off",
    ),
    ("test_trajectory_passes_knots_with_information", TrustsInformation, "with information, .* it is .* px off"),
    ("test_trajectory_is_defined_for_every_instant", along(UndefinedBeyond), r"beyond the knots \(here 1\); it is not at 1000"),
    ("test_trajectory_is_defined_for_every_instant", along(MirrorsBeyond), "must return invertible maps; at 2020 it is not"),
    ("test_homographies_have_h33_of_1", along(Unscaled), "returned one with 2: divide by it"),
    ("test_instants_are_independent_of_each_other", along(OneAtATime), r"for 6 instants it returned \(1, 3, 3\)"),
    ("test_instants_are_independent_of_each_other", along(Smoothed), r"at\(130\) alone, and among 6 instants, differ by"),
    ("test_instants_are_independent_of_each_other", along(Single), r"returned float32"),
    (
        "test_constant_velocity_is_kept_between_knots",
        along(Nearest),
        "with 2 knots, at instant 77.25 the trajectory is 8.34 px",
    ),
    ("test_fit_leaves_inputs_unchanged", WritesToKnots, "modifies its arguments"),
    ("test_fit_leaves_inputs_unchanged", WritesAndUndoes, "fails with read-only arrays"),
    ("test_fit_is_deterministic", along(LeftToChance), "two fits to the same knots differ"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(InterpolatorConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(InterpolatorConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_checks_pass_on_correct_component(checks_of, failure):
    for check in checks_of(InterpolatorConformance, Conformance):
        assert failure(InterpolatorConformance, check, Honest) is None, check
