"""Checks of renderers, along the known motion of a small capture."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import ClassVar

import numpy as np
import pytest

from photonpano.contracts.protocols import Source
from photonpano.contracts.results import PANORAMA
from photonpano.errors import InputError
from photonpano.geometry import Canvas, canvas_of, inverse, translation
from photonpano.photometry import BinaryResponse
from photonpano.plugins.contributions import RendererContribution
from photonpano.testing.captures import MemorySource, ReadOnlySource
from photonpano.testing.conformance import must_not_raise
from photonpano.testing.mergers import (
    MOTION,
    SCENE,
    SHAPE,
    dark_source,
    dead_pixels,
    displacement_and_contrast,
    lit_probability,
    moving_frames,
)
from photonpano.testing.sameness import fingerprint
from photonpano.testing.stages import Answer, AnswerConformance, accepts_read_only
from photonpano.values import FloatArray, FrameSpan, Group, Panorama, VirtualExposure

SPAN = FrameSpan(20, 220)  # the frames that are rendered
TOLERANCE_PX = 0.25
_SEEN = 20  # frames that a pixel was seen in if it is compared with the scene


@cache
def canvas_at(scale: float) -> Canvas:
    """Return a canvas that holds all frames of the span; its corners are not seen."""
    return canvas_of(MOTION.at(np.arange(SPAN.start, SPAN.stop)), SHAPE, scale)


def true_flux(canvas: Canvas) -> FloatArray:
    """Return the flux of the scene at the pixels of a canvas."""
    return SCENE.view(inverse(canvas.transform), canvas.shape)


class RendererConformance(AnswerConformance):
    """Checks of a renderer on binary frames of 40x56 px of a camera that pans and rolls, of which 200 are rendered.

    Attributes:
        tolerance_px: largest displacement of the panorama.
        scales: supported scales, pixels of the canvas per pixel of a frame.
        tile_tolerance: largest difference of 19 of 20 pixels of a tile from the same ones of the canvas, as a share of the mean
            flux.
    """

    kind: ClassVar[str] = "renderer"
    contracts = (PANORAMA,)

    contribution: RendererContribution
    tolerance_px: float = 0.1
    scales: tuple[float, ...] = (0.5, 1.0, 2.0)
    tile_tolerance: float = 1e-3

    def rendered(self, source: Source, canvas: Canvas | None = None, span: FrameSpan = SPAN, threads: int = 1) -> Panorama:
        """Render with a new renderer, on a canvas of scale 1 by default."""
        renderer = self.built(source.info, threads)
        panorama: Panorama = must_not_raise(
            "render()", renderer.render, source, MOTION, span, canvas or canvas_at(1.0), TOLERANCE_PX, lambda _: None
        )
        return panorama

    def answers(self) -> Iterator[Answer]:
        """Yield panoramas of all scales."""
        source = MemorySource(moving_frames(), dead_pixels())
        for scale in self.scales:
            canvas = canvas_at(scale)
            yield f"the panorama of scale {scale:g}, one of `scales`", PANORAMA, self.rendered(source, canvas), canvas

    def test_unseen_pixels_are_unknown(self) -> None:
        """A canvas may be larger than what the frames show, or lie beside it."""
        source = MemorySource(moving_frames())
        beside = Canvas(30, 40, translation(3000, 0))
        weight = float(self.rendered(source, beside).weight.max())
        assert weight == 0, f"a pixel that no frame shows must have weight 0 and flux NaN; beside the frames it is {weight:g}"

    def test_flux_depends_on_frames_of_span_only(self) -> None:
        """Frames before and after it have no influence."""
        changed = moving_frames().copy()
        changed[: SPAN.start] = 1
        changed[SPAN.stop :] = 0
        here, there = (self.rendered(MemorySource(frames)).flux for frames in (moving_frames(), changed))
        assert np.array_equal(here, there, equal_nan=True), (
            f"the panorama of {SPAN} must not depend on other frames; it changes with frames before or after them"
        )

    def test_masked_pixels_have_no_influence(self) -> None:
        """Other pixels saw the same places, and a hot pixel would leave a trail."""
        valid = dead_pixels()
        hot, dark = (self.rendered(MemorySource(np.where(valid, moving_frames(), lit), valid)) for lit in (1, 0))
        same = np.array_equal(hot.flux, dark.flux, equal_nan=True)
        assert same, "masked pixels must have no influence; the flux changes with their counts, see source.valid"

    def test_panorama_shows_scene_in_its_place(self) -> None:
        """It is as sharp as a frame, at each scale."""
        source = MemorySource(moving_frames())
        for scale in self.scales:
            canvas = canvas_at(scale)
            panorama = self.rendered(source, canvas)
            flux = np.where(panorama.weight >= _SEEN, panorama.flux, np.float32(np.nan))
            seen = VirtualExposure(flux, panorama.weight, Group(SPAN, SPAN.centre), scale, source.response)
            shift, contrast = displacement_and_contrast(seen, lit_probability(true_flux(canvas)))
            assert contrast > 0.7, (
                f"along the motion the panorama must be sharp; at scale {scale:g} its contrast is {contrast:.0%} of that of "
                "the scene. A pixel p of frame t lies at canvas.transform @ trajectory.at(t) @ p"
            )
            far = float(np.hypot(*shift)) / scale
            assert far <= self.tolerance_px, (
                f"the panorama must show the scene in its place; at scale {scale:g} it is displaced by {far:.2f} px of a "
                f"frame, more than tolerance_px = {self.tolerance_px:g}"
            )

    def test_flux_does_not_depend_on_scale(self) -> None:
        """Flux is photons per pixel of a frame, whatever the canvas."""
        source, response = MemorySource(moving_frames()), BinaryResponse()
        for scale in self.scales:
            canvas = canvas_at(scale)
            panorama = self.rendered(source, canvas)
            seen = panorama.weight >= _SEEN
            mean = float(response.mean_count(panorama.flux)[seen].mean())
            known = float(lit_probability(true_flux(canvas))[seen].mean())
            assert abs(mean / known - 1) < 0.02, (
                f"flux must be that of a pixel of a frame; at scale {scale:g} the mean count is {mean:.4f}, not {known:.4f}"
            )

    def test_dark_counts_are_subtracted_or_source_is_refused(self) -> None:
        """A renderer that cannot subtract dark counts raises an InputError."""
        source, canvas = dark_source(moving_frames()), canvas_at(1.0)
        try:
            panorama = self.built(source.info).render(source, MOTION, SPAN, canvas, TOLERANCE_PX, lambda _: None)
        except InputError:
            return
        seen = panorama.weight >= _SEEN
        mean = float(source.response.mean_count(panorama.flux)[seen].mean())
        known = float(lit_probability(true_flux(canvas))[seen].mean())
        assert abs(mean / known - 1) < 0.03, (
            f"dark counts, which source.corrected subtracts, must not be part of the flux; the mean count is {mean:.4f}, "
            f"not {known:.4f}"
        )

    def test_progress_adds_up_to_the_frames(self) -> None:
        """`advance` is called with the numbers of frames that are done."""
        source, done = MemorySource(moving_frames()), list[int]()
        for canvas in (canvas_at(1.0), Canvas(30, 40, translation(3000, 0))):
            done.clear()
            self.built(source.info).render(source, MOTION, SPAN, canvas, TOLERANCE_PX, done.append)
            assert sum(done) == len(SPAN), f"advance() must be called with {len(SPAN)} frames in all, got {sum(done)}"

    def test_tiles_fit_together(self) -> None:
        """What a pixel shows does not depend on the tile that it lies in."""
        source, canvas = MemorySource(moving_frames()), canvas_at(1.0)
        whole = self.rendered(source, canvas)
        left = canvas.width // 2
        tile = self.rendered(source, Canvas(canvas.height, canvas.width - left, translation(-left, 0) @ canvas.transform))
        seen = (whole.weight[:, left:] >= _SEEN) & (tile.weight >= _SEEN)
        expected = whole.flux[:, left:][seen]
        far = float(np.quantile(np.abs(tile.flux[seen] - expected), 0.95) / np.mean(expected))
        assert far <= self.tile_tolerance, (
            f"a pixel must not depend on its tile; pixels of the right half differ by {far:.2g} of the mean flux from those of "
            f"the whole canvas, more than tile_tolerance = {self.tile_tolerance:g}. Render a margin around the tile, "
            "and cut it off"
        )

    def test_render_leaves_inputs_unchanged(self) -> None:
        """Counts and masks are shared between threads."""
        source = MemorySource(moving_frames(), dead_pixels())
        self.rendered(source)
        same = np.array_equal(source.valid, dead_pixels())
        assert same, "render() modifies source.valid; copy it before you change it"
        with accepts_read_only("render()"):
            read_only = ReadOnlySource(moving_frames(), dead_pixels())
            self.built(read_only.info).render(read_only, MOTION, SPAN, canvas_at(1.0), TOLERANCE_PX, lambda _: None)

    @pytest.mark.parametrize("threads", [1, 4])
    def test_render_is_deterministic(self, threads: int) -> None:
        """The same frames give the same bytes, whatever the number of threads."""
        source = MemorySource(moving_frames(), dead_pixels())
        first, second = (fingerprint(self.rendered(source, threads=each)) for each in (1, threads))
        assert first == second, f"the same frames must give the same bytes; with {threads} threads the panorama differs"
