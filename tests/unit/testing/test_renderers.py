from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, LinearlyCorrectedSource
from photonpano.geometry import Canvas, rescaling, translation
from photonpano.merging import MergeRenderer
from photonpano.testing import KnownMotion, MemorySource, RendererConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.stages import StageConformance


class Honest:
    """The renderer of photonpano, for others to break."""

    def __init__(self, context):
        self.threads = context.threads
        self.renderer = MergeRenderer(context.in_order)

    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        return self.renderer.render(source, trajectory, span, canvas, tolerance_px, advance)


def changed(change):
    """Return a renderer that changes what an honest one returns."""

    def render(self, *given):
        return change(Honest.render(self, *given))

    return type("Broken", (Honest,), {"render": render})


def given(change):
    """Return a renderer that changes what an honest one is given: source, trajectory, span, canvas."""

    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        return Honest.render(self, *change(source, trajectory, span, canvas), tolerance_px, advance)

    return type("Broken", (Honest,), {"render": render})


def all_frames(source, trajectory, span, canvas):
    return source, trajectory, source.info.span, canvas


def without_mask(source, trajectory, span, canvas):
    return MemorySource(source.frames(source.info.span)), trajectory, span, canvas


def uncorrected(source, trajectory, span, canvas):
    return MemorySource(source.frames(source.info.span), source.valid), trajectory, span, canvas


def half_a_pixel_off(source, trajectory, span, canvas):
    return source, trajectory, span, replace(canvas, transform=translation(0.5, 0.5) @ canvas.transform)


class OneScale(Honest):
    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        canvas = Canvas(50, 70, canvas.transform)
        return super().render(source, trajectory, span, canvas, tolerance_px, advance)


class Still(Honest):
    """Sums the frames where the middle one lies."""

    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        middle = trajectory.at([span.centre])[0]
        still = KnownMotion(lambda _: middle)
        return super().render(source, still, span, canvas, tolerance_px, advance)


class PerPixelOfTheCanvas(Honest):
    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        panorama = super().render(source, trajectory, span, canvas, tolerance_px, advance)
        return replace(panorama, flux=panorama.flux / np.float32(canvas.transform[0, 0] ** 2))


class Everywhere(Honest):
    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        panorama = super().render(source, trajectory, span, canvas, tolerance_px, advance)
        return replace(panorama, flux=np.nan_to_num(panorama.flux), weight=np.maximum(panorama.weight, 1))


class Stretched(Honest):
    """Makes the flux brighter from left to right."""

    def render(self, *given):
        panorama = super().render(*given)
        return replace(panorama, flux=panorama.flux * np.linspace(1, 1.2, panorama.flux.shape[1], dtype=np.float32))


class RefusesDarkCounts(Honest):
    def render(self, source, *given):
        if isinstance(source, LinearlyCorrectedSource):
            raise InputError("no")
        return super().render(source, *given)


class Silent(Honest):
    def render(self, source, trajectory, span, canvas, tolerance_px, advance):
        return super().render(source, trajectory, span, canvas, tolerance_px, lambda _: None)


class CleansTheMask(Honest):
    def render(self, source, *given):
        source.valid[0, 0] = not source.valid[0, 0]
        return super().render(source, *given)


class WritesToCounts(Honest):
    def render(self, source, *given):
        source.counts(FrameSpan(0, 3))[0, 0] = 0
        return super().render(source, *given)


class DependsOnThreads(Honest):
    def render(self, *given):
        panorama = super().render(*given)
        return replace(panorama, flux=panorama.flux * np.float32(1 + 1e-6 * self.threads))


BROKEN = [
    ("test_panorama_has_shape_and_transform_of_canvas", OneScale, r"flux must have the shape of the canvas, .* got \(50, 70\)"),
    ("test_panorama_has_shape_and_transform_of_canvas", changed(lambda found: found.flux), "must return a Panorama, got a nd"),
    (
        "test_panorama_passes_the_checks_of_a_run",
        changed(lambda found: replace(found, flux=np.nan_to_num(found.flux))),
        "a run refuses the panorama of scale 0.5: flux is finite where weight is positive, and NaN where weight is 0; at row",
    ),
    (
        "test_panorama_passes_the_checks_of_a_run",
        changed(lambda found: replace(found, canvas=rescaling(3))),
        "a run refuses the panorama of scale 0.5: the canvas of the panorama is the transform of the given canvas",
    ),
    ("test_unseen_pixels_are_unknown", Everywhere, "must have weight 0 and flux NaN; beside the frames it is 1"),
    ("test_flux_depends_on_frames_of_span_only", given(all_frames), "frames 20 to 219 must not depend on other frames"),
    ("test_masked_pixels_have_no_influence", given(without_mask), "masked pixels must have no influence"),
    ("test_panorama_shows_scene_in_its_place", Still, r"the panorama must be sharp; at scale 0.5 its contrast is"),
    (
        "test_panorama_shows_scene_in_its_place",
        given(half_a_pixel_off),
        r"at scale 0.5 it is displaced by 1\.\d+ px",
    ),
    ("test_flux_does_not_depend_on_scale", PerPixelOfTheCanvas, "at scale 0.5 the mean count is"),
    ("test_dark_counts_are_subtracted_or_source_is_refused", given(uncorrected), r"the mean count is 0.\d+, not 0.\d+"),
    ("test_progress_adds_up_to_the_frames", Silent, r"must be called with 200 frames in all, got 0"),
    ("test_tiles_fit_together", Stretched, "must not depend on its tile; pixels of the right half differ by"),
    ("test_render_leaves_inputs_unchanged", CleansTheMask, "modifies source.valid"),
    ("test_render_leaves_inputs_unchanged", WritesToCounts, "fails with read-only arrays"),
    ("test_render_is_deterministic", DependsOnThreads, "with 4 threads the panorama differs"),
]


@pytest.mark.parametrize(("check", "broken", "words"), BROKEN)
def test_check_fails_on_broken_component(check, broken, words, catches):
    catches(RendererConformance, check, broken, words)


def test_every_check_has_a_broken_component(checks_of):
    assert checks_of(RendererConformance, StageConformance) == {check for check, *_ in BROKEN}


def test_checks_pass_on_correct_component(checks_of, failure):
    for check in checks_of(RendererConformance, Conformance):
        assert failure(RendererConformance, check, Honest) is None, check


def test_renderer_that_refuses_dark_counts_passes(failure):
    assert failure(RendererConformance, "test_dark_counts_are_subtracted_or_source_is_refused", RefusesDarkCounts) is None
