"""Plugins that misbehave: whatever they raise, wherever they are called, and before a run begins."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field, model_validator

from photonpano import Config, FrameSpan, MergerContribution, SourceContribution
from photonpano.plugins.registry import Catalog
from photonpano.testing import KnownMotion

from .strange import ERRORS, KINDS, Around, Keys, Outcome, SpeechlessError, around, instead, raising, require_named


def failing_at(start: int, stop: int, error: Exception) -> Callable[[Any], Any]:
    """Return a source that cannot read one span."""

    def counts(inner: Any, span: FrameSpan) -> Any:
        return raising(error)() if span == FrameSpan(start, stop) else inner.counts(span)

    return lambda inner: Around(inner, counts=partial(counts, inner))


def failing_later(error: Exception) -> Callable[[Any], Any]:
    """Return an interpolator whose trajectory fails after the two calls of the check that follows the fit."""

    def at(found: Any, calls: Iterator[int], frames: Any) -> Any:
        return found.at(frames) if next(calls) < 2 else raising(error)()

    return around("fit", lambda found, *_: Around(found, at=partial(at, found, count())))


PLACES: Mapping[str, tuple[str, Callable[[Exception], Callable[[Any], Any]], str]] = {
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
    "counts of a short span": ("source", lambda error: failing_at(40, 44, error), "failed at frames 40 to 43: "),
    "counts of a group": ("source", lambda error: failing_at(40, 80, error), "failed at frames 40 to 79: "),
    "counts of a rendered frame": ("source", lambda error: failing_at(150, 151, error), "failed at frame 150: "),
    "refine": ("refiner", lambda error: instead("refine", raising(error)), "failed at the refinement: "),
    "render": ("renderer", lambda error: instead("render", raising(error)), "failed at the panorama: "),
    "build a pose estimator": ("pose-estimator", raising, "could not be built: "),
    "estimate": ("pose-estimator", lambda error: instead("estimate", raising(error)), "failed at the capture: "),
}


# Groups are read as a whole if they are not merged along the motion that short spans show.
SECTIONS: Mapping[str, Any] = {"counts of a group": {"merge": {"use": "photon-mle", "with": {"compensate": False}}}}
# All errors where components are built, where they work, and where a trajectory is asked; one of them elsewhere.
OFTEN = {"build a source", "counts", "merge", "at, after the fit"}


@pytest.mark.parametrize(
    ("place", "error"),
    [(place, error) for place in PLACES for error in ERRORS if place in OFTEN or error == "an error"],
)
def test_exception_names_plugin(misbehaving: Callable[..., Outcome], place: str, error: str) -> None:
    (kind, change, message), (error, words) = PLACES[place], ERRORS[error]
    require_named(misbehaving(kind, change(error), **SECTIONS.get(place, {})), kind, message + words)


def test_source_that_cannot_be_closed_is_warned_of(misbehaving: Callable[..., Outcome]) -> None:
    """The results are whole: what was read is not affected."""
    outcome = misbehaving("source", instead("close", raising(OSError("gone"))))
    assert outcome.code == 0
    assert outcome.printed.startswith("warning: source 'strange' of strange-plugin 1.2 failed at closing: ")
    assert {"panorama.png", "run.json", "trajectory.npz"} <= set(outcome.files)


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (SystemExit(0), 1)], ids=["Ctrl-C", "sys.exit"])
def test_end_while_a_plugin_works_is_no_error_of_the_plugin(
    misbehaving: Callable[..., Outcome], error: BaseException, code: int
) -> None:
    outcome = misbehaving("resampler", instead("groups", raising(error)))
    assert (outcome.code, outcome.files) == (code, [])
    assert "strange" not in outcome.printed


def strange(contribution: Any, **fields: Any) -> Any:
    """Make a contribution that must not be built."""
    fields = {"config": Keys, "build": raising(AssertionError("not built"))} | fields
    return contribution(name="strange", summary="Strange", **fields)


@pytest.mark.parametrize(
    ("kind", "error"), [(kind, error) for kind in KINDS for error in ERRORS if kind == "source" or error == "an error"]
)
def test_check_that_raises_is_a_problem_of_the_spec(outcome_of: Callable[..., Outcome], kind: str, error: str) -> None:
    section, contribution, _ = KINDS[kind]
    raised, words = ERRORS[error]
    sections = {section: [{"use": "strange"}] if kind == "refiner" else {"use": "strange"}}
    outcome = outcome_of(sections, strange(contribution, check=raising(raised)))
    where = "refine.0" if kind == "refiner" else section
    problem = f"{where}: the check of the {kind} 'strange' of strange-plugin 1.2 raised {words}\n"
    assert outcome.printed == problem + "error: the spec has 1 problem\n"
    assert (outcome.code, outcome.files) == (2, [])


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (None, "raised TypeError: 'NoneType' object is not iterable"),
        (3, "raised TypeError: 'int' object is not iterable"),
        ([SpeechlessError()], "raised RuntimeError: no words"),
    ],
    ids=["None", "a number", "no words"],
)
def test_check_that_returns_no_sentences_is_a_problem_of_the_spec(
    outcome_of: Callable[..., Outcome], found: Any, words: str
) -> None:
    outcome = outcome_of({"source": {"use": "strange"}}, strange(SourceContribution, check=lambda _: found))
    named = f"source: the check of the source 'strange' of strange-plugin 1.2 {words}"
    assert outcome.printed == f"{named}\nerror: the spec has 1 problem\n"
    assert outcome.code == 2


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_config_that_raises_is_a_problem_of_the_spec(outcome_of: Callable[..., Outcome], error: str) -> None:
    raised, words = ERRORS[error]

    class Raising(Config):
        size: int = Field(1, description="any")

        @model_validator(mode="before")
        @classmethod
        def fails(cls, _: Any) -> Any:
            raise raised

    outcome = outcome_of({"merge": {"use": "strange"}}, strange(MergerContribution, config=Raising))
    named = f"the config of the merger 'strange' of strange-plugin 1.2 raised {words}"
    assert outcome.printed == f"merge.with: {named}\nerror: the spec has 1 problem\n"
    assert outcome.code == 2


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_source_that_raises_on_recognising_is_named(
    catalog: Catalog, outcome_of: Callable[..., Outcome], tmp_path: Path, error: str
) -> None:
    raised, words = ERRORS[error]
    (tmp_path / "cube.odd").write_bytes(b"odd")
    sections = {"source": {"use": "auto", "with": {"path": str(tmp_path / "cube.odd")}}}
    outcome = outcome_of(sections, strange(SourceContribution, recognise=raising(raised)))
    assert f"recognise of the source 'strange' of strange-plugin 1.2 raised {words}" in outcome.printed
    assert (outcome.code, outcome.files) == (2, [])
