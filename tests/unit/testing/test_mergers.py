from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import InputError, LinearlyCorrectedSource, VirtualExposure, discover
from photonpano.geometry import inverse, translation
from photonpano.photometry import BinaryResponse
from photonpano.testing import KnownMotion, MemorySource, MergerConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.stages import StageConformance

PHOTON_MLE = discover().find("merger", "photon-mle").contribution


class Honest:
    """The merger of photonpano, for others to break."""

    def __init__(self, context):
        self.context = context
        self.merger = PHOTON_MLE.build(PHOTON_MLE.config(tolerance_px=0.5), context)

    def merge(self, source, group, trajectory, scale):
        return self.merger.merge(source, group, trajectory, scale)


class Naive(Honest):
    def merge(self, source, group, trajectory, scale):
        return super().merge(source, group, None, scale)


class OneScale(Honest):
    def merge(self, source, group, trajectory, scale):
        return super().merge(source, group, trajectory, 1.0)


class NamesTheCapture(Honest):
    def merge(self, source, group, trajectory, scale):
        return replace(super().merge(source, group, trajectory, scale), group=None)


class FillsHoles(Honest):
    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        return replace(exposure, flux=np.nan_to_num(exposure.flux))


class Normalised(Honest):
    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        return replace(exposure, weight=exposure.weight / exposure.weight.max())


class SmoothsInTime(Honest):
    """Uses the frames around a group, too."""

    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        wide = super().merge(source, replace(group, span=source.info.span), trajectory, scale)
        return replace(exposure, flux=wide.flux)


class AveragesFlux(Honest):
    """Estimates the flux of ten frames at a time: the logarithm of an average is not the average of logarithms."""

    def merge(self, source, group, trajectory, scale):
        frames = source.frames(group.span).reshape(-1, 10, *source.info.frame_shape)
        flux = np.mean([source.response.flux(part.mean(axis=0, dtype=np.float32), 10) for part in frames], axis=0)
        return replace(super().merge(source, group, trajectory, scale), flux=flux)


class DropsHalf(Honest):
    def merge(self, source, group, trajectory, scale):
        flux = source.response.flux(source.frames(group.span)[::2].mean(axis=0, dtype=np.float32), 100)
        return replace(super().merge(source, group, trajectory, scale), flux=flux)


class KnowsNoMask(Honest):
    def merge(self, source, group, trajectory, scale):
        return super().merge(Unmasked(source), group, trajectory, scale)


class Unmasked:
    def __init__(self, source):
        self.source, self.valid = source, np.ones_like(source.valid)

    def __getattr__(self, name):
        return getattr(self.source, name)


class SeesDarkCounts(Honest):
    """Does not subtract dark counts."""

    def merge(self, source, group, trajectory, scale):
        plain = MemorySource(source.frames(source.info.span), source.valid)
        return replace(super().merge(plain, group, trajectory, scale), response=source.response)


class RefusesDarkCounts(Honest):
    def merge(self, source, group, trajectory, scale):
        if isinstance(source, LinearlyCorrectedSource):
            raise InputError("no")
        return super().merge(source, group, trajectory, scale)


class ForgetsTheMaskAlongAMotion(Honest):
    def merge(self, source, group, trajectory, scale):
        return super().merge(source if trajectory is None else Unmasked(source), group, trajectory, scale)


class WarpsTheOtherWay(Honest):
    def merge(self, source, group, trajectory, scale):
        motion = trajectory and KnownMotion(lambda frame: inverse(trajectory.at([frame])[0]))
        return super().merge(source, group, motion, scale)


class HalfAPixelOff(Honest):
    def merge(self, source, group, trajectory, scale):
        at = group.reference
        motion = trajectory and KnownMotion(
            lambda frame: trajectory.at([frame])[0] @ (np.eye(3) if frame == at else translation(0.5, 0.5))
        )
        return super().merge(source, group, motion, scale)


class SeenFromThePlane(Honest):
    """Shifts the image with the reference plane."""

    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        turn = 0 if trajectory is None else int(trajectory.at([group.reference])[0, 0, 2]) // 1000
        return replace(exposure, flux=np.roll(exposure.flux, turn, axis=1))


class PerPixelOfTheExposure(Honest):
    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        return replace(exposure, flux=exposure.flux / np.float32(scale**2))


class CleansTheMask(Honest):
    def merge(self, source, group, trajectory, scale):
        source.valid[0, 0] = not source.valid[0, 0]
        return super().merge(source, group, trajectory, scale)


class WritesToCounts(Honest):
    def merge(self, source, group, trajectory, scale):
        counts = source.counts(group.span)
        counts[~source.valid] = 0
        return super().merge(source, group, trajectory, scale)


class DependsOnThreads(Honest):
    def merge(self, source, group, trajectory, scale):
        exposure = super().merge(source, group, trajectory, scale)
        return replace(exposure, flux=exposure.flux * np.float32(1 + 1e-6 * self.context.threads))


class HoldsAFunction(Honest):
    def __init__(self, context):
        super().__init__(context)
        self.gain = lambda flux: flux


class Raw:
    """Sums counts without dividing by the number of frames."""

    def __init__(self, context):
        pass

    def merge(self, source, group, trajectory, scale):
        counts = source.counts(group.span).astype(np.float32)
        return VirtualExposure(-np.log(counts), counts, group, scale, BinaryResponse())


BROKEN = [
    (
        "test_merger_works_in_other_processes",
        HoldsAFunction,
        "a merger must survive pickling, so that other processes can use it",
    ),
    (
        "test_exposures_pass_the_checks_of_a_run",
        NamesTheCapture,
        "a run refuses the exposure with no motion and scale 0.5: expected the exposure of frames .* got that of None",
    ),
    (
        "test_exposures_pass_the_checks_of_a_run",
        FillsHoles,
        "a run refuses the exposure with no motion and scale 0.5: flux is finite where weight is positive",
    ),
    ("test_exposure_has_scaled_frame_shape", OneScale, r"flux must have the shape \(20, 28\), got \(40, 56\)"),
    (
        "test_exposure_names_group_scale_and_response",
        NamesTheCapture,
        r"must have the given group and scale, .* got \(None, 0.5",
    ),
    (
        "test_flux_is_nan_exactly_where_weight_is_0",
        FillsHoles,
        r"0 pixels are NaN and have a weight, and \d+ have a flux",
    ),
    ("test_flux_is_nan_exactly_where_weight_is_0", Raw, "negative at some pixels"),
    ("test_weight_is_number_of_frames", Normalised, "for a group of 200 frames and a still camera it is 1 at some pixels"),
    ("test_flux_depends_on_frames_of_group_only", SmoothsInTime, "that of frames 20 to 219 changes with frames before"),
    ("test_flux_is_unbiased_on_photon_noise", AveragesFlux, r"the mean is off by \+\d+.\d standard errors"),
    ("test_flux_has_no_more_than_photon_noise", DropsHalf, r"the variance of the flux is (1.9|2.0|2.1)\d times"),
    ("test_dark_counts_are_subtracted_or_source_is_refused", SeesDarkCounts, r"the mean count is 0.\d+, not 0.\d+"),
    (
        "test_masked_pixels_have_no_influence",
        KnowsNoMask,
        "for a still camera the weight must be 0 where source.valid is false; it is 200",
    ),
    (
        "test_masked_pixels_have_no_influence_along_motion",
        ForgetsTheMaskAlongAMotion,
        "along a known motion the flux changes with",
    ),
    ("test_merge_compensates_known_motion", Naive, r"contrast is \d\d% .* unwarped average \d\d%"),
    ("test_merge_compensates_known_motion", WarpsTheOtherWay, "along a known motion the image must stay sharp"),
    ("test_merge_compensates_known_motion", HalfAPixelOff, r"displaced by \([+-]0.[45]\d, [+-]0.[45]\d\) px in x and y"),
    (
        "test_exposure_does_not_depend_on_reference_plane",
        SeenFromThePlane,
        r"moved by \(5000, -700\) px the flux changes by",
    ),
    ("test_flux_does_not_depend_on_scale", PerPixelOfTheExposure, "at scale 0.5 the mean count is"),
    ("test_merge_leaves_inputs_unchanged", CleansTheMask, "modifies source.valid"),
    ("test_merge_leaves_inputs_unchanged", WritesToCounts, "fails with read-only arrays"),
    (
        "test_merge_is_deterministic",
        DependsOnThreads,
        "with four threads, the exposure differs",
    ),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(MergerConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(MergerConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_checks_pass_on_correct_component(checks_of, failure):
    for check in checks_of(MergerConformance, Conformance):
        assert failure(MergerConformance, check, Honest) is None, check


def test_merger_that_refuses_dark_counts_passes(failure):
    assert failure(MergerConformance, "test_dark_counts_are_subtracted_or_source_is_refused", RefusesDarkCounts) is None


def test_naive_average_is_skipped_with_compensates_false(checks_of, failure):
    check = "test_merge_compensates_known_motion"
    with pytest.raises(pytest.skip.Exception, match="compensates = False"):
        failure(MergerConformance, check, Naive, compensates=False)
