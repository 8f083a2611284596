"""Each check of the kit fails on a component that breaks it, and passes on a good one."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import pytest
from pydantic import BaseModel, Field, field_serializer

from photonpano import (
    Arrived,
    Config,
    FrameSpan,
    Group,
    InputError,
    Located,
    LocationError,
    NotLocated,
    Refined,
    discover,
    testing,
)
from photonpano.geometry import from_parameters, inverse, normalised, parameters, step_motions, translation
from photonpano.merging import MergeRenderer
from photonpano.testing import KnownMotion, MemorySource, SourceConformance
from photonpano.testing.conformance import Conformance
from photonpano.testing.motions import REFERENCE, SHAPE
from photonpano_poses.testing import PoseEstimatorConformance, capture

from .conftest import known_path
from .strange import Around, around, given, instead

Build: TypeAlias = Callable[[Any], Any]
PHOTON_MLE = discover().find("merger", "photon-mle").contribution
DIRECT = discover().find("locator", "direct").contribution
FRAMES = SourceConformance().known_frames()


def merger(context: Any) -> Any:
    return PHOTON_MLE.build(PHOTON_MLE.config(tolerance_px=0.5), context)


def locator(context: Any) -> Any:
    return DIRECT.build(DIRECT.config(), context)


def renderer(context: Any) -> Any:
    return MergeRenderer(context.in_order)


class Hundreds:
    """A resampler: groups of 100 frames, one after the other."""

    def __init__(self, _: Any = None) -> None:
        self.calls = itertools.count()

    def groups(self, n_frames: int, level: int) -> Any:
        if n_frames < 100:
            raise InputError(f"{n_frames} frames are too few")
        spans = (FrameSpan(start, start + 100) for start in range(0, n_frames - 99, 100))
        return tuple(Group(span, span.centre) for span in spans)


class Straight:
    """An interpolator, and its trajectory: straight lines of p1..p8, and a camera that stands still beyond the knots."""

    def __init__(self, _: Any = None) -> None:
        pass

    def fit(self, instants: np.ndarray, homographies: np.ndarray, information: Any) -> Straight:
        fitted = type(self)()
        fitted.instants, fitted.p = instants.copy(), parameters(homographies)
        return fitted

    def at(self, frame_indices: Any) -> np.ndarray:
        frames = np.asarray(frame_indices, dtype=float)
        return from_parameters(np.stack([np.interp(frames, self.instants, p) for p in self.p.T], axis=-1))


class Nearest(Straight):
    def at(self, frame_indices: Any) -> np.ndarray:
        distances = np.abs(np.asarray(frame_indices, dtype=float)[:, None] - self.instants)
        return from_parameters(self.p[distances.argmin(axis=1)])


class Steps:
    """A refiner that applies the steps, if they are more than photon noise: line by line between the centres of the spans."""

    def __init__(self, _: Any = None, least_ratio: float = 2, sign: int = 1) -> None:
        self.least_ratio, self.sign = least_ratio, sign

    def refine(self, source: Any, trajectory: Any, std_px: np.ndarray, residuals: Any, view: Any) -> Refined | None:
        squares = np.einsum("si,sij,sj->s", residuals.steps, residuals.information, residuals.steps)
        if squares.mean() / 4 < self.least_ratio:
            return None
        frames, centres = np.arange(len(std_px)), [span.centre for span in residuals.spans]
        steps = np.stack([np.interp(frames, centres, self.sign * step) for step in residuals.steps.T], axis=1)
        moved = trajectory.at(frames) @ step_motions(steps, SHAPE)
        return Refined(normalised(inverse(moved[REFERENCE]) @ moved), std_px.copy(), "a tremor")


class Honest(MemorySource):
    def __init__(self, _: Any = None) -> None:
        super().__init__(FRAMES.copy())
        self.buffer = np.zeros(self.info.frame_shape, np.uint32)


def turning_refused(source: Any, *rest: Any) -> tuple[Any, ...]:
    if source is capture(False):
        raise LocationError("it only turns")
    return source, *rest


GOOD: Mapping[Any, Build] = {
    testing.SourceConformance: Honest,
    testing.ResamplerConformance: Hundreds,
    testing.MergerConformance: merger,
    testing.LocatorConformance: locator,
    testing.InterpolatorConformance: Straight,
    testing.RefinerConformance: Steps,
    testing.RendererConformance: renderer,
    PoseEstimatorConformance: lambda context: given("estimate", turning_refused)(known_path(context)),
}


class Unmasked:
    def __init__(self, source: Any) -> None:
        self.source, self.valid = source, np.ones_like(source.valid)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


def after(kit: Any, method: str, change: Callable[..., Any]) -> Build:
    """Build a component whose method returns what `change` makes of a good answer and of the arguments."""
    return lambda context: around(method, change)(GOOD[kit](context))


def before(kit: Any, method: str, change: Callable[..., tuple[Any, ...]]) -> Build:
    """Build a component whose method gets what `change` makes of the arguments."""
    return lambda context: given(method, change)(GOOD[kit](context))


def merges(change: Callable[..., Any]) -> Build:
    return after(testing.MergerConformance, "merge", change)


def merges_given(change: Callable[..., tuple[Any, ...]]) -> Build:
    return before(testing.MergerConformance, "merge", change)


def renders(change: Callable[..., Any]) -> Build:
    return after(testing.RendererConformance, "render", change)


def renders_given(change: Callable[..., tuple[Any, ...]]) -> Build:
    return before(testing.RendererConformance, "render", change)


def locates(change: Callable[[Located], Any]) -> Build:
    """Build a locator whose located motions are what `change` makes of good ones."""
    return after(testing.LocatorConformance, "register", lambda it, *_: change(it) if isinstance(it, Located) else it)


def refines(change: Callable[..., Any]) -> Build:
    return after(testing.RefinerConformance, "refine", lambda found, *all_: found and change(found, *all_))


def at_given(change: Callable[[np.ndarray], Any]) -> Build:
    """Build an interpolator whose trajectories are asked at other instants."""
    change_at = given("at", lambda frames: (change(np.asarray(frames, dtype=float)),))
    return after(testing.InterpolatorConformance, "fit", lambda found, *_: change_at(found))


def estimates(change: Callable[[Any], dict[str, Any]]) -> Build:
    return after(PoseEstimatorConformance, "estimate", lambda it, *_: replace(it, **change(it)))


def reads(method: str, answer: Callable[[Any, FrameSpan], Any]) -> Build:
    """Build a source with another method of reading a span."""
    return type("Toy", (Honest,), {method: answer})


def flux_times(factor: Any) -> Callable[..., Any]:
    """Return a change of an exposure or a panorama: its flux is multiplied with `factor(found, ...)`."""
    return lambda found, *all_: replace(found, flux=found.flux * np.float32(factor(found, *all_)))


def half_a_pixel_off(source: Any, group: Any, trajectory: Any, scale: float) -> tuple[Any, ...]:
    def at(frame: float) -> np.ndarray:
        return trajectory.at([frame])[0] @ (np.eye(3) if frame == group.reference else translation(0.5, 0.5))

    return source, group, trajectory and KnownMotion(at), scale


def every_other_frame(found: Any, source: Any, group: Any, *_: Any) -> Any:
    return replace(found, flux=source.response.flux(source.frames(group.span)[::2].mean(axis=0, dtype=np.float32), 100))


def seen_from_the_plane(found: Any, source: Any, group: Any, trajectory: Any, scale: float) -> Any:
    turn = 0 if trajectory is None else int(trajectory.at([group.reference])[0, 0, 2]) // 1000
    return replace(found, flux=np.roll(found.flux, turn, axis=1))


def without_masks(source: Any, *rest: Any) -> tuple[Any, ...]:
    return Unmasked(source), *rest


def uncorrected(source: Any, *rest: Any) -> tuple[Any, ...]:
    """Return the frames of a source, whose dark counts stay in."""
    return MemorySource(source.frames(source.info.span), source.valid), *rest


def pulled_by_holes(context: Any) -> Any:
    """See holes as black: they stand still in both images, and pull the motion towards none."""
    inner = locator(context)

    def register(moving: Any, fixed: Any, initial: Any) -> Any:
        found = inner.register(moving[0], fixed[0], initial)
        if not isinstance(found, Located):
            return found
        homography = found.homography.copy()
        homography[:2, 2] *= 1 - moving[1]
        return replace(found, homography=homography)

    return Around(inner, describe=lambda it: (inner.describe(it), np.mean(it.weight == 0)), register=register)


def keeping_the_exposure(context: Any) -> Any:
    inner = locator(context)
    changed = given("register", lambda moving, fixed, initial: (inner.describe(moving), inner.describe(fixed), initial))(inner)
    return instead("describe", lambda exposure: exposure)(changed)


def require_large(exposure: Any) -> tuple[Any, ...]:
    if exposure.flux.shape[0] < 64:
        raise RuntimeError("the pyramid has no level")
    return (exposure,)


def jittered(found: Located) -> Located:
    jitter = 1e-9 * np.random.get_bit_generator().random_raw() / 2**32  # the fault
    return replace(found, homography=found.homography @ translation(jitter, 0))


def inverted(found: Any, *_: Any) -> Any:
    return replace(found, homography=inverse(found.homography)) if isinstance(found, Located) else found


def needs_two_spans(source: Any, trajectory: Any, std_px: Any, residuals: Any, view: Any) -> tuple[Any, ...]:
    np.gradient(residuals.steps, axis=0, edge_order=2)
    return source, trajectory, std_px, residuals, view


def inverts_information(source: Any, trajectory: Any, std_px: Any, residuals: Any, view: Any) -> tuple[Any, ...]:
    np.linalg.inv(residuals.information)
    return source, trajectory, std_px, residuals, view


def in_one_buffer(self: Any, span: FrameSpan) -> Any:
    self.buffer[:] = Honest.counts(self, span)
    return self.buffer


def at_a_shared_position(self: Any, span: FrameSpan) -> Any:
    self.position = span.start
    time.sleep(2e-3)
    return Honest.frames(self, FrameSpan(self.position, self.position + len(span)))


def left_to_chance(self: Any, span: FrameSpan) -> Any:
    chosen = np.random.Generator(np.random.get_bit_generator()).random(self.info.frame_shape) > 0.5  # the fault
    return Honest.frames(self, span) ^ chosen


class Forgetful(Hundreds):
    def groups(self, n_frames: int, level: int) -> Any:
        return super().groups(n_frames, level)[: -1 if next(self.calls) else None]


NUMBERS = itertools.count()
STANDING_STILL: Build = after(
    testing.LocatorConformance, "register", lambda it, *_: Located(np.eye(3)) if isinstance(it, NotLocated) else it
)
# For each class of the kit, the component that each of its checks finds.
BROKEN: Mapping[Any, Mapping[str, Build]] = {
    testing.SourceConformance: {
        "source_passes_the_checks_of_a_run": reads("counts", lambda self, span: Honest.counts(self, span) * 2),
        "counts_equal_sum_of_frames": reads("counts", lambda self, span: Honest.counts(self, span) // 2),
        "packed_equals_packbits_of_frames": reads(
            "packed", lambda self, span: np.packbits(self.frames(span), axis=-1, bitorder="little")
        ),
        "frame_is_the_same_in_any_span": reads("frames", lambda self, span: Honest.frames(self, span)[::-1]),
        "frames_equal_written_frames": reads("frames", lambda self, span: Honest.frames(self, span)[:, ::-1]),
        "arrived_frames_are_those_of_the_capture": Honest,
        "span_beyond_capture_raises_input_error": reads(
            "counts", lambda self, span: self._frames[span.start : span.stop].sum(axis=0, dtype=np.uint32)
        ),
        "returned_arrays_belong_to_caller": reads("counts", in_one_buffer),
        "threads_read_the_same_frames": reads("frames", at_a_shared_position),
        "reopened_source_gives_same_bytes": reads("frames", left_to_chance),
        "with_block_propagates_errors": type("Toy", (Honest,), {"__exit__": lambda *_: True}),
        "check_accepts_config_under_test": Honest,
        "check_rejects_wrong_configs": Honest,
    },
    testing.ResamplerConformance: {
        "groups_depend_on_arguments_only": Forgetful,
        "short_capture_gives_groups_or_input_error": Hundreds,
    },
    testing.MergerConformance: {
        "weight_is_number_of_frames": merges(lambda found, *_: replace(found, weight=found.weight / found.weight.max())),
        "flux_depends_on_frames_of_group_only": merges_given(
            lambda source, group, *rest: (source, replace(group, span=source.info.span), *rest)
        ),
        "flux_is_unbiased_with_photon_noise": merges(every_other_frame),
        "dark_counts_are_subtracted_or_source_is_refused": merges_given(uncorrected),
        "masked_pixels_have_no_influence": merges_given(without_masks),
        "merge_compensates_known_motion": merges_given(half_a_pixel_off),
        "exposure_does_not_depend_on_reference_plane": merges(seen_from_the_plane),
        "flux_does_not_depend_on_scale": merges(flux_times(lambda found, *_: found.scale**-2)),
        "merge_is_deterministic": lambda context: around("merge", flux_times(lambda *_: 1 + 1e-6 * context.threads))(
            merger(context)
        ),
        "merger_works_in_other_processes": lambda context: Around(merger(context), gain=lambda flux: flux),
    },
    testing.LocatorConformance: {
        "register_finds_motion": locates(inverted),
        "unseen_pixels_have_no_influence": pulled_by_holes,
        "image_without_texture_is_not_located": STANDING_STILL,
        "different_places_are_not_located": STANDING_STILL,
        "turning_locates_turns_and_nothing_else": lambda context: around(
            "turning", lambda found, *_: around("register", inverted)(found)
        )(locator(context)),
        "very_small_image_does_not_raise": before(testing.LocatorConformance, "describe", require_large),
        "information_is_inverse_covariance_of_errors": locates(lambda it: replace(it, information=it.information * 1e4)),
        "description_does_not_hold_exposure": keeping_the_exposure,
        "register_is_deterministic": locates(jittered),
    },
    testing.InterpolatorConformance: {
        "trajectory_passes_its_knots": before(
            testing.InterpolatorConformance, "fit", lambda instants, knots, info: (instants, inverse(knots), info)
        ),
        "instants_are_independent_of_each_other": at_given(lambda frames: frames + 0.01 * (frames - frames.mean())),
        "constant_velocity_is_kept_between_knots": Nearest,
        "fit_is_deterministic": at_given(lambda frames: frames + 1e-9 * np.random.default_rng().random()),
    },
    testing.RefinerConformance: {
        "reference_frame_stays_the_identity": refines(
            lambda found, *_: replace(found, homographies=found.homographies[100] @ found.homographies)
        ),
        "photon_noise_is_not_corrected": lambda _: Steps(least_ratio=0),
        "tremor_is_reduced_or_left": lambda _: Steps(sign=-1),
        "few_spans_are_enough": before(testing.RefinerConformance, "refine", needs_two_spans),
        "refine_accepts_spans_without_information": before(testing.RefinerConformance, "refine", inverts_information),
        "refine_is_deterministic": refines(
            lambda found, *_: replace(found, std_px=found.std_px * np.random.default_rng().random())
        ),
    },
    testing.RendererConformance: {
        "flux_depends_on_frames_of_span_only": renders_given(
            lambda source, motion, _, *rest: (source, motion, source.info.span, *rest)
        ),
        "masked_pixels_have_no_influence": renders_given(without_masks),
        "panorama_shows_scene_in_its_place": renders_given(
            lambda *all_: (*all_[:3], replace(all_[3], transform=translation(0.5, 0.5) @ all_[3].transform), *all_[4:])
        ),
        "dark_counts_are_subtracted_or_source_is_refused": renders_given(uncorrected),
        "tiles_fit_together": renders(flux_times(lambda found, *_: np.linspace(1, 1.2, found.flux.shape[1]))),
        "render_is_deterministic": lambda context: around("render", flux_times(lambda *_: 1 + 1e-6 * context.threads))(
            renderer(context)
        ),
    },
    PoseEstimatorConformance: {
        "estimate_finds_the_poses": estimates(lambda it: {"camera_from_world": np.roll(it.camera_from_world, 80, axis=0)}),
        "estimate_is_deterministic": estimates(
            lambda it: {"camera_from_world": it.camera_from_world + next(NUMBERS) * np.eye(3, 4, 3)}
        ),
        "camera_that_only_turns_has_no_poses": known_path,
    },
}
# What else is broken: the contribution, or attributes of the class of the kit.
MORE: Mapping[str, Mapping[str, Any]] = {
    "frames_equal_written_frames": {"write": lambda *_: {}},
    "arrived_frames_are_those_of_the_capture": {"record": {"arrived": lambda _: Arrived(MemorySource(FRAMES[:-1]))}},
    "check_accepts_config_under_test": {"record": {"check": lambda *_: ["there is no file capture.npy"]}},
    "check_rejects_wrong_configs": {"wrong": ({},)},
}
CASES = [(kit, name, build) for kit, builds in BROKEN.items() for name, build in builds.items()]


def checks_of(kit: type, beside: type) -> set[str]:
    """Return the names of the checks of a class of the kit, without those of another class that it inherits from."""
    return {name for name in set(dir(kit)) - set(dir(beside)) if name.startswith("test_")}


@pytest.mark.parametrize(("kit", "name", "build"), CASES, ids=[f"{kit.kind}-{name}" for kit, name, _ in CASES])
def test_check_fails_on_broken_component(fails: Callable[..., bool], kit: Any, name: str, build: Build) -> None:
    assert fails(kit, f"test_{name}", build, **MORE.get(name, {}))


@pytest.mark.parametrize("kit", GOOD)
def test_good_component_passes_and_every_check_has_a_broken_one(fails: Callable[..., bool], kit: Any) -> None:
    record = {"check": lambda _, stream: ["too short"] if stream.n_frames < 100 else []} if kit.kind == "resampler" else {}
    more = {"write": lambda *_: {}} if kit.kind == "source" else {}
    for check in checks_of(kit, Conformance):
        assert not fails(kit, check, GOOD[kit], record, **more), check
    of_all = Conformance if kit.kind == "source" else testing.conformance.AnswerConformance
    assert checks_of(kit, of_all) == {f"test_{name}" for name in BROKEN[kit]}


class Open(BaseModel):
    size: int = Field(3, description="frames")


class WithOpenPart(Config):
    part: Open | None = Field(None, description="what is open")


class WritesUnits(Config):
    size: int = Field(3, description="frames")

    @field_serializer("size")
    def with_unit(self, size: int) -> str:
        return f"{size} frames"


@pytest.mark.parametrize(
    ("check", "build", "more"),
    [
        ("contribution_has_the_kind_of_this_class", Hundreds, {"contribution": DIRECT}),
        ("config_is_closed_and_frozen", Hundreds, {"record": {"config": WithOpenPart}}),
        ("config_survives_json_round_trip", Hundreds, {"record": {"config": WritesUnits}}),
        ("build_reads_no_frames", lambda context: Hundreds(context.capture().flux), {}),
        ("build_reads_no_frames", lambda _: "a text", {}),
        ("check_accepts_config_under_test", Hundreds, {"record": {"check": lambda *_: ["too long"]}}),
        ("answers_keep_the_contract", lambda _: instead("groups", lambda *_: ())(Hundreds()), {}),
    ],
)
def test_check_of_all_kinds_fails(fails: Callable[..., bool], check: str, build: Build, more: dict[str, Any]) -> None:
    assert f"test_{check}" in checks_of(testing.conformance.AnswerConformance, object)
    assert fails(testing.ResamplerConformance, f"test_{check}", build, **more)


@pytest.mark.parametrize(
    ("kit", "check", "build"),
    [
        (testing.MergerConformance, "answers_keep_the_contract", merges_given(lambda it, *_: it.valid.__setitem__((0, 0), 1))),
        (
            testing.LocatorConformance,
            "answers_keep_the_contract",
            before(testing.LocatorConformance, "describe", lambda it: (it.flux.__setitem__((0, 0), 0) or it,)),
        ),
        (
            testing.InterpolatorConformance,
            "answers_keep_the_contract",
            before(testing.InterpolatorConformance, "fit", lambda *all_: all_[0].__imul__(2) is None or all_),
        ),
    ],
)
def test_component_that_changes_its_arguments_is_found(fails: Callable[..., bool], kit: Any, check: str, build: Build) -> None:
    assert fails(kit, f"test_{check}", build)
