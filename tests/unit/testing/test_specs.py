"""Plugins that misbehave before a run begins, when a spec is read: a problem of the spec, and exit code 2."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field, model_validator

from photonpano import Config, MergerContribution, SourceContribution
from photonpano.registry import Catalog

from .strange import ERRORS, KINDS, Keys, Outcome, SpeechlessError, raising


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
@pytest.mark.parametrize(("kind", "section"), [(kind, section) for kind, (section, *_) in KINDS.items()])
def test_check_that_raises_is_a_problem_of_the_spec(
    outcome_of: Callable[..., Outcome], kind: str, section: str, error: str
) -> None:
    raised, words = ERRORS[error]
    strange = KINDS[kind][1](
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), check=raising(raised)
    )
    outcome = outcome_of({section: [{"use": "strange"}] if kind == "refiner" else {"use": "strange"}}, strange)
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
    strange = SourceContribution(
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), check=lambda _: found
    )
    outcome = outcome_of({"source": {"use": "strange"}}, strange)
    assert (
        outcome.printed
        == f"source: the check of the source 'strange' of strange-plugin 1.2 {words}\nerror: the spec has 1 problem\n"
    )
    assert outcome.code == 2


def test_check_with_sentences_without_end_is_cut(outcome_of: Callable[..., Outcome]) -> None:
    strange = SourceContribution(
        name="strange",
        summary="Strange",
        config=Keys,
        build=raising(AssertionError("not built")),
        check=lambda _: map(str, count()),
    )
    outcome = outcome_of({"source": {"use": "strange"}}, strange)
    assert outcome.code == 2
    assert outcome.printed.endswith("source: 99\nerror: the spec has 100 problems\n")


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_config_that_raises_is_a_problem_of_the_spec(outcome_of: Callable[..., Outcome], error: str) -> None:
    raised, words = ERRORS[error]

    class Raising(Config):
        size: int = Field(1, description="any")

        @model_validator(mode="before")
        @classmethod
        def fails(cls, _: Any) -> Any:
            raise raised

    strange = MergerContribution(name="strange", summary="Strange", config=Raising, build=raising(AssertionError("not built")))
    outcome = outcome_of({"merge": {"use": "strange"}}, strange)
    named = f"the config of the merger 'strange' of strange-plugin 1.2 raised {words}"
    assert outcome.printed == f"merge.with: {named}\nerror: the spec has 1 problem\n"
    assert outcome.code == 2


@pytest.mark.parametrize("error", ERRORS, ids=ERRORS)
def test_source_that_raises_on_recognising_is_named(
    catalog: Catalog, outcome_of: Callable[..., Outcome], tmp_path: Path, error: str
) -> None:
    raised, words = ERRORS[error]
    (tmp_path / "cube.odd").write_bytes(b"odd")
    strange = SourceContribution(
        name="strange", summary="Strange", config=Keys, build=raising(AssertionError("not built")), recognise=raising(raised)
    )
    outcome = outcome_of({"source": {"use": "auto", "with": {"path": str(tmp_path / "cube.odd")}}}, strange)
    assert f"recognise of the source 'strange' of strange-plugin 1.2 raised {words}" in outcome.printed
    assert (outcome.code, outcome.files) == (2, [])
