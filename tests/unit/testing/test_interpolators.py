from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import from_parameters, inverse, parameters
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
    """Looks at the other instants that it is asked for."""

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
    ("test_it_passes_its_knots", NeedsTwoKnots, r"fit\(\) of knots whose number is 1 must not raise"),
    ("test_it_passes_its_knots", Inverted, "must pass its 1 knots within tolerance_px = 0.001; at instant 24.5 it misses by"),
    ("test_it_passes_knots_whose_information_is_known", TrustsInformation, "with information, too, .* it misses by"),
    ("test_it_is_defined_for_every_instant", along(UndefinedBeyond), "beyond the 1 knots; it is not at 1000"),
    ("test_it_is_defined_for_every_instant", along(MirrorsBeyond), "maps that can be inverted; that of 2020 cannot"),
    ("test_every_homography_has_h33_of_1", along(Unscaled), "returned one with 2: divide by it"),
    ("test_many_instants_give_what_each_gives_alone", along(OneAtATime), r"for 6 instants its shape is \(1, 3, 3\)"),
    ("test_many_instants_give_what_each_gives_alone", along(Smoothed), r"at\(130\) alone, and among 6, differ by"),
    ("test_many_instants_give_what_each_gives_alone", along(Single), r"returns float32"),
    (
        "test_a_constant_velocity_is_kept_between_knots",
        along(Nearest),
        "with 2 knots, at instant 77.25 the trajectory is 8.34 px",
    ),
    ("test_knots_are_left_as_they_are", WritesToKnots, "changes the arrays that it was given"),
    ("test_knots_are_left_as_they_are", WritesAndUndoes, "fails when the arrays that it is given cannot be written to"),
    ("test_the_same_knots_give_the_same_bytes", along(LeftToChance), "two fits of the same knots differ"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_it_is_caught(check, broken, words, catches):
    catches(InterpolatorConformance, check, broken, words)


def test_every_check_catches_something(checks_of):
    assert checks_of(InterpolatorConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_an_honest_one_passes(checks_of, complaint):
    for check in checks_of(InterpolatorConformance, Conformance):
        assert complaint(InterpolatorConformance, check, Honest) is None, check
