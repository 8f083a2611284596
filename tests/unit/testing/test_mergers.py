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
    """Takes the frames around a group as well."""

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
    """Passes over what the source would take out."""

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
    """Wraps the image around where the plane of the trajectory puts it."""

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


class Raw:
    """Sums counts, and divides them by nothing."""

    def __init__(self, context):
        pass

    def merge(self, source, group, trajectory, scale):
        counts = source.counts(group.span).astype(np.float32)
        return VirtualExposure(-np.log(counts), counts, group, scale, BinaryResponse())


BROKEN = [
    ("test_an_exposure_has_the_size_that_the_scale_asks_for", OneScale, r"flux must be of \(20, 28\), got \(40, 56\)"),
    ("test_an_exposure_says_what_it_is_made_of", NamesTheCapture, r"carries the group and the scale .* got \(None, 0.5"),
    (
        "test_flux_is_nan_exactly_where_the_weight_is_zero",
        FillsHoles,
        r"0 pixels are NaN and have a weight, and \d+ have a flux",
    ),
    ("test_flux_is_nan_exactly_where_the_weight_is_zero", Raw, "negative in places"),
    ("test_the_weight_is_the_number_of_frames", Normalised, "of a group of 200 frames it is 1 in places"),
    ("test_only_the_frames_of_the_group_count", SmoothsInTime, "that of frames 20 to 219 changes with frames before"),
    ("test_flux_is_unbiased_on_photon_noise", AveragesFlux, r"the mean is off by \+\d+.\d standard errors"),
    ("test_flux_is_no_noisier_than_photons", DropsHalf, r"the flux is (1.9|2.0|2.1)\d times as noisy"),
    ("test_what_the_source_takes_out_of_sums_is_no_flux", SeesDarkCounts, r"the mean count is 0.\d+, not 0.\d+"),
    ("test_masked_pixels_do_not_count", KnowsNoMask, "the weight of a camera that stands still must be 0; it is 200"),
    (
        "test_masked_pixels_do_not_count_along_a_motion",
        ForgetsTheMaskAlongAMotion,
        "along a known motion the flux changes with",
    ),
    ("test_it_compensates_along_a_known_motion", Naive, r"contrast is \d\d% .* average of the frames as they lie \d\d%"),
    ("test_it_compensates_along_a_known_motion", WarpsTheOtherWay, "along a known motion the image must stay sharp"),
    ("test_it_compensates_along_a_known_motion", HalfAPixelOff, r"displaced by \([+-]0.[45]\d, [+-]0.[45]\d\) px in x and y"),
    (
        "test_where_the_reference_plane_lies_does_not_matter",
        SeenFromThePlane,
        r"moved by \(5000, -700\) px the flux changes by",
    ),
    ("test_brightness_is_the_same_at_every_scale", PerPixelOfTheExposure, "at scale 0.5 the mean count is"),
    ("test_what_it_is_given_is_left_as_it_is", CleansTheMask, "writes to source.valid"),
    ("test_what_it_is_given_is_left_as_it_is", WritesToCounts, "fails when the arrays that it is given cannot be written to"),
    (
        "test_the_same_frames_give_the_same_bytes",
        DependsOnThreads,
        "with four threads at its disposal, the exposure is another",
    ),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_it_is_caught(check, broken, words, catches):
    catches(MergerConformance, check, broken, words)


def test_every_check_catches_something(checks_of):
    assert checks_of(MergerConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_an_honest_one_passes(checks_of, complaint):
    for check in checks_of(MergerConformance, Conformance):
        assert complaint(MergerConformance, check, Honest) is None, check


def test_one_that_refuses_dark_counts_passes(complaint):
    assert complaint(MergerConformance, "test_what_the_source_takes_out_of_sums_is_no_flux", RefusesDarkCounts) is None


def test_a_naive_average_passes_if_it_says_so(checks_of, complaint):
    check = "test_it_compensates_along_a_known_motion"
    with pytest.raises(pytest.skip.Exception, match="compensates = False"):
        complaint(MergerConformance, check, Naive, compensates=False)
