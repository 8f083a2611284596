"""What mergers promise."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from photonpano.contributions import MergerContribution
from photonpano.errors import InputError
from photonpano.geometry import translation
from photonpano.protocols import Merger, Source, Trajectory
from photonpano.testing.captures import KnownMotion, MemorySource, ReadOnlySource, read_only, recorded
from photonpano.testing.sameness import fingerprint, in_threads
from photonpano.testing.scenes import Scene
from photonpano.testing.stages import StageConformance, unharmed
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, FrameSpan, Group, Homography, VirtualExposure

SHAPE = (40, 56)
N_FRAMES = 240
GROUP = Group(FrameSpan(20, 220), 119.5)
EARLY = Group(FrameSpan(20, 220), 40.0)
"""Seen from near its beginning."""
_STILL = np.array([[1, 0, 300.0], [0, 1, -80.0], [0, 0, 1]])
_Z = 4.5
"""So many standard deviations are not chance: once in 150,000 times."""
_BANDS = 4
_DARK_RATE = np.float64(0.2)
"""Dark counts of a pixel in a frame."""
_MARGIN = 8
"""Pixels at the border of a moving camera are seen by few frames."""


class MergerConformance(StageConformance):
    """Checks of a merger on binary frames of 40x56 px, of a camera that stands still and of one that pans and rolls.

    Attributes:
        contribution: what is tested.
        config: keys under `with`.
        tolerance_px: how far the image may be displaced when frames are merged along a known motion.
        scales: pixels of an exposure per pixel of a frame, for which it can be asked.
        compensates: whether it uses the motion known so far; a naive average does not.
        excess_variance: how many times as large as that of photon noise the variance may be; more for one that drops photons.
    """

    kind: ClassVar[str] = "merger"
    methods: ClassVar[tuple[str, ...]] = ("merge",)

    contribution: MergerContribution
    tolerance_px: float = 0.1
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    compensates: bool = True
    excess_variance: float = 1.25

    def merged(
        self,
        source: MemorySource,
        group: Group = GROUP,
        trajectory: Trajectory | None = None,
        scale: float = 1.0,
        threads: int = 1,
    ) -> VirtualExposure:
        """Merge with a merger that has just been built."""
        exposure: VirtualExposure = self.built(source.info, threads).merge(source, group, trajectory, scale)
        return exposure

    def _everywhere(self) -> Iterator[tuple[str, VirtualExposure, float]]:
        for scale in self.scales:
            for what, trajectory in (("no motion known yet", None), ("a known motion", MOTION)):
                source = MemorySource(moving_frames(), dead_pixels())
                yield f"{what} and scale {scale:g}", self.merged(source, GROUP, trajectory, scale), scale

    def test_an_exposure_has_the_size_that_the_scale_asks_for(self) -> None:
        """Flux and weight are float32, on the grid of a frame rescaled."""
        for where, exposure, scale in self._everywhere():
            assert isinstance(exposure, VirtualExposure), f"merge() returns a VirtualExposure, got a {type(exposure).__name__}"
            wanted = tuple(round(side * scale) for side in SHAPE)
            for name, image in (("flux", exposure.flux), ("weight", exposure.weight)):
                assert image.shape == wanted, (
                    f"with {where}, {name} must be of {wanted}, got {image.shape}; scales = (1.0,) if it knows no other"
                )
                assert image.dtype == np.float32, f"with {where}, {name} must be float32, got {image.dtype}"

    def test_an_exposure_says_what_it_is_made_of(self) -> None:
        """Later stages ask it for its group, its scale and its camera."""
        source = MemorySource(still_frames())
        for scale in self.scales:
            exposure = self.merged(source, GROUP, None, scale)
            named = exposure.group, exposure.scale, exposure.response
            assert named == (GROUP, scale, source.response), (
                f"an exposure carries the group and the scale it was asked for, and the response of the source; got {named}"
            )

    def test_flux_is_nan_exactly_where_the_weight_is_zero(self) -> None:
        """Unknown pixels are NaN with weight 0; all others are known."""
        for where, exposure, _ in self._everywhere():
            unknown, unseen = np.isnan(exposure.flux), exposure.weight == 0
            wrong = int((unknown & ~unseen).sum()), int((unseen & ~unknown).sum())
            assert wrong == (0, 0), (
                f"flux is NaN exactly where the weight is 0; with {where}, {wrong[0]} pixels are NaN and have a weight, and "
                f"{wrong[1]} have a flux and weight 0"
            )
            known = exposure.flux[~unknown]
            finite = bool(np.isfinite(known).all() and np.isfinite(exposure.weight).all())
            assert finite, f"with {where}, flux or weight is infinite in places; response.flux() bounds the flux"
            least = min(float(known.min()), float(exposure.weight.min()))
            assert least >= 0, f"with {where}, flux or weight is negative in places, {least:.3g} at the least"

    def test_the_weight_is_the_number_of_frames(self) -> None:
        """Of a camera that stands still every pixel was seen in all frames of the group, and in no others."""
        exposure = self.merged(MemorySource(still_frames()))
        furthest = float(exposure.weight.ravel()[np.abs(exposure.weight - len(GROUP.span)).argmax()])
        assert np.isclose(furthest, len(GROUP.span), rtol=1e-3), (
            f"the weight is how many frames a pixel was seen in; of a group of {len(GROUP.span)} frames it is {furthest:g} in "
            "places"
        )

    def test_only_the_frames_of_the_group_count(self) -> None:
        """The camera may see something else before and afterwards."""
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
        """In the dark and in the bright, to within the statistical error of so many photons."""
        known = chance_of_light(still_flux())
        exposure = self.merged(MemorySource(still_frames()))
        error = exposure.response.mean_count(exposure.flux) - known
        z = error / np.sqrt(known * (1 - known) / len(GROUP.span))
        for band in np.array_split(np.argsort(known, axis=None), _BANDS):
            mean = z.ravel()[band].mean() * np.sqrt(len(band))
            assert abs(mean) < _Z, (
                f"the flux must be unbiased: of {len(band)} pixels with a flux of {still_flux().ravel()[band].mean():.2f} the "
                f"mean is off by {mean:+.1f} standard errors ({error.ravel()[band].mean():+.3g} counts a frame). Add up "
                "counts, and estimate the flux once, with response.flux()"
            )

    def test_flux_is_no_noisier_than_photons(self) -> None:
        """The variance of n binary frames is p (1 - p) / n."""
        known = chance_of_light(still_flux())
        exposure = self.merged(MemorySource(still_frames()))
        error = exposure.response.mean_count(exposure.flux) - known
        ratio = float(np.mean(error**2 / (known * (1 - known) / len(GROUP.span))))
        assert ratio < self.excess_variance, (
            f"the flux is {ratio:.2f} times as noisy, in variance, as the photons of {len(GROUP.span)} frames are "
            f"(at most excess_variance = {self.excess_variance:g}); are all frames of the group counted?"
        )

    def test_what_the_source_takes_out_of_sums_is_no_flux(self) -> None:
        """Dark counts are not seen as light; a merger that cannot have them taken out refuses the source."""
        known = float(chance_of_light(still_flux()).mean())
        for trajectory in (None, KnownMotion(lambda _: np.eye(3))):
            source = DarkSource(still_frames())
            try:
                exposure = self.merged(source, GROUP, trajectory)
            except InputError:
                continue
            mean = float(exposure.response.mean_count(exposure.flux).mean())
            assert abs(mean / known - 1) < 0.02, (
                f"what source.corrected takes out of sums must not be in the flux; the mean count is {mean:.4f}, not "
                f"{known:.4f}. `photonpano.merging.accumulate` does so; or raise an InputError for a LinearlyCorrectedSource"
            )

    def test_masked_pixels_do_not_count(self) -> None:
        """Hot pixels are lit in every frame, and `source.valid` is false for them."""
        valid = dead_pixels()
        hot = np.where(valid, still_frames(), 1)
        exposure = self.merged(MemorySource(hot, valid))
        seen = float(exposure.weight[~valid].max())
        assert seen == 0, f"where source.valid is false, the weight of a camera that stands still must be 0; it is {seen:g}"
        clean = self.merged(MemorySource(np.where(valid, still_frames(), 0), valid))
        same = np.array_equal(exposure.flux, clean.flux, equal_nan=True)
        assert same, "what masked pixels count must not matter; the flux changes with it elsewhere"

    def test_masked_pixels_do_not_count_along_a_motion(self) -> None:
        """Other pixels saw those places; a hot one would draw a line."""
        self._require_compensation()
        valid = dead_pixels()
        hot, dark = (self.merged(MemorySource(np.where(valid, moving_frames(), lit), valid), GROUP, MOTION) for lit in (1, 0))
        same = np.array_equal(hot.flux, dark.flux, equal_nan=True)
        assert same, "what masked pixels count must not matter; along a known motion the flux changes with it"

    @pytest.mark.parametrize("group", [GROUP, EARLY], ids=["from the middle", "from near the beginning"])
    def test_it_compensates_along_a_known_motion(self, group: Group) -> None:
        """The scene is as sharp as in a frame, and lies where it does at the reference instant of the group."""
        self._require_compensation()
        exposure = self.merged(MemorySource(moving_frames()), group, MOTION)
        shift, contrast = likeness(exposure, chance_of_light(view_at(group.reference)))
        assert contrast > 0.7, (
            f"along a known motion the image must stay sharp; its contrast is {contrast:.0%} of that of the scene, and "
            f"that of an average of the frames as they lie {average_contrast():.0%}. Pixels of frame t are mapped to "
            "those of the reference instant r by inverse(trajectory.at(r)) @ trajectory.at(t)"
        )
        assert np.hypot(*shift) <= self.tolerance_px, (
            f"the image must show the scene as it lies at instant {group.reference:g}; it is displaced by "
            f"({shift[0]:+.2f}, {shift[1]:+.2f}) px in x and y, more than tolerance_px = {self.tolerance_px:g}"
        )

    def test_where_the_reference_plane_lies_does_not_matter(self) -> None:
        """Warps are relative to the reference instant of the group; the plane of the trajectory is arbitrary."""
        self._require_compensation()
        source = MemorySource(moving_frames())
        there = KnownMotion(lambda frame: translation(5000, -700) @ MOTION.at([frame])[0])
        here, moved = (self.merged(source, GROUP, motion) for motion in (MOTION, there))
        inside = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
        far = float(np.abs(here.flux - moved.flux)[inside].max())
        assert far < 1e-2, (
            "an exposure is seen from its group's reference instant, wherever the plane of the trajectory lies; with the "
            f"plane moved by (5000, -700) px the flux changes by {far:.2g}"
        )

    def test_brightness_is_the_same_at_every_scale(self) -> None:
        """Flux is photons per pixel of a frame, whatever the grid."""
        known = float(chance_of_light(still_flux()).mean())
        for scale in self.scales:
            exposure = self.merged(MemorySource(still_frames()), GROUP, None, scale)
            mean = float(np.nanmean(exposure.response.mean_count(exposure.flux)))
            assert abs(mean / known - 1) < 0.02, (
                f"flux is counted per pixel of a frame; at scale {scale:g} the mean count is {mean:.4f}, not {known:.4f}"
            )

    def test_what_it_is_given_is_left_as_it_is(self) -> None:
        """Counts and masks are shared between threads."""
        for trajectory in (None, MOTION):
            source = MemorySource(moving_frames(), dead_pixels())
            self.merged(source, GROUP, trajectory)
            same = np.array_equal(source.valid, dead_pixels())
            assert same, "merge() writes to source.valid; copy it first"
            with unharmed("merge()"):
                self.merged(ReadOnlySource(moving_frames(), dead_pixels()), GROUP, trajectory)

    def test_the_same_frames_give_the_same_bytes(self) -> None:
        """A run can be repeated; several groups are merged at once by one merger."""
        source = MemorySource(moving_frames(), dead_pixels())
        for trajectory in (None, MOTION):
            expected = fingerprint(self.merged(source, GROUP, trajectory))
            merger = self.built(source.info)
            others = {"merged once more": fingerprint(self.merged(source, GROUP, trajectory))}
            others["with four threads at its disposal"] = fingerprint(self.merged(source, GROUP, trajectory, threads=4))
            for found in in_threads(partial(_merged_by, merger, source, trajectory)):
                others.setdefault("merged in several threads at once", found)
                if found != expected:
                    others["merged in several threads at once"] = found
            wrong = [how for how, found in others.items() if found != expected]
            assert not wrong, f"the same frames must give the same bytes; {' and '.join(wrong)}, the exposure is another"

    def _require_compensation(self) -> None:
        if not self.compensates:
            pytest.skip("compensates = False")


class DarkSource(MemorySource):
    """Adds dark counts to frames, and knows how to take them out: a `photonpano.LinearlyCorrectedSource`."""

    def __init__(self, frames: NDArray[np.uint8]) -> None:
        dark = np.random.default_rng(9).random(frames.shape) < chance_of_light(_DARK_RATE)
        super().__init__(frames | dark)

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """See `photonpano.LinearlyCorrectedSource`."""
        dark_frames = n_frames - counts.astype(np.float32)
        return np.asarray(n_frames - dark_frames * np.exp(_DARK_RATE), np.float32)


def _merged_by(merger: Merger, source: Source, trajectory: Trajectory | None, thread: int) -> object:
    del thread
    return fingerprint(merger.merge(source, GROUP, trajectory, 1.0))


def chance_of_light(flux: FloatArray | np.float64) -> FloatArray:
    """Return the probability that a binary pixel is lit (paper, equation 2)."""
    return np.asarray(-np.expm1(-flux))


def _to_scene(frame: float) -> Homography:
    """Return where the moving camera looks: it pans by 0.1 px a frame and rolls by 0.02 degrees a frame."""
    angle = np.deg2rad(0.02) * (frame - N_FRAMES / 2)
    cos, sin = np.cos(angle), np.sin(angle)
    centre = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    roll = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return np.asarray(translation(300 + 0.1 * frame, -80 + 0.04 * frame) @ centre @ roll @ np.linalg.inv(centre))


MOTION = KnownMotion(_to_scene)
"""Pixels of a frame of the moving camera to points of the scene."""
_SCENE = Scene(seed=3)


@cache
def still_flux() -> FloatArray:
    """Return what the camera that stands still sees: (H, W)."""
    return _SCENE.view(_STILL, SHAPE)


@cache
def still_frames() -> NDArray[np.uint8]:
    """Return the frames of the camera that stands still."""
    frames = np.random.default_rng(5).random((N_FRAMES, *SHAPE)) < chance_of_light(still_flux())
    return read_only(frames.astype(np.uint8))


@cache
def moving_frames() -> NDArray[np.uint8]:
    """Return the frames of the camera that moves."""
    return read_only(recorded(_SCENE, MOTION, N_FRAMES, SHAPE, seed=5))


def dead_pixels() -> BoolArray:
    """Return a mask with three columns and some single pixels that are not to be used."""
    valid = np.random.default_rng(7).random(SHAPE) > 0.02
    valid[:, 30:33] = False
    return valid


def view_at(instant: float) -> FloatArray:
    """Return the flux that the moving camera sees at an instant."""
    return _SCENE.view(MOTION.at([instant])[0], SHAPE)


def likeness(exposure: VirtualExposure, known: FloatArray) -> tuple[FloatArray, float]:
    """Return how far an exposure is displaced, (x, y) in px, and its contrast as a share of that of what it should show.

    To first order, an image of contrast c that is displaced by d is the mean + c (known - mean) - c d . gradient.
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
    """Return the contrast of the frames of the moving camera, averaged as they lie."""
    source = MemorySource(moving_frames())
    frames = len(GROUP.span)
    flux = source.response.flux((source.counts(GROUP.span) / frames).astype(np.float32), frames)
    exposure = VirtualExposure(flux, np.full(SHAPE, frames, np.float32), GROUP, 1.0, source.response)
    return likeness(exposure, chance_of_light(view_at(GROUP.reference)))[1]
