"""Mergers and renderers that keep their contract and break another promise: the check of the kit that finds each."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from photonpano import FrameSpan, InputError, discover
from photonpano.geometry import Canvas, inverse, translation
from photonpano.merging import MergeRenderer
from photonpano.testing import KnownMotion, MemorySource

from .strange import Around, around, given

Build: TypeAlias = Callable[[Any], Any]
Table: TypeAlias = Mapping[str, Build]  # by the check that finds each, and behind a comma what is broken
PHOTON_MLE = discover().find("merger", "photon-mle").contribution


def merger(context: Any) -> Any:
    return PHOTON_MLE.build(PHOTON_MLE.config(tolerance_px=0.5), context)


def renderer(context: Any) -> Any:
    return MergeRenderer(context.in_order)


def merges(change: Callable[..., Any]) -> Build:
    """Build a merger whose exposures are what `change` makes of good ones and of the arguments."""
    return lambda context: around("merge", change)(merger(context))


def merges_given(change: Callable[..., tuple[Any, ...]]) -> Build:
    """Build a merger that gets other arguments."""
    return lambda context: given("merge", change)(merger(context))


def renders(change: Callable[..., Any]) -> Build:
    """Build a renderer whose panoramas are what `change` makes of good ones and of the arguments."""
    return lambda context: around("render", change)(renderer(context))


def renders_given(change: Callable[..., tuple[Any, ...]]) -> Build:
    """Build a renderer that gets another source, trajectory, span and canvas."""
    return lambda context: given("render", lambda *all_: (*change(*all_[:4]), *all_[4:]))(renderer(context))


def flux_times(factor: Any) -> Callable[..., Any]:
    """Return a change of an exposure or a panorama: its flux is multiplied with `factor(found, ...)`."""
    return lambda found, *all_: replace(found, flux=found.flux * np.float32(factor(found, *all_)))


class Unmasked:
    def __init__(self, source: Any) -> None:
        self.source, self.valid = source, np.ones_like(source.valid)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


def uncorrected(source: Any) -> MemorySource:
    """Return the frames of a source, whose dark counts stay in."""
    return MemorySource(source.frames(source.info.span), source.valid)


def refusing_dark_counts(source: Any, *rest: Any) -> tuple[Any, ...]:
    if source.corrects_sums:
        raise InputError("no")
    return source, *rest


def average_of_logarithms(found: Any, source: Any, group: Any, *_: Any) -> Any:
    """Estimate the flux of ten frames at a time: the logarithm of an average is not the average of logarithms."""
    frames = source.frames(group.span).reshape(-1, 10, *source.info.frame_shape)
    return replace(
        found, flux=np.mean([source.response.flux(ten.mean(axis=0, dtype=np.float32), 10) for ten in frames], axis=0)
    )


def every_other_frame(found: Any, source: Any, group: Any, *_: Any) -> Any:
    counts = source.frames(group.span)[::2].mean(axis=0, dtype=np.float32)
    return replace(found, flux=source.response.flux(counts, 100))


def half_a_pixel_off(source: Any, group: Any, trajectory: Any, scale: float) -> tuple[Any, ...]:
    def at(frame: float) -> np.ndarray:
        return trajectory.at([frame])[0] @ (np.eye(3) if frame == group.reference else translation(0.5, 0.5))

    return source, group, trajectory and KnownMotion(at), scale


def backwards(source: Any, group: Any, trajectory: Any, scale: float) -> tuple[Any, ...]:
    return source, group, trajectory and KnownMotion(lambda frame: inverse(trajectory.at([frame])[0])), scale


def all_frames_of_the_capture(context: Any) -> Any:
    inner = merger(context)
    flux_of_all = lambda source, group, *rest: inner.merge(source, replace(group, span=source.info.span), *rest).flux  # noqa: E731
    return around("merge", lambda found, *all_: replace(found, flux=flux_of_all(*all_)))(inner)


def seen_from_the_plane(found: Any, source: Any, group: Any, trajectory: Any, scale: float) -> Any:
    """Shift the image with the reference plane."""
    turn = 0 if trajectory is None else int(trajectory.at([group.reference])[0, 0, 2]) // 1000
    return replace(found, flux=np.roll(found.flux, turn, axis=1))


def clearing_the_mask(source: Any, *rest: Any) -> tuple[Any, ...]:
    source.valid[0, 0] = not source.valid[0, 0]
    return source, *rest


def writing_to_counts(source: Any, *rest: Any) -> tuple[Any, ...]:
    source.counts(FrameSpan(0, 3))[0, 0] = 0
    return source, *rest


def depends_on_threads(build: Build, method: str) -> Build:
    return lambda context: around(method, flux_times(lambda *_: 1 + 1e-6 * context.threads))(build(context))


def still(source: Any, trajectory: Any, span: FrameSpan, canvas: Canvas) -> tuple[Any, ...]:
    """Sum the frames where the middle one lies."""
    middle = trajectory.at([span.centre])[0]
    return source, KnownMotion(lambda _: middle), span, canvas


def beside(source: Any, trajectory: Any, span: FrameSpan, canvas: Canvas) -> tuple[Any, ...]:
    return source, trajectory, span, replace(canvas, transform=translation(0.5, 0.5) @ canvas.transform)


MERGERS: Table = {
    "merger_works_in_other_processes": lambda context: Around(merger(context), gain=lambda flux: flux),
    "weight_is_number_of_frames": merges(lambda found, *_: replace(found, weight=found.weight / found.weight.max())),
    "flux_depends_on_frames_of_group_only": all_frames_of_the_capture,
    "flux_is_unbiased_on_photon_noise": merges(average_of_logarithms),
    "flux_has_no_more_than_photon_noise": merges(every_other_frame),
    "dark_counts_are_subtracted_or_source_is_refused": merges_given(lambda source, *rest: (uncorrected(source), *rest)),
    "masked_pixels_have_no_influence": merges_given(lambda source, *rest: (Unmasked(source), *rest)),
    "masked_pixels_have_no_influence_along_motion": merges_given(
        lambda source, group, motion, scale: (Unmasked(source) if motion else source, group, motion, scale)
    ),
    "merge_compensates_known_motion, as if still": merges_given(lambda source, group, _, scale: (source, group, None, scale)),
    "merge_compensates_known_motion, backwards": merges_given(backwards),
    "merge_compensates_known_motion, half a pixel off": merges_given(half_a_pixel_off),
    "exposure_does_not_depend_on_reference_plane": merges(seen_from_the_plane),
    "flux_does_not_depend_on_scale": merges(flux_times(lambda found, *_: found.scale**-2)),
    "merge_leaves_inputs_unchanged, mask": merges_given(clearing_the_mask),
    "merge_leaves_inputs_unchanged, counts": merges_given(writing_to_counts),
    "merge_is_deterministic": depends_on_threads(merger, "merge"),
}
RENDERERS: Table = {
    "unseen_pixels_are_unknown": renders(
        lambda found, *_: replace(found, flux=np.nan_to_num(found.flux), weight=np.maximum(found.weight, 1))
    ),
    "flux_depends_on_frames_of_span_only": renders_given(
        lambda source, trajectory, _, canvas: (source, trajectory, source.info.span, canvas)
    ),
    "masked_pixels_have_no_influence": renders_given(lambda source, *rest: (Unmasked(source), *rest)),
    "panorama_shows_scene_in_its_place, still": renders_given(still),
    "panorama_shows_scene_in_its_place, beside": renders_given(beside),
    "flux_does_not_depend_on_scale": renders(flux_times(lambda found, *_: found.canvas[0, 0] ** -2)),
    "dark_counts_are_subtracted_or_source_is_refused": renders_given(lambda source, *rest: (uncorrected(source), *rest)),
    "progress_adds_up_to_the_frames": lambda context: given("render", lambda *all_: (*all_[:-1], lambda _: None))(
        renderer(context)
    ),
    "tiles_fit_together": renders(flux_times(lambda found, *_: np.linspace(1, 1.2, found.flux.shape[1]))),
    "render_leaves_inputs_unchanged, mask": renders_given(clearing_the_mask),
    "render_leaves_inputs_unchanged, counts": renders_given(writing_to_counts),
    "render_is_deterministic": depends_on_threads(renderer, "render"),
}
