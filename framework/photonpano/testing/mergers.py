"""Checks of mergers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.contracts.loop import EXPOSURE, Asked
from photonpano.contracts.protocols import Merger, Source, Trajectory
from photonpano.errors import InputError
from photonpano.geometry import translation
from photonpano.plugins.contributions import MergerContribution
from photonpano.testing.captures import KnownMotion, MemorySource, ReadOnlySource, read_only, recorded, rolled
from photonpano.testing.sameness import copied, fingerprint, in_threads
from photonpano.testing.scenes import Scene
from photonpano.testing.stages import Answer, AnswerConformance, accepts_read_only
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, FrameSpan, Group, Homography, VirtualExposure

SHAPE = (40, 56)
N_FRAMES = 240
GROUP = Group(FrameSpan(20, 220), 119.5)
EARLY = Group(FrameSpan(20, 220), 40.0)  # its reference is near its beginning
_STILL = np.array([[1, 0, 300.0], [0, 1, -80.0], [0, 0, 1]])
_Z = 4.5  # standard errors of a significant bias: noise exceeds them once in 150,000 times
_BANDS = 4
_DARK_RATE = np.float64(0.2)  # dark counts per pixel per frame
_MARGIN = 8  # width of the border that few frames of the moving camera see, px


class MergerConformance(AnswerConformance):
    """Checks of a merger on binary frames of 40x56 px, of a still camera and of one that pans and rolls.

    Attributes:
        tolerance_px: largest displacement of the image when frames are merged along a known motion.
        scales: supported scales, pixels of an exposure per pixel of a frame.
        compensates: whether it uses the motion; a naive average does not.
        excess_variance: largest ratio of the variance to that of photon noise; more for one that drops photons.
    """

    kind: ClassVar[str] = "merger"
    contracts = (EXPOSURE,)

    contribution: MergerContribution
    tolerance_px: float = 0.1
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    compensates: bool = True
    excess_variance: float = 1.25

    def merged(
        self,
        source: Source,
        group: Group = GROUP,
        trajectory: Trajectory | None = None,
        scale: float = 1.0,
        threads: int = 1,
    ) -> VirtualExposure:
        """Merge with a new merger."""
        exposure: VirtualExposure = self.built(source.info, threads).merge(source, group, trajectory, scale)
        return exposure

    def answers(self) -> Iterator[Answer]:
        """Yield exposures of all scales, merged with and without a motion."""
        source = MemorySource(moving_frames(), dead_pixels())
        for scale in self.scales:
            asked = Asked(GROUP, scale, SHAPE, source.response)
            for what, trajectory in (("no motion", None), ("a known motion", MOTION)):
                described = f"the exposure with {what} and scale {scale:g}, one of `scales`"
                yield described, EXPOSURE, self.merged(source, GROUP, trajectory, scale), asked

    def test_weight_is_number_of_frames(self) -> None:
        """A still camera sees every pixel in all frames of the group."""
        exposure = self.merged(MemorySource(still_frames()))
        furthest = float(exposure.weight.ravel()[np.abs(exposure.weight - len(GROUP.span)).argmax()])
        assert np.isclose(furthest, len(GROUP.span), rtol=1e-3), (
            f"the weight must be the number of frames in which a pixel was seen; for a group of {len(GROUP.span)} frames and a "
            f"still camera it is {furthest:g} at some pixels"
        )

    def test_flux_depends_on_frames_of_group_only(self) -> None:
        """Frames before and after it have no influence."""
        frames = still_frames()
        changed = frames.copy()
        changed[: GROUP.span.start] = 1
        changed[GROUP.span.stop :] = 0
        exposures = [self.merged(MemorySource(each)) for each in (frames, changed)]
        same = np.array_equal(exposures[0].flux, exposures[1].flux, equal_nan=True)
        assert same, (
            f"the flux of a group must not depend on other frames; that of {GROUP} changes with frames before or after it"
        )

    def test_flux_is_unbiased_on_photon_noise(self) -> None:
        """Its bias is below the statistical error, for dark and for bright pixels."""
        known = lit_probability(still_flux())
        exposure = self.merged(MemorySource(still_frames()))
        error = exposure.response.mean_count(exposure.flux) - known
        z = error / np.sqrt(known * (1 - known) / len(GROUP.span))
        for band in np.array_split(np.argsort(known, axis=None), _BANDS):
            mean = z.ravel()[band].mean() * np.sqrt(len(band))
            assert abs(mean) < _Z, (
                f"the flux must be unbiased: over {len(band)} pixels with a flux of {still_flux().ravel()[band].mean():.2f} "
                f"the mean is off by {mean:+.1f} standard errors ({error.ravel()[band].mean():+.3g} counts per frame). Sum the "
                "counts, and estimate the flux once, with response.flux()"
            )

    def test_flux_has_no_more_than_photon_noise(self) -> None:
        """The variance of n binary frames is p (1 - p) / n."""
        known = lit_probability(still_flux())
        exposure = self.merged(MemorySource(still_frames()))
        error = exposure.response.mean_count(exposure.flux) - known
        ratio = float(np.mean(error**2 / (known * (1 - known) / len(GROUP.span))))
        assert ratio < self.excess_variance, (
            f"the variance of the flux is {ratio:.2f} times that of the photon noise of {len(GROUP.span)} frames "
            f"(at most excess_variance = {self.excess_variance:g}); are all frames of the group summed?"
        )

    def test_dark_counts_are_subtracted_or_source_is_refused(self) -> None:
        """A merger that cannot subtract dark counts raises an InputError."""
        known = float(lit_probability(still_flux()).mean())
        for trajectory in (None, KnownMotion(lambda _: np.eye(3))):
            source = dark_source(still_frames())
            try:
                exposure = self.merged(source, GROUP, trajectory)
            except InputError:
                continue
            mean = float(exposure.response.mean_count(exposure.flux).mean())
            assert abs(mean / known - 1) < 0.02, (
                f"dark counts, which source.corrected subtracts, must not be part of the flux; the mean count is {mean:.4f}, "
                f"not {known:.4f}. Use `photonpano.merging.accumulate`, or raise an InputError if `source.corrects_sums`"
            )

    def test_masked_pixels_have_no_influence(self) -> None:
        """`source.valid` is false for hot pixels, which are lit in every frame."""
        valid = dead_pixels()
        hot = np.where(valid, still_frames(), 1)
        exposure = self.merged(MemorySource(hot, valid))
        seen = float(exposure.weight[~valid].max())
        assert seen == 0, f"for a still camera the weight must be 0 where source.valid is false; it is {seen:g}"
        clean = self.merged(MemorySource(np.where(valid, still_frames(), 0), valid))
        same = np.array_equal(exposure.flux, clean.flux, equal_nan=True)
        assert same, "masked pixels must have no influence; the flux of other pixels changes with their counts"

    def test_masked_pixels_have_no_influence_along_motion(self) -> None:
        """Other pixels saw the same places, and a hot pixel would leave a trail."""
        self._require_compensation()
        valid = dead_pixels()
        hot, dark = (self.merged(MemorySource(np.where(valid, moving_frames(), lit), valid), GROUP, MOTION) for lit in (1, 0))
        same = np.array_equal(hot.flux, dark.flux, equal_nan=True)
        assert same, "masked pixels must have no influence; along a known motion the flux changes with their counts"

    @pytest.mark.parametrize("group", [GROUP, EARLY], ids=["from the middle", "from near the beginning"])
    def test_merge_compensates_known_motion(self, group: Group) -> None:
        """The scene is as sharp as in a frame, and in its place at the reference instant of the group."""
        self._require_compensation()
        exposure = self.merged(MemorySource(moving_frames()), group, MOTION)
        shift, contrast = displacement_and_contrast(exposure, lit_probability(view_at(group.reference)))
        assert contrast > 0.7, (
            f"along a known motion the image must stay sharp; its contrast is {contrast:.0%} of that of the scene, and "
            f"that of an unwarped average {average_contrast():.0%}. Map pixels of frame t to those of the reference "
            "instant r by inverse(trajectory.at(r)) @ trajectory.at(t)"
        )
        assert np.hypot(*shift) <= self.tolerance_px, (
            f"the image must show the scene in its place at instant {group.reference:g}; it is displaced by "
            f"({shift[0]:+.2f}, {shift[1]:+.2f}) px in x and y, more than tolerance_px = {self.tolerance_px:g}"
        )

    def test_exposure_does_not_depend_on_reference_plane(self) -> None:
        """Warps are relative to the reference instant of the group; the reference plane is arbitrary."""
        self._require_compensation()
        source = MemorySource(moving_frames())
        there = KnownMotion(lambda frame: translation(5000, -700) @ MOTION.at([frame])[0])
        here, moved = (self.merged(source, GROUP, motion) for motion in (MOTION, there))
        inside = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
        far = float(np.abs(here.flux - moved.flux)[inside].max())
        assert far < 1e-2, (
            "an exposure must not depend on the reference plane of the trajectory, only on the motion within its group; with "
            f"the plane moved by (5000, -700) px the flux changes by {far:.2g}"
        )

    def test_flux_does_not_depend_on_scale(self) -> None:
        """Flux is photons per pixel of a frame, whatever the grid."""
        known = float(lit_probability(still_flux()).mean())
        for scale in self.scales:
            exposure = self.merged(MemorySource(still_frames()), GROUP, None, scale)
            mean = float(np.nanmean(exposure.response.mean_count(exposure.flux)))
            assert abs(mean / known - 1) < 0.02, (
                f"flux must be that of a pixel of a frame; at scale {scale:g} the mean count is {mean:.4f}, not {known:.4f}"
            )

    def test_merge_leaves_inputs_unchanged(self) -> None:
        """Counts and masks are shared between threads."""
        for trajectory in (None, MOTION):
            source = MemorySource(moving_frames(), dead_pixels())
            self.merged(source, GROUP, trajectory)
            same = np.array_equal(source.valid, dead_pixels())
            assert same, "merge() modifies source.valid; copy it before you change it"
            with accepts_read_only("merge()"):
                self.merged(ReadOnlySource(moving_frames(), dead_pixels()), GROUP, trajectory)

    def test_merge_is_deterministic(self) -> None:
        """A run can be repeated, and one merger merges several groups at once."""
        source = MemorySource(moving_frames(), dead_pixels())
        for trajectory in (None, MOTION):
            expected = fingerprint(self.merged(source, GROUP, trajectory))
            merger = self.built(source.info)
            others = {"merged again": fingerprint(self.merged(source, GROUP, trajectory))}
            others["with four threads"] = fingerprint(self.merged(source, GROUP, trajectory, threads=4))
            for found in in_threads(partial(_merged_by, merger, source, trajectory)):
                others.setdefault("in several threads at once", found)
                if found != expected:
                    others["in several threads at once"] = found
            wrong = [how for how, found in others.items() if found != expected]
            assert not wrong, f"the same frames must give the same bytes; {' and '.join(wrong)}, the exposure differs"

    def test_merger_works_in_other_processes(self) -> None:
        """An executor may send it to other processes and machines."""
        source = MemorySource(moving_frames(), dead_pixels())
        merger = self.built(source.info)
        copy = copied(merger, "a merger")
        expected, found = (fingerprint(each.merge(source, GROUP, MOTION, 1.0)) for each in (merger, copy))
        assert found == expected, "the same frames must give the same bytes; a pickled copy of the merger gives others"

    def _require_compensation(self) -> None:
        if not self.compensates:
            pytest.skip("compensates = False")


def dark_source(frames: NDArray[np.uint8]) -> Capture:
    """Return a capture with dark counts, which it subtracts from sums of frames."""
    dark = np.random.default_rng(9).random(frames.shape) < lit_probability(_DARK_RATE)
    return replace(capture_of(MemorySource(frames | dark)), steps=(_without_dark_counts,))


def _without_dark_counts(counts: Counts, n_frames: int) -> FluxImage:
    return np.asarray(n_frames - (n_frames - counts.astype(np.float32)) * np.exp(_DARK_RATE), np.float32)


def _merged_by(merger: Merger, source: Source, trajectory: Trajectory | None, thread: int) -> object:
    del thread
    return fingerprint(merger.merge(source, GROUP, trajectory, 1.0))


def lit_probability(flux: FloatArray | np.float64) -> FloatArray:
    """Return the probability that a binary pixel is lit (paper, equation 2)."""
    return np.asarray(-np.expm1(-flux))


def _to_scene(frame: float) -> Homography:
    """Return the pose of the moving camera, which pans by 0.1 px and rolls by 0.02 degrees per frame."""
    roll = rolled(0.02 * (frame - N_FRAMES / 2), SHAPE)
    return np.asarray(translation(300 + 0.1 * frame, -80 + 0.04 * frame) @ roll)


MOTION = KnownMotion(_to_scene)  # pixels of a frame of the moving camera to points of the scene
SCENE = Scene(seed=3)


@cache
def still_flux() -> FloatArray:
    """Return the flux that the still camera sees: (H, W)."""
    return SCENE.view(_STILL, SHAPE)


@cache
def still_frames() -> NDArray[np.uint8]:
    """Return the frames of the still camera."""
    frames = np.random.default_rng(5).random((N_FRAMES, *SHAPE)) < lit_probability(still_flux())
    return read_only(frames.astype(np.uint8))


@cache
def moving_frames() -> NDArray[np.uint8]:
    """Return the frames of the moving camera."""
    return read_only(recorded(SCENE, MOTION, N_FRAMES, SHAPE, seed=5))


def dead_pixels() -> BoolArray:
    """Return a mask that is false for three columns and some single pixels."""
    valid = np.random.default_rng(7).random(SHAPE) > 0.02
    valid[:, 30:33] = False
    return valid


def view_at(instant: float) -> FloatArray:
    """Return the flux that the moving camera sees at an instant."""
    return SCENE.view(MOTION.at([instant])[0], SHAPE)


def displacement_and_contrast(exposure: VirtualExposure, known: FloatArray) -> tuple[FloatArray, float]:
    """Return the displacement of an exposure, (x, y) in px, and its contrast, as a share of the expected one.

    To first order, an image of contrast c that is displaced by d is mean + c (known - mean) - c d . gradient.
    """
    inside = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
    down, right = np.gradient(known)
    columns = [np.ones_like(known), known - known.mean(), right, down]
    system = np.stack([column[inside].ravel() for column in columns], axis=1)
    image = exposure.response.mean_count(exposure.flux)[inside].ravel().astype(np.float64)
    seen = np.isfinite(image)
    _, contrast, x, y = np.linalg.lstsq(system[seen], image[seen], rcond=None)[0]
    return -np.array([x, y]) / max(abs(contrast), 1e-6), float(contrast)


@cache
def average_contrast() -> float:
    """Return the contrast of the unwarped average of the moving camera's frames."""
    source = MemorySource(moving_frames())
    frames = len(GROUP.span)
    flux = source.response.flux((source.counts(GROUP.span) / frames).astype(np.float32), frames)
    exposure = VirtualExposure(flux, np.full(SHAPE, frames, np.float32), GROUP, 1.0, source.response)
    return displacement_and_contrast(exposure, lit_probability(view_at(GROUP.reference)))[1]
