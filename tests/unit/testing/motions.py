"""Components that find or refine a motion, keep their contract and break another promise: the check that finds each."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from photonpano import FrameSpan, Group, InputError, Located, LocationError, NotLocated, Refined, discover
from photonpano.geometry import camera_matrix, from_parameters, inverse, normalised, parameters, step_motions, translation
from photonpano.testing.pose_estimators import capture
from photonpano.testing.refiners import REFERENCE, SHAPE

from .strange import Around, around, given, instead

Build: TypeAlias = Callable[[Any], Any]
Table: TypeAlias = Mapping[str, Build]  # by the check that finds each, and behind a comma what is broken
DIRECT = discover().find("locator", "direct").contribution


class Hundreds:
    """A resampler: groups of 100 frames, one after the other."""

    def __init__(self, _: Any = None) -> None:
        pass

    def groups(self, n_frames: int, level: int) -> Any:
        if n_frames < 100:
            raise InputError(f"{n_frames} frames are too few")
        spans = (FrameSpan(start, start + 100) for start in range(0, n_frames - 99, 100))
        return tuple(Group(span, span.centre) for span in spans)


class Forgetful(Hundreds):
    def __init__(self, _: Any) -> None:
        self.calls = itertools.count()

    def groups(self, n_frames: int, level: int) -> Any:
        return super().groups(n_frames, level)[: -1 if next(self.calls) else None]


def short_captures(answer: Callable[[int], Any]) -> Build:
    """Build a resampler that answers otherwise for captures that are too short."""
    return lambda _: instead("groups", lambda n, level: Hundreds().groups(n, level) if n >= 100 else answer(n))(Hundreds())


RESAMPLERS: Table = {
    "groups_returns_tuple": lambda _: around("groups", lambda found, *_: iter(found))(Hundreds()),
    "groups_depend_on_arguments_only": Forgetful,
    "short_capture_gives_groups_or_input_error, a group that cannot be": short_captures(
        lambda n: (Group(FrameSpan(0, n // 2), 0),)
    ),
    "short_capture_gives_groups_or_input_error, no group": short_captures(lambda _: ()),
    "check_agrees_with_groups_about_short_captures": Hundreds,
}


def locator(context: Any) -> Any:
    return DIRECT.build(DIRECT.config(), context)


def locates(change: Callable[[Located], Any]) -> Build:
    """Build a locator whose located motions are what `change` makes of good ones."""
    return lambda context: changing(change)(locator(context))


def changing(change: Callable[[Located], Any]) -> Callable[[Any], Any]:
    return around("register", lambda found, *_: change(found) if isinstance(found, Located) else found)


def registers(change: Callable[..., Any]) -> Build:
    """Build a locator whose answers are what `change` makes of good ones and of the arguments."""
    return lambda context: around("register", change)(locator(context))


def describes(change: Callable[[Any], Any], back: Callable[[Any], Any] = lambda described: described) -> Build:
    """Build a locator with other descriptions; `back` makes good ones of them."""

    def build(context: Any) -> Any:
        inner = locator(context)
        changed = around("describe", lambda found, *_: change(found))(inner)
        return given("register", lambda moving, fixed, initial: (back(moving), back(fixed), initial))(changed)

    return build


def seeing(before: Callable[[Any], Any]) -> Build:
    """Build a locator that does something with an exposure before it describes it."""
    return lambda context: given("describe", lambda exposure: (before(exposure) or exposure,))(locator(context))


class ForgetsOnItsWay:
    """Returns other motions in another process."""

    way = 0.0

    def __init__(self, context: Any) -> None:
        self.inner = locator(context)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        self.way = 1e-6

    def describe(self, exposure: Any) -> Any:
        return self.inner.describe(exposure)

    def register(self, *pair: Any) -> Any:
        found = self.inner.register(*pair)
        return replace(found, homography=translation(self.way, 0) @ found.homography)


def keeping_the_exposure(context: Any) -> Any:
    inner = locator(context)
    changed = given("register", lambda moving, fixed, initial: (inner.describe(moving), inner.describe(fixed), initial))(inner)
    return instead("describe", lambda exposure: exposure)(changed)


def pulled_by_holes(context: Any) -> Any:
    """See holes as black: they stand still in both images, and pull the motion towards none."""
    inner = locator(context)

    def register(moving: Any, fixed: Any, initial: Any) -> Any:
        found = inner.register(moving[0], fixed[0], initial)
        return pulled(found, moving[1]) if isinstance(found, Located) else found

    def pulled(found: Located, share: float) -> Located:
        homography = found.homography.copy()
        homography[:2, 2] *= 1 - share
        return replace(found, homography=homography)

    return Around(inner, describe=lambda it: (inner.describe(it), np.mean(it.weight == 0)), register=register)


def inverted(found: Located) -> Located:
    return replace(found, homography=inverse(found.homography))


def shift_alone(found: Located) -> Located:
    return replace(found, homography=translation(*found.homography[:2, 2]))


def six_left_alone(found: Located) -> Located:
    """Estimate shifts, with little information on the other six parameters."""
    information = np.zeros((8, 8))
    information[4:6, 4:6] = np.linalg.inv(np.linalg.inv(found.information)[4:6, 4:6])
    return replace(shift_alone(found), information=information + 1e3 * np.eye(8))


def informed(change: Callable[[np.ndarray], np.ndarray]) -> Build:
    return locates(lambda found: replace(found, information=change(found.information)))


def instead_of_failures(answer: Any) -> Callable[..., Any]:
    return lambda found, *_: answer if isinstance(found, NotLocated) else found


def turning(change: Callable[[Any], Any]) -> Build:
    return lambda context: around("turning", lambda found, *_: change(found))(locator(context))


def needing_a_start(found: Any, moving: Any, fixed: Any, initial: Any) -> Any:
    return NotLocated("there is no start") if initial is None else found


def jittered(found: Located) -> Located:
    jitter = 1e-9 * np.random.get_bit_generator().random_raw() / 2**32  # the fault
    return replace(found, homography=found.homography @ translation(jitter, 0))


def require_seen(exposure: Any) -> None:
    if not exposure.weight.any():
        raise ZeroDivisionError("the mean of nothing")


def require_large(exposure: Any) -> None:
    if exposure.flux.shape[0] < 64:
        raise RuntimeError("the pyramid has no level")


BOASTING = informed(lambda information: information * 1e4)
STANDING_STILL = instead_of_failures(Located(np.eye(3)))
BY_ROWS = np.ix_(*2 * [[0, 2, 4, 1, 3, 5, 6, 7]])
LOCATORS: Table = {
    "locator_works_in_other_processes, a function in it": lambda context: Around(locator(context), gain=lambda flux: flux),
    "locator_works_in_other_processes, functions in descriptions": lambda context: DescribesByFunctions(locator(context)),
    "locator_works_in_other_processes, other answers": ForgetsOnItsWay,
    "homography_maps_moving_to_fixed": locates(inverted),
    "register_finds_motion_without_start, shifts alone": locates(shift_alone),
    "register_finds_motion_without_start, needs a start": registers(needing_a_start),
    "register_finds_motion_from_nearby_start": registers(
        lambda found, _, __, initial: Located(initial) if isinstance(found, Located) else found
    ),
    "unseen_pixels_have_no_influence": pulled_by_holes,
    "image_without_texture_is_not_located, stands still": registers(STANDING_STILL),
    "image_without_texture_is_not_located, raises": seeing(require_seen),
    "image_without_texture_is_not_located, no reason": registers(instead_of_failures(NotLocated(""))),
    "different_places_are_not_located": registers(STANDING_STILL),
    "turning_locates_turns_and_nothing_else, inverse": turning(changing(inverted)),
    "turning_locates_turns_and_nothing_else, stands still": turning(around("register", STANDING_STILL)),
    "very_small_image_does_not_raise": seeing(require_large),
    "information_is_inverse_covariance_of_errors, too certain": BOASTING,
    "information_is_inverse_covariance_of_errors, covariance": informed(np.linalg.inv),
    "information_is_inverse_covariance_of_errors, by rows": informed(lambda information: information[BY_ROWS]),
    "information_is_inverse_covariance_of_errors, negative": informed(
        lambda information: information - 2 * np.diag(np.diag(information))
    ),
    "description_does_not_hold_exposure": keeping_the_exposure,
    "register_leaves_inputs_unchanged, flux": seeing(lambda exposure: exposure.flux.__setitem__((0, 0), 0)),
    "register_leaves_inputs_unchanged, start": lambda context: given(
        "register", lambda *pair: (pair[2] is None or pair[2].__setitem__((2, 2), 1), pair)[1]
    )(locator(context)),
    "register_is_deterministic": locates(jittered),
}


class DescribesByFunctions:
    """Returns descriptions that cannot travel to another process."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def describe(self, exposure: Any) -> Any:
        described = self.inner.describe(exposure)
        return lambda: described

    def register(self, moving: Any, fixed: Any, initial: Any) -> Any:
        return self.inner.register(moving(), fixed(), initial)


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


def fits_given(change: Callable[..., tuple[Any, ...]]) -> Build:
    return lambda _: given("fit", change)(Straight())


def at_given(change: Callable[[np.ndarray], Any]) -> Build:
    """Build an interpolator whose trajectories are asked at other instants."""
    change_at = given("at", lambda frames: (change(np.asarray(frames, dtype=float)),))
    return lambda _: around("fit", lambda found, *_: change_at(found))(Straight())


def writing(instants: np.ndarray, *rest: Any) -> tuple[Any, ...]:
    instants -= 1e-6
    return instants, *rest


def writing_and_undoing(instants: np.ndarray, *rest: Any) -> tuple[Any, ...]:
    instants *= 2
    instants /= 2
    return instants, *rest


INTERPOLATORS: Table = {
    "trajectory_passes_its_knots, raises for one": fits_given(
        lambda instants, knots, information: (instants, knots / (instants[1] - instants[0]), information)
    ),
    "trajectory_passes_its_knots, inverse": fits_given(
        lambda instants, knots, information: (instants, inverse(knots), information)
    ),
    "trajectory_passes_knots_with_information": fits_given(
        lambda instants, knots, information: (instants + 10 * (information is not None), knots, information)
    ),
    "instants_are_independent_of_each_other, one answer": at_given(lambda frames: frames[:1]),
    "instants_are_independent_of_each_other, moved by the others": at_given(
        lambda frames: frames + 0.01 * (frames - frames.mean())
    ),
    "constant_velocity_is_kept_between_knots": Nearest,
    "fit_leaves_inputs_unchanged, changed": fits_given(writing),
    "fit_leaves_inputs_unchanged, changed and undone": fits_given(writing_and_undoing),
    "fit_is_deterministic": at_given(lambda frames: frames + 1e-9 * np.random.default_rng().random()),
}


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


def refines(change: Callable[..., Any]) -> Build:
    """Build a refiner that returns what `change` makes of a good motion and of the arguments."""
    return lambda _: around("refine", lambda found, *all_: found and change(found, *all_))(Steps())


def first(work: Callable[..., Any]) -> Build:
    """Build a refiner that does something with its expected errors and residuals first."""

    def before(source: Any, trajectory: Any, std_px: Any, residuals: Any, view: Any) -> tuple[Any, ...]:
        work(std_px, residuals)
        return source, trajectory, std_px, residuals, view

    return lambda _: given("refine", before)(Steps())


REFINERS: Table = {
    "reference_frame_stays_the_identity": refines(
        lambda found, *_: replace(found, homographies=found.homographies[100] @ found.homographies)
    ),
    "photon_noise_is_not_corrected": lambda _: Steps(least_ratio=0),
    "tremor_is_reduced_or_left": lambda _: Steps(sign=-1),
    "few_spans_are_enough": first(lambda _, residuals: np.gradient(residuals.steps, axis=0, edge_order=2)),
    "refine_accepts_spans_without_information, raises": first(lambda _, residuals: np.linalg.inv(residuals.information)),
    "refine_accepts_spans_without_information, NaN": refines(
        lambda found, *all_: (
            found if all_[3].information[10, 0, 0] else replace(found, homographies=found.homographies * np.nan)
        )
    ),
    "refine_leaves_inputs_unchanged, errors": first(lambda std_px, _: np.multiply(std_px, 2, out=std_px)),
    "refine_leaves_inputs_unchanged, steps": first(lambda _, residuals: np.multiply(residuals.steps, 1, out=residuals.steps)),
    "refine_is_deterministic": refines(
        lambda found, *_: replace(found, std_px=found.std_px * np.random.default_rng().random())
    ),
}


def turning_refused(build: Build) -> Build:
    """Build a pose estimator that knows that a camera which only turns has no poses."""

    def refused(source: Any, *rest: Any) -> tuple[Any, ...]:
        if source is capture(False):
            raise LocationError("it only turns")
        return source, *rest

    return lambda context: given("estimate", refused)(build(context))


def pose_estimators(known_path: Build) -> Table:
    """Return pose estimators that differ from one that knows the path."""

    def estimates(change: Callable[[Any], dict[str, Any]]) -> Build:
        return lambda context: around("estimate", lambda found, *_: replace(found, **change(found)))(known_path(context))

    numbers = itertools.count()
    return {
        "estimate_finds_the_poses, shifted": estimates(
            lambda it: {"camera_from_world": np.roll(it.camera_from_world, 80, axis=0)}
        ),
        "estimate_finds_the_poses, too certain": estimates(lambda it: {"std_position": it.std_position / 10}),
        "estimate_finds_the_poses, another focal length": estimates(
            lambda _: {"camera_matrix": camera_matrix(99.0, (79.5, 63.5))}
        ),
        "camera_that_only_turns_has_no_poses": known_path,
        "estimate_is_deterministic": estimates(
            lambda it: {"camera_from_world": it.camera_from_world + next(numbers) * np.eye(3, 4, 3)}
        ),
    }
