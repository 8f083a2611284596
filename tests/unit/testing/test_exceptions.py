"""Plugins that raise whatever can be raised, wherever they are called."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from typing import Any

import pytest

from photonpano import FrameSpan, hookimpl
from photonpano.errors import described
from photonpano.registry import Observer
from photonpano.registry.plugins import observation_of
from photonpano.testing import KnownMotion

from .strange import ERRORS, ORIGIN, Around, Odd, Outcome, around, instead, raising, require_named


def failing_at(start: int, stop: int, error: BaseException) -> Callable[[Any], Any]:
    """Return a source that cannot read one span."""

    def counts(inner: Any, span: FrameSpan) -> Any:
        return raising(error)() if span == FrameSpan(start, stop) else inner.counts(span)

    return lambda inner: Around(inner, counts=partial(counts, inner))


def failing_later(error: BaseException) -> Callable[[Any], Any]:
    """Return an interpolator whose trajectory fails after the two calls of the check that follows the fit."""

    def at(found: Any, calls: Iterator[int], frames: Any) -> Any:
        return found.at(frames) if next(calls) < 2 else raising(error)()

    return around("fit", lambda found, *_: Around(found, at=partial(at, found, count())))


PLACES: Mapping[str, tuple[str, Callable[[BaseException], Callable[[Any], Any]], str]] = {
    "build a source": ("source", raising, "could not be built: "),
    "build a merger": ("merger", raising, "could not be built: "),
    "counts": ("source", lambda error: instead("counts", raising(error)), "failed at frames 0 to 159: "),
    "groups": ("resampler", lambda error: instead("groups", raising(error)), "failed at level 1: "),
    "merge": ("merger", lambda error: instead("merge", raising(error)), "failed at level 1: "),
    "describe": ("locator", lambda error: instead("describe", raising(error)), "failed at level 1: "),
    "register": ("locator", lambda error: instead("register", raising(error)), "failed at level 1: "),
    "fit": ("interpolator", lambda error: instead("fit", raising(error)), "failed at level 1: "),
    "at": (
        "interpolator",
        lambda error: instead("fit", lambda *_: KnownMotion(raising(error))),
        "failed at level 1: ",
    ),
    "at, after the fit": ("interpolator", lambda error: failing_later(error), "failed at level 1: "),
    "counts of a group": ("source", lambda error: failing_at(40, 80, error), "failed at frames 40 to 79: "),
    "counts of a rendered frame": ("source", lambda error: failing_at(150, 151, error), "failed at frame 150: "),
    "refine": ("refiner", lambda error: instead("refine", raising(error)), "failed at round 1: "),
    "render": ("renderer", lambda error: instead("render", raising(error)), "failed at the panorama: "),
    "build a pose estimator": ("pose-estimator", raising, "could not be built: "),
    "estimate": ("pose-estimator", lambda error: instead("estimate", raising(error)), "failed at the capture: "),
}


@pytest.mark.parametrize(("error", "words"), ERRORS.values(), ids=ERRORS)
@pytest.mark.parametrize(("kind", "change", "message"), PLACES.values(), ids=PLACES)
def test_exception_of_any_kind_names_plugin(
    misbehaving: Callable[..., Outcome],
    kind: str,
    change: Callable[[BaseException], Callable[[Any], Any]],
    message: str,
    error: BaseException,
    words: str,
) -> None:
    require_named(misbehaving(kind, change(error)), kind, message + words)


@pytest.mark.parametrize("error", [OSError("gone"), SystemExit(0), KeyboardInterrupt(), Odd("stop")], ids=repr)
def test_source_that_cannot_be_closed_is_warned_of(misbehaving: Callable[..., Outcome], error: BaseException) -> None:
    """The results are whole: what was read is not affected."""
    outcome = misbehaving("source", instead("close", raising(error)))
    assert outcome.code == 0
    assert outcome.printed.startswith("warning: source 'strange' of strange-plugin 1.2 failed at closing: ")
    assert {"panorama.png", "run.json", "trajectory.npz"} <= set(outcome.files)


@pytest.mark.parametrize("error", [SystemExit(0), KeyboardInterrupt(), Odd("stop")], ids=repr)
@pytest.mark.parametrize("hook", ["photonpano_run_started", "photonpano_stage_finished", "photonpano_run_finished"])
def test_observer_cannot_end_a_run(outcome_of: Callable[..., Outcome], hook: str, error: BaseException) -> None:
    class Watching:
        pass

    setattr(Watching, hook, staticmethod(hookimpl(raising(error))))
    relay = observation_of(Watching())
    assert relay is not None
    outcome = outcome_of({}, observers=(Observer(ORIGIN, relay),))
    assert outcome.code == 0
    assert outcome.printed.startswith(
        f"warning: {hook} of strange-plugin 1.2 (strange = strange.hooks) raised {described(error)};"
    )
    assert "panorama.png" in outcome.files


def test_signal_while_a_plugin_works_is_an_interrupt(misbehaving: Callable[..., Outcome]) -> None:
    """A resampler works in the main thread, which Ctrl-C interrupts."""
    outcome = misbehaving("resampler", instead("groups", lambda *_: signal.raise_signal(signal.SIGINT)))
    assert (outcome.code, outcome.files) == (130, [])
    assert "strange" not in outcome.printed
