"""Checks of mergers and renderers, on frames of a still camera and of one that pans and rolls; and of exporters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.contracts.requirements import require_exposure, require_panorama
from photonpano.errors import InputError
from photonpano.geometry import Canvas, canvas_of, inverse, translation
from photonpano.merging.canvas_noise import CanvasNoise
from photonpano.photometry import BinaryResponse, flux_std
from photonpano.pipeline.rendering import AttributedExporter, StoredPanorama
from photonpano.plugins.contributions import ExporterContribution, MergerContribution, RendererContribution
from photonpano.record.contents import contents_of
from photonpano.record.schema import FileContent
from photonpano.testing.captures import KnownMotion, MemorySource, ReadOnlySource, Scene, read_only, recorded, rolled
from photonpano.testing.conformance import Answer, AnswerConformance, StageConformance, copied, fingerprint, in_threads, passing
from photonpano.values import BoolArray, Counts, FloatArray, FluxImage, FrameSpan, Group, Homography, Panorama, VirtualExposure

SHAPE = (40, 56)
N_FRAMES = 240
SPAN = FrameSpan(20, 220)  # the frames that are merged or rendered
GROUP = Group(SPAN, 119.5)
EARLY = Group(SPAN, 40.0)  # its reference is near its beginning
TOLERANCE_PX = 0.25
_STILL = np.array([[1, 0, 300.0], [0, 1, -80.0], [0, 0, 1]])
_Z = 4.5  # standard errors of a significant bias: noise exceeds them once in 150,000 times
_BANDS = 4
_DARK_RATE = np.float64(0.2)  # dark counts per pixel per frame
_MARGIN = 8  # width of the border that few frames of the moving camera see, px
_SEEN = 20  # frames that a pixel of a panorama was seen in if it is compared with the scene
_SHARP = 0.7  # contrast of a sharp image, as a share of that of the scene
PANORAMA_SHAPE = (37, 53)


class MergerConformance(AnswerConformance):
    """Checks of a merger on binary frames of 40x56 px."""

    kind: ClassVar[str] = "merger"

    contribution: MergerContribution
    tolerance_px: float = 0.1  # largest displacement of the image when frames are merged along a known motion
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)  # supported scales, pixels of an exposure per pixel of a frame
    compensates: bool = True  # whether it uses the motion; a naive average does not
    excess_variance: float = 1.25  # largest ratio of the variance to that of photon noise; more for one that drops photons

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
        """Yield exposures of all scales, merged with and without a motion. Threads share the arrays, which are read-only."""
        source = ReadOnlySource(moving_frames(), dead_pixels())
        for scale in self.scales:
            for what, trajectory in (("no motion", None), ("a known motion", MOTION)):
                exposure = self.merged(source, GROUP, trajectory, scale)
                require = partial(require_exposure, source=source, group=GROUP, _=trajectory, scale=scale)
                yield f"the exposure with {what} and scale {scale:g}, one of `scales`", exposure, require

    def test_weight_is_number_of_frames(self) -> None:
        """A still camera sees every pixel in all frames of the group."""
        weight = self.merged(MemorySource(still_frames())).weight
        np.testing.assert_allclose(weight, len(SPAN), rtol=1e-3, err_msg="the weight is the number of frames of the group")

    def test_flux_depends_on_frames_of_group_only(self) -> None:
        """Frames before and after it have no influence."""
        flux, other = (self.merged(MemorySource(each)).flux for each in (still_frames(), with_other_ends(still_frames())))
        assert_array_equal(flux, other, f"the flux of {GROUP} must not depend on other frames")

    def test_flux_is_unbiased_with_photon_noise(self) -> None:
        """Its bias is below the statistical error, for dark and for bright pixels; n frames have the variance p (1 - p) / n."""
        known = lit_probability(still_flux())
        exposure = self.merged(MemorySource(still_frames()))
        z = (exposure.response.mean_count(exposure.flux) - known) / np.sqrt(known * (1 - known) / len(SPAN))
        for band in np.array_split(np.argsort(known, axis=None), _BANDS):
            bias = z.ravel()[band].mean() * np.sqrt(len(band))
            assert abs(bias) < _Z, "biased flux, in standard errors: sum the counts, and call response.flux() once"
        assert np.mean(z**2) < self.excess_variance, "the flux has more than photon noise; are all frames summed?"

    def test_dark_counts_are_subtracted_or_source_is_refused(self) -> None:
        """A merger that cannot subtract dark counts raises an InputError."""
        known = float(lit_probability(still_flux()).mean())
        for trajectory in (None, KnownMotion(lambda _: np.eye(3))):
            try:
                exposure = self.merged(dark_source(still_frames()), GROUP, trajectory)
            except InputError:
                continue
            mean = float(exposure.response.mean_count(exposure.flux).mean())
            assert mean == pytest.approx(known, rel=0.02), "use source.corrected(), or raise InputError if source.corrects_sums"

    @pytest.mark.parametrize("moves", [False, True])
    def test_masked_pixels_have_no_influence(self, moves: bool) -> None:
        """`source.valid` is false for hot pixels, which are lit in every frame; a motion would draw a trail of them."""
        if moves:
            self._require_compensation()
        valid, frames, motion = dead_pixels(), moving_frames() if moves else still_frames(), MOTION if moves else None
        hot, dark = (self.merged(MemorySource(np.where(valid, frames, lit), valid), GROUP, motion) for lit in (1, 0))
        assert_array_equal(hot.flux, dark.flux, "pixels where source.valid is false must not count")
        assert moves or not hot.weight[~valid].any(), "the weight is 0 where source.valid is false"

    @pytest.mark.parametrize("group", [GROUP, EARLY], ids=["from the middle", "from near the beginning"])
    def test_merge_compensates_known_motion(self, group: Group) -> None:
        """Pixels of frame t are mapped to the reference instant r by inverse(trajectory.at(r)) @ trajectory.at(t)."""
        self._require_compensation()
        exposure = self.merged(MemorySource(moving_frames()), group, MOTION)
        known = lit_probability(SCENE.view(MOTION.at([group.reference])[0], SHAPE))
        shift, contrast = displacement_and_contrast(exposure, known)
        assert contrast > _SHARP, "along a known motion the image must stay sharp"
        assert np.hypot(*shift) <= self.tolerance_px, f"the scene must be in its place at instant {group.reference:g}"

    def test_exposure_does_not_depend_on_reference_plane(self) -> None:
        """Warps are relative to the reference instant of the group; the reference plane is arbitrary."""
        self._require_compensation()
        source = MemorySource(moving_frames())
        there = KnownMotion(lambda frame: translation(5000, -700) @ MOTION.at([frame])[0])
        here, moved = (self.merged(source, GROUP, motion) for motion in (MOTION, there))
        inside = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
        assert np.abs(here.flux - moved.flux)[inside].max() < 1e-2, "the reference plane must not change the exposure"

    def test_flux_does_not_depend_on_scale(self) -> None:
        """Flux is photons per pixel of a frame, whatever the grid."""
        known = float(lit_probability(still_flux()).mean())
        for scale in self.scales:
            exposure = self.merged(MemorySource(still_frames()), GROUP, None, scale)
            mean = float(np.nanmean(exposure.response.mean_count(exposure.flux)))
            assert mean == pytest.approx(known, rel=0.02), f"flux must be that of a pixel of a frame, at scale {scale:g}"

    def test_merge_is_deterministic(self) -> None:
        """A run can be repeated, and one merger merges several groups at once."""
        source = MemorySource(moving_frames(), dead_pixels())
        for trajectory in (None, MOTION):
            expected = fingerprint(self.merged(source, GROUP, trajectory))
            assert fingerprint(self.merged(source, GROUP, trajectory)) == expected, "merged again, the exposure differs"
            assert fingerprint(self.merged(source, GROUP, trajectory, threads=4)) == expected, "with threads, it differs"
            merge = partial(self.built(source.info).merge, source, GROUP, trajectory, 1.0)
            found = in_threads(lambda _, merge=merge: fingerprint(merge()))  # type: ignore[misc]  # the default binds it
            assert {*found} == {expected}, "from several threads at once, the exposure differs"

    def test_merger_works_in_other_processes(self) -> None:
        """An executor may send it to other processes and machines."""
        source = MemorySource(moving_frames(), dead_pixels())
        merger = self.built(source.info)
        mergers = merger, copied(merger, "a merger")
        expected, found = (fingerprint(each.merge(source, GROUP, MOTION, 1.0)) for each in mergers)
        assert found == expected, "a pickled copy of the merger merges otherwise"

    def _require_compensation(self) -> None:
        if not self.compensates:
            pytest.skip("compensates = False")


class RendererConformance(AnswerConformance):
    """Checks of a renderer on binary frames of 40x56 px of a camera that pans and rolls, of which 200 are rendered."""

    kind: ClassVar[str] = "renderer"

    contribution: RendererContribution
    tolerance_px: float = 0.1  # largest displacement of the panorama
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)  # supported scales, pixels of the canvas per pixel of a frame
    # largest difference of 19 of 20 pixels of a tile from the same ones of the canvas, as a share of the mean flux
    tile_tolerance: float = 1e-3

    def rendered(self, source: Source, canvas: Canvas | None = None, threads: int = 1) -> Panorama:
        """Render with a new renderer, on a canvas of scale 1 by default, and add up the frames that are done."""
        done = list[int]()
        panorama: Panorama = self.built(source.info, threads).render(
            source, MOTION, SPAN, canvas or canvas_at(1.0), TOLERANCE_PX, done.append
        )
        assert sum(done) == len(SPAN), "advance() must be called with the numbers of frames that are done"
        return panorama

    def answers(self) -> Iterator[Answer]:
        """Yield panoramas of all scales. Threads share the arrays of the capture, which are read-only."""
        source = ReadOnlySource(moving_frames(), dead_pixels())
        for scale in self.scales:
            canvas = canvas_at(scale)
            require = partial(require_panorama, _source=source, _trajectory=MOTION, _span=SPAN, canvas=canvas)
            yield f"the panorama of scale {scale:g}, one of `scales`", self.rendered(source, canvas), require

    def test_flux_depends_on_frames_of_span_only(self) -> None:
        """Frames before and after it have no influence."""
        flux, other = (self.rendered(MemorySource(each)).flux for each in (moving_frames(), with_other_ends(moving_frames())))
        assert_array_equal(flux, other, f"the panorama of {SPAN} must not depend on other frames")

    def test_masked_pixels_have_no_influence(self) -> None:
        """Other pixels saw the same places, and a hot pixel would leave a trail."""
        valid = dead_pixels()
        hot, dark = (self.rendered(MemorySource(np.where(valid, moving_frames(), lit), valid)) for lit in (1, 0))
        assert_array_equal(hot.flux, dark.flux, "pixels where source.valid is false must not count")

    def test_panorama_shows_scene_in_its_place(self) -> None:
        """It is as sharp as a frame at each scale, and its flux is that of a pixel of a frame."""
        source, response = MemorySource(moving_frames()), BinaryResponse()
        for scale in self.scales:
            canvas = canvas_at(scale)
            panorama = self.rendered(source, canvas)
            seen, known = panorama.weight >= _SEEN, lit_probability(true_flux(canvas))
            flux = np.where(seen, panorama.flux, np.float32(np.nan))
            shown = VirtualExposure(flux, panorama.weight, Group(SPAN, SPAN.centre), scale, response)
            shift, contrast = displacement_and_contrast(shown, known)
            at = f"at scale {scale:g}; a pixel p of frame t lies at canvas.transform @ trajectory.at(t) @ p"
            assert contrast > _SHARP, f"the panorama must be sharp {at}"
            assert np.hypot(*shift) / scale <= self.tolerance_px, f"the panorama must show the scene in its place {at}"
            mean = float(response.mean_count(panorama.flux)[seen].mean())
            assert mean == pytest.approx(float(known[seen].mean()), rel=0.02), f"flux must not depend on the scale {scale:g}"

    def test_dark_counts_are_subtracted_or_source_is_refused(self) -> None:
        """A renderer that cannot subtract dark counts raises an InputError."""
        source, canvas = dark_source(moving_frames()), canvas_at(1.0)
        try:
            panorama = self.rendered(source)
        except InputError:
            return
        seen = panorama.weight >= _SEEN
        mean, known = source.response.mean_count(panorama.flux)[seen].mean(), lit_probability(true_flux(canvas))[seen].mean()
        assert mean == pytest.approx(known, rel=0.03), "use source.corrected(), or raise InputError if source.corrects_sums"

    def test_tiles_fit_together(self) -> None:
        """What a pixel shows does not depend on the tile that it lies in; a renderer may render a margin and cut it off."""
        source, canvas = MemorySource(moving_frames()), canvas_at(1.0)
        whole, left = self.rendered(source, canvas), canvas.width // 2
        tile = self.rendered(source, Canvas(canvas.height, canvas.width - left, translation(-left, 0) @ canvas.transform))
        seen = (whole.weight[:, left:] >= _SEEN) & (tile.weight >= _SEEN)
        expected = whole.flux[:, left:][seen]
        far = float(np.quantile(np.abs(tile.flux[seen] - expected), 0.95) / np.mean(expected))
        assert far <= self.tile_tolerance, "pixels of a tile differ from those of the whole canvas"

    def test_render_is_deterministic(self) -> None:
        """The same frames give the same bytes, whatever the number of threads."""
        source = MemorySource(moving_frames(), dead_pixels())
        first, again, threaded = (fingerprint(self.rendered(source, threads=each)) for each in (1, 1, 4))
        assert first == again == threaded, "the same frames must give the same bytes"


@cache
def canvas_at(scale: float) -> Canvas:
    """Return a canvas that holds all frames of the span; its corners are not seen."""
    return canvas_of(MOTION.at(np.arange(SPAN.start, SPAN.stop)), SHAPE, scale)


def true_flux(canvas: Canvas) -> FloatArray:
    """Return the flux of the scene at the pixels of a canvas."""
    return SCENE.view(inverse(canvas.transform), canvas.shape)


def with_other_ends(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return frames that differ before and after the span."""
    changed = frames.copy()
    changed[: SPAN.start], changed[SPAN.stop :] = 1, 0
    return changed


def dark_source(frames: NDArray[np.uint8]) -> Capture:
    """Return a capture with dark counts, which it subtracts from sums of frames."""
    dark = np.random.default_rng(9).random(frames.shape) < lit_probability(_DARK_RATE)
    return replace(capture_of(MemorySource(frames | dark)), steps=(_without_dark_counts,))


def _without_dark_counts(counts: Counts, n_frames: int) -> FluxImage:
    return np.asarray(n_frames - (n_frames - counts.astype(np.float32)) * np.exp(_DARK_RATE), np.float32)


def lit_probability(flux: FloatArray | np.float64) -> FloatArray:
    """Return the probability that a binary pixel is lit (paper, equation 2)."""
    return np.asarray(-np.expm1(-flux))


def _to_scene(frame: float) -> Homography:
    """Return where the moving camera looks, which pans by 0.1 px and rolls by 0.02 degrees per frame."""
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


def panorama(in_colour: bool = False, nothing_seen: bool = False) -> StoredPanorama:
    """Return flux over 120 dB, with unseen and saturated pixels."""
    shape = (*PANORAMA_SHAPE, 3) if in_colour else PANORAMA_SHAPE
    flux = (10 ** np.random.default_rng(0).uniform(-5, 1, shape)).astype(np.float32)
    weight = np.full(shape, 100_000, np.float32)
    flux[:5, :7], weight[:5, :7] = np.nan, 0
    flux[-1] = np.log(200_001)
    if nothing_seen:
        flux[:], weight[:] = np.nan, 0
    response = BinaryResponse()
    return StoredPanorama(
        flux=flux,
        weight=weight,
        std=flux_std(flux, weight, response),
        canvas=np.eye(3),
        white_flux=1.0,
        noise=CanvasNoise(response=response),
    )


class ExporterConformance(StageConformance):
    """Checks of an exporter."""

    kind: ClassVar[str] = "exporter"

    contribution: ExporterContribution

    def exported(self, of: StoredPanorama, folder: Path) -> Mapping[str, FileContent]:
        """Write a panorama as a run does, and return the hashes of its files."""
        self.require_libraries()
        folder.mkdir()
        with passing("what export() does"):
            AttributedExporter(self.built(), f"exporter {self.contribution.name!r}", self.contribution.suffix).export(
                of, folder
            )
        return contents_of(folder)

    @pytest.mark.parametrize("in_colour", [False, True])
    def test_export_writes_one_file_or_folder_with_content(self, tmp_path: Path, in_colour: bool) -> None:
        """Panoramas are grey, or have red, green and blue; some pixels were not seen."""
        self.exported(panorama(in_colour), tmp_path / "run")

    def test_export_accepts_panorama_of_which_nothing_is_known(self, tmp_path: Path) -> None:
        """A part of the canvas may not have been seen."""
        self.exported(panorama(nothing_seen=True), tmp_path / "run")

    def test_export_is_deterministic(self, tmp_path: Path) -> None:
        """The same panorama gives the same bytes, so that a run can be repeated."""
        first, second = (self.exported(panorama(), tmp_path / name) for name in ("first", "second"))
        assert first == second, "export() writes other bytes for the same panorama; leave out times and names of files"
